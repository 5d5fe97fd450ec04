"""The main path of one cell: a trained encoder, its latents, the policies on them, one CellResult.

`cell_flow` is the path; the functions below it are its stages, which run wherever an engine puts them. Nothing here
knows a tracker. Products of finished stages are kept under `scratch` by key, so that a killed sweep resumes.
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.compute.provenance import provenance
from study.config.heads import CEILING, load_heads
from study.config.keys import cell_key
from study.data.frames import Frames, FrameStore, open_frames
from study.data.prepare import data_flow
from study.engine.flows import run_flow
from study.errors import BadInputError
from study.products import Arrays, read_product, write_product
from study.results.cell_result import NO_SEED, CellResult
from study.results.job import CellJob
from study.stages import ENCODER, LATENTS, POLICY, RESULT, Batch, Flow, Task, Work

PROBED = ("speed", "light", "lead_gap")  # columns of the labels that reports probe the latents for
SHARE_SECONDS = 40.0  # on one core of the reference machine, of a share of the policies: what a kill costs at most
HEAD = "product.json"
ENCODER_CURVES = ["split", "epoch", "metric", "value"]  # columns

Report = Callable[..., None]


@dataclass(frozen=True)
class Product:
    """What the encoder stage, or the policy stage for some seeds, leaves behind: arrays, curves and facts.

    Encoder: parts "weights" and "samples". Policies: "weights" and "predictions". `facts`: plain values.
    """

    parts: dict[str, Arrays]
    curves: pd.DataFrame
    facts: dict[str, Any]


@dataclass(frozen=True)
class Latents:
    """The policy set as policies see it: z [N, 64] float32 and labels of both splits, and what the stage says."""

    z_train: NDArray[np.float32]
    z_test: NDArray[np.float32]
    labels_train: pd.DataFrame
    labels_test: pd.DataFrame
    facts: dict[str, Any]


def cell_flow(job: CellJob, *, one_share: bool = False) -> Flow[tuple[CellResult, bytes]]:
    """Train the cell's encoder, encode the policy set, train its policies in shares, and put the result together.

    The ceiling has no encoder: its latents are the true state. With `one_share` all policies are trained at once, as
    a GPU does best. Returns the result and its network, an archive of torch.export, empty for the ceiling.
    """
    encoder = None
    if job.cell.heads != CEILING:
        kept = job.scratch / "products" / f"encoder-{ENCODER.key(_work(job))}"
        task = Task(ENCODER, train_cell_encoder, (job,), reports=True, accelerated=True)
        (encoder,) = yield from _keep_all([kept], ("weights", "samples"), [task])
    (latents,) = yield Batch([Task(LATENTS, encode_policy_set, (job, encoder), accelerated=True)])

    shares = 1 if one_share else min(job.policy_seeds, math.ceil(2 * POLICY.cost(_work(job)) / SHARE_SECONDS))
    tasks, paths = [], []
    for part in np.array_split(np.arange(job.policy_seeds), shares):
        seeds = part.tolist()
        paths.append(job.scratch / "products" / f"policies-{job.key}-{seeds[0]}-{seeds[-1]}")
        share = (job, latents, seeds)
        tasks.append(Task(POLICY, train_policy_share, share, len(seeds), reports=True, accelerated=True))
    policies = yield from _keep_all(paths, ("weights", "predictions"), tasks)
    result: tuple[CellResult, bytes]
    (result,) = yield Batch([Task(RESULT, assemble_result, (job, encoder, latents, policies))])
    return result


def product_folders(scratch: Path, key: str) -> list[Path]:
    """Return the kept policies of a cell: once it is committed, nobody needs them."""
    return list((scratch / "products").glob(f"policies-{key}-*"))


def _work(job: CellJob) -> Work:
    return Work(job.settings, job.cell, job.policy_seeds, job.frames.name)


def _keep_all(
    folders: list[Path], parts: tuple[str, ...], tasks: list[Task]
) -> Generator[Batch, list[Any], list[Product]]:
    """Return the products in these folders; those that are missing or damaged are made by their tasks, and kept."""
    products: dict[int, Product] = {}
    for index, folder in enumerate(folders):
        with suppress(BadInputError):
            head, arrays, curves = read_product(folder, HEAD, parts)
            products[index] = Product(arrays, curves, head["facts"])
    missing = [index for index in range(len(folders)) if index not in products]
    if missing:
        before = sum(tasks[index].weight for index in products)
        made = yield Batch([tasks[index] for index in missing], before)
        for index, product in zip(missing, made, strict=True):
            write_product(folders[index], HEAD, {"facts": product.facts}, product.parts, product.curves)
            products[index] = product
    return [products[index] for index in range(len(folders))]


# --- the stages -----------------------------------------------------------------------------------------------------
# Each imports what it computes with when it runs: the process that only plans and commits needs no torch.


def train_cell_encoder(job: CellJob, report: Report) -> Product:
    """Train the encoder. Raises BadInputError for settings that cannot be met, TrainingDivergedError for a bad loss."""
    from study.encoder.training import train_encoder  # noqa: PLC0415

    store, device, facts = _begin(job, report)
    settings, cell = job.settings, job.cell
    trained = train_encoder(
        store.encoder,
        cell.heads,
        cell.fraction,
        cell.encoder_seed,
        settings.encoder,
        settings.frames,
        device=device,
        checkpoint=job.scratch / "encoders" / ENCODER.key(_work(job)),
        log=lambda epoch, metrics: report("log", epoch, metrics),
        progress=lambda done, total: report("progress", done, total),
    )
    facts |= {"frames": trained.frames, "precision": trained.precision, "peak_bytes": _peak_bytes()}
    return Product(
        {"weights": trained.weights, "samples": trained.samples}, trained.curves, facts | {"seconds": trained.seconds}
    )


def encode_policy_set(job: CellJob, encoder: Product | None) -> Latents:
    """Return the latents of the policy set: the encoder's, or the true state."""
    from study.data.true_state import true_state  # noqa: PLC0415
    from study.encoder.latents import encode  # noqa: PLC0415

    started = time.perf_counter()
    store, device, facts = _begin(job)
    policy = store.policy
    rows = {split: policy.indices(split) for split in ("train", "test")}
    if encoder is None:
        state = true_state(policy.labels, store.manifest["sources"]["policy"], job.drives)
        z = {split: state[indices] for split, indices in rows.items()}
    else:
        weights = encoder.parts["weights"]
        z = {split: encode(weights, policy.images, indices, device=device) for split, indices in rows.items()}
    facts |= {"encoder_test": len(store.encoder.indices("test")), "peak_bytes": _peak_bytes()}
    facts |= {"seconds": time.perf_counter() - started}
    return Latents(z["train"], z["test"], _labels(policy, rows["train"]), _labels(policy, rows["test"]), facts)


