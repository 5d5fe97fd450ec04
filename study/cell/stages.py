"""The stages of a cell: functions that an engine runs on a worker. None of them knows a tracker."""

from __future__ import annotations

import pkgutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from study.baselines.inputs import BaselineInputs
from study.cell.job import CellJob
from study.compute.device import choose_device, describe_determinism, device_name, peak_bytes
from study.compute.provenance import provenance
from study.config.keys import baseline_folder, cell_key
from study.config.modules import load_modules
from study.config.paper import LATENT
from study.config.settings import SPEEDS
from study.data.frames import FrameStore, open_frames
from study.data.past_speeds import past_speeds
from study.data.prepare import data_flow
from study.driving.driver import export_driver
from study.encoder.bounds import loss_bounds
from study.encoder.latents import encode
from study.encoder.training import train_encoder
from study.engine.flows import run_flow
from study.errors import BadInputError
from study.policy.training import TrainedPolicies, join_policies, train_policies
from study.products import Arrays, Product
from study.results.cell_result import NO_SEED, CellResult
from study.stages import ENCODER

KEPT = ("speed", "light", "lead_gap", "keyframe", "weight")  # columns of the labels that reports need
ENCODER_CURVES = ["split", "epoch", "metric", "value"]  # columns

Reporter = Callable[..., None]  # see `Task`


@dataclass(frozen=True)
class Latents:
    """The policy set as policies see it: z [N, 64] float32 and labels of both splits, and the stage's facts.

    With `policy.inputs` z+speed, past speeds [m/s] follow the 64 numbers.
    """

    z_train: NDArray[np.float32]
    z_test: NDArray[np.float32]
    labels_train: pd.DataFrame
    labels_test: pd.DataFrame
    facts: dict[str, Any]


def train_cell_encoder(job: CellJob, report: Reporter) -> Product:
    """Train the encoder. Raises BadInputError for settings that cannot be met, TrainingDivergedError for a bad loss."""
    store, device, facts = begin(job, report)
    settings, cell = job.settings, job.cell
    trained = train_encoder(
        store.encoder,
        cell.heads,
        cell.fraction,
        cell.encoder_seed,
        settings.encoder,
        settings.frames,
        device=device,
        checkpoint=job.scratch / "encoders" / ENCODER.key(job.work),
        log=partial(report, "log"),
        progress=partial(report, "progress"),
    )
    facts |= {"frames": trained.frames, "precision": trained.precision}
    facts |= {"heads": loss_bounds(store.encoder, cell.heads)}
    facts |= {"seconds": trained.seconds, "peak_bytes": peak_bytes()}
    return Product({"weights": trained.weights, "samples": trained.samples}, trained.curves, facts)


def encode_policy_set(job: CellJob, encoder: Product | None, report: Reporter) -> Latents:
    """Return the latents of the policy set: the encoder's, or what a baseline gives policies in their place."""
    started = time.perf_counter()
    store, device, facts = begin(job, report)
    policy = store.policy
    part = policy.subset(job.settings.policy.share, "frame", job.settings.frames.seed)
    rows = {"train": part, "test": policy.indices("test")}
    if encoder is None:
        folder = baseline_folder(job.products, job.settings, job.cell, store.key)
        progress = partial(report, "progress")
        inputs = BaselineInputs(store, job.drives, job.settings, job.cell.encoder_seed, device, progress, folder)
        assert job.cell.baseline
        given = pkgutil.resolve_name(job.cell.baseline.inputs)(inputs)
        z = {split: given[indices] for split, indices in rows.items()}
    else:
        weights = encoder.parts["weights"]
        z = {split: encode(weights, policy.images, indices, device=device) for split, indices in rows.items()}
    if job.settings.policy.inputs == "z+speed":
        speeds = past_speeds(policy.labels, store.manifest["sources"]["policy"], job.drives, range(SPEEDS))
        z = {split: np.column_stack([z[split], speeds[rows[split]].astype(np.float32)]) for split in rows}
    labels = {split: policy.labels.iloc[indices].reset_index(drop=True) for split, indices in rows.items()}
    facts |= {"encoder_test": len(store.encoder.indices("test"))}
    facts |= {"seconds": time.perf_counter() - started, "peak_bytes": peak_bytes()}
    return Latents(z["train"], z["test"], labels["train"], labels["test"], facts)


def train_policy_share(job: CellJob, latents: Latents, seeds: list[int], report: Reporter) -> Product:
    """Train the policies of these seeds."""
    trained = train_policies(
        latents.z_train,
        latents.z_test,
        latents.labels_train,
        latents.labels_test,
        seeds,
        job.settings.policy,
        device=_set_up(job, report, job.policy_device),
        log=partial(report, "log"),
        progress=partial(report, "progress"),
    )
    predictions: Arrays = {"acceleration": trained.acceleration, "steering": trained.steering}
    facts = {"seconds": trained.seconds, "peak_bytes": peak_bytes()}
    return Product({"weights": trained.weights, "predictions": predictions}, trained.curves, facts)


def assemble_result(
    job: CellJob, encoder: Product | None, latents: Latents, policies: list[Product]
) -> tuple[CellResult, bytes]:
    """Return the result of the cell and its exported network."""
    joined = join_policies(
        [
            TrainedPolicies(
                share.parts["weights"], share.curves, **share.parts["predictions"], seconds=share.facts["seconds"]
            )
            for share in policies
        ]
    )
    encoder_curves = encoder.curves if encoder else joined.curves[ENCODER_CURVES][:0]
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
            **{name: labels[name].to_numpy() for name in KEPT},
            "z": latents.z_test[:, :LATENT],
        },
        facts={
            "floor": float(np.bincount(labels["acceleration"]).max() / len(labels)),
            "heads": encoder.facts["heads"] if encoder else {},
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


def begin(job: CellJob, report: Reporter) -> tuple[FrameStore, str, dict[str, Any]]:
    """Return the frames, made here where they are missing, the device, and facts about what computes."""
    load_modules(job.modules)
    device = _set_up(job, report, job.device)
    seeds = {
        "recording": job.settings.recording.seed,
        "frames": job.settings.frames.seed,
        "encoder": job.cell.encoder_seed,
        "policies": list(range(job.policy_seeds)),
    }
    # Now, not at the end: the code that runs is the one that was loaded, whatever is edited meanwhile.
    origin = provenance() | {"determinism": describe_determinism(), "seeds": seeds}
    if not (job.frames / "manifest.json").is_file():
        run_flow(data_flow(job.settings, job.scratch, job.imported))
    store = open_frames(job.frames)
    if cell_key(job.settings, job.cell, job.policy_seeds, store.key) != job.key:
        raise BadInputError(
            f"{job.frames} is not the frame store that {job.cell.label} was planned on; plan the sweep again"
        )
    return store, device, {"device": device_name(device), "provenance": origin}


def _set_up(job: CellJob, report: Reporter, name: str) -> str:
    """Set the number of threads, and return the device of that name."""
    torch.set_num_threads(job.threads)
    device = choose_device(name)
    report("device", device_name(device))
    return device