def train_policy_share(job: CellJob, latents: Latents, seeds: list[int], report: Report) -> Product:
    """Train the policies of these seeds."""
    from study.policy.training import train_policies  # noqa: PLC0415

    device = _compute_on(job, report)
    trained = train_policies(
        latents.z_train,
        latents.z_test,
        latents.labels_train,
        latents.labels_test,
        seeds,
        job.settings.policy,
        device=device,
        log=lambda epoch, metrics: report("log", epoch, metrics),
        progress=lambda done, total: report("progress", done, total),
    )
    predictions: Arrays = {"acceleration": trained.acceleration, "steering": trained.steering}
    facts = {"seconds": trained.seconds, "peak_bytes": _peak_bytes()}
    return Product({"weights": trained.weights, "predictions": predictions}, trained.curves, facts)


def assemble_result(
    job: CellJob, encoder: Product | None, latents: Latents, policies: list[Product]
) -> tuple[CellResult, bytes]:
    """Return the result of the cell and its exported network."""
    from study.driving.driver import export_driver  # noqa: PLC0415
    from study.policy.training import TrainedPolicies, join_policies  # noqa: PLC0415

    joined = join_policies(
        [
            TrainedPolicies(p.parts["weights"], p.curves, **p.parts["predictions"], seconds=p.facts["seconds"])
            for p in policies
        ]
    )
    encoder_curves = joined.curves[ENCODER_CURVES][:0] if encoder is None else encoder.curves
    curves = pd.concat([encoder_curves.assign(policy_seed=NO_SEED, stage="encoder"), joined.curves], ignore_index=True)
    labels, first = latents.labels_test, (encoder or latents).facts
    seconds: dict[str, float] = {
        "encoder": encoder.facts["seconds"] if encoder else 0.0,
        "encode": latents.facts["seconds"],
        "policies": joined.seconds,
    }
    result = CellResult(
        cell=job.cell,
        key=job.key,
        settings=job.settings.model_dump(mode="json")
        | {"policy_seeds": job.policy_seeds, "frames_key": job.frames.name},
        curves=curves,
        encoder=encoder.parts["weights"] if encoder else {},
        policies=joined.weights,
        samples=encoder.parts["samples"] if encoder else {},
        predictions={
            "acceleration": joined.acceleration,
            "steering": joined.steering,
            "acceleration_label": labels["acceleration"].to_numpy(np.uint8),
            "steering_label": labels["steering"].to_numpy(np.float32),
            "episode": labels["episode"].to_numpy(np.int32),
            **{name: labels[name].to_numpy() for name in PROBED},
            "z": latents.z_test,
        },
        facts={
            "floor": float(np.bincount(labels["acceleration"]).max() / len(labels)),
            "frames": {
                "encoder_train": encoder.facts["frames"] if encoder else 0,
                "encoder_test": latents.facts["encoder_test"],
                "policy_train": len(latents.labels_train),
                "policy_test": len(labels),
            },
            "seconds": seconds | {"cell": sum(seconds.values())},
            "peak_bytes": max(part.facts["peak_bytes"] for part in (encoder or latents, latents, *policies)),
            "device": first["device"],
            "precision": encoder.facts["precision"] if encoder else "fp32",
            "threads": job.threads,
            "provenance": first["provenance"],
        },
    )
    return result, export_driver(result) if encoder else b""


# --- what the stages share ------------------------------------------------------------------------------------------


def _begin(job: CellJob, report: Report | None = None) -> tuple[FrameStore, str, dict[str, Any]]:
    """Return the frames, made here where they are missing, the device, and facts about what computes."""
    load_heads(job.head_modules)
    device = _compute_on(job, report)
    # Now, not at the end: the code that runs is the one that was loaded, whatever is edited meanwhile.
    origin = provenance() | {"determinism": determinism(), "seeds": _seeds(job)}
    if not (job.frames / "manifest.json").is_file():
        run_flow(data_flow(job.settings, job.scratch, job.imported))
    store = open_frames(job.frames)
    if cell_key(job.settings, job.cell, job.policy_seeds, store.key) != job.key:
        raise BadInputError(
            f"{job.frames} is not the frame store that {job.cell.label} was planned on; plan the sweep again"
        )
    return store, device, {"device": device_name(device), "provenance": origin}


def _compute_on(job: CellJob, report: Report | None) -> str:
    """Set the threads, and return the device. Raises BadInputError for one that is not there."""
    import torch  # noqa: PLC0415

    from study.compute.device import check_device  # noqa: PLC0415

    torch.set_num_threads(job.threads)
    device = job.device
    if device in {"auto", "cuda"} or (device.startswith("cuda") and torch.cuda.device_count() == 1):
        # A worker of an engine sees the one GPU that is its own, under the number 0.
        device = "cuda:0" if torch.cuda.is_available() or device != "auto" else "cpu"
    name = str(check_device(device))
    if report:
        report("device", device_name(name))
    return name


def determinism() -> dict[str, Any]:
    """Return what torch has been told about speed against equal bits, and what it computes with on a CPU."""
    import torch  # noqa: PLC0415

    cudnn, cuda = torch.backends.cudnn, torch.backends.cuda
    return {
        "deterministic_algorithms": torch.are_deterministic_algorithms_enabled(),
        "cudnn_deterministic": cudnn.deterministic,
        "cudnn_benchmark": cudnn.benchmark,
        "cudnn_tf32": cudnn.allow_tf32,
        "matmul_tf32": cuda.matmul.allow_tf32,
        "mkldnn": torch.backends.mkldnn.enabled,
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
    }


def device_name(device: str) -> str:
    """Return what a reader should know the device as."""
    import torch  # noqa: PLC0415

    return torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU"


def _seeds(job: CellJob) -> dict[str, Any]:
    return {
        "recording": job.settings.recording.seed,
        "frames": job.settings.frames.seed,
        "encoder": job.cell.encoder_seed,
        "policies": list(range(job.policy_seeds)),
    }


def _labels(frames: Frames, rows: NDArray[np.int64]) -> pd.DataFrame:
    return frames.labels.iloc[rows].reset_index(drop=True)


def _peak_bytes() -> int:
    """Return the most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
