"""The main path of one cell: a trained encoder, its latents, the policies on them, one CellResult.

Knows no tracker and no queue. What is trained is kept under `scratch` by key until the cell is committed, so that a
killed cell goes on where it was.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from study.autoencoder import TrainedEncoder, check_device, encode, train_encoder
from study.config import CEILING, BadInputError, cell_key, encoder_key
from study.exported import export_driver
from study.frames import Frames, FrameStore, open_frames
from study.policy import train_policies
from study.provenance import provenance
from study.result import NETWORK, NO_SEED, CellJob, CellResult
from study.state import true_state

PROBED = ("speed", "light", "lead_gap")  # columns of the labels that reports probe the latents for

Log = Callable[[str, int, dict[str, float]], None]
Progress = Callable[[str, int, int], None]


def run_cell(job: CellJob, log: Log, progress: Progress) -> CellResult:
    """Train the cell's encoder, encode the policy set once, train all policies, and save the result.

    The ceiling has no encoder: its latents are the true state.

    `log(stage, epoch, metrics)` once an epoch with names such as "test/loss_rec"; `progress(stage, done, total)`.
    Raises BadInputError for settings that cannot be met, TrainingDivergedError for a loss that is not finite.
    """
    store = open_frames(job.frames)
    settings, cell = job.settings, job.cell
    if cell_key(settings, cell, job.policy_seeds, store.key) != job.key:
        raise BadInputError(
            f"{job.frames} is not the frame store that {cell.label} was planned on; plan the sweep again"
        )
    device = choose_device(job)
    torch.set_num_threads(job.threads)
    # Now, not at the end: the code that runs is the one that was loaded, whatever is edited meanwhile.
    origin = provenance() | {"determinism": determinism(), "seeds": _seeds(job)}

    started = time.perf_counter()
    train, test = _labelled(store.policy, "train"), _labelled(store.policy, "test")
    encoder = _NO_ENCODER if cell.heads == CEILING else _train_encoder(job, store, device, log, progress)
    trained = time.perf_counter()
    if cell.heads == CEILING:
        state = true_state(store.policy.labels, store.manifest["sources"]["policy"], job.drives)
        z_train, z_test = (state[indices] for indices, _ in (train, test))
    else:
        z_train, z_test = (
            encode(encoder.weights, store.policy.images, indices, device=device) for indices, _ in (train, test)
        )
    encoded = time.perf_counter()

    policies = train_policies(
        z_train,
        z_test,
        train[1],
        test[1],
        range(job.policy_seeds),
        settings.policy,
        device=device,
        log=lambda epoch, metrics: log("policy", epoch, metrics),
        progress=lambda done, whole: progress("policy", done, whole),
    )
    ended = time.perf_counter()

    labels = test[1]
    result = CellResult(
        cell=cell,
        key=job.key,
        settings=settings.model_dump(mode="json") | {"policy_seeds": job.policy_seeds, "frames_key": store.key},
        curves=pd.concat(
            [encoder.curves.assign(policy_seed=NO_SEED, stage="encoder"), policies.curves], ignore_index=True
        ),
        encoder=encoder.weights,
        policies=policies.weights,
        samples=encoder.samples,
        predictions={
            "acceleration": policies.acceleration,
            "steering": policies.steering,
            "acceleration_label": labels["acceleration"].to_numpy(np.uint8),
            "steering_label": labels["steering"].to_numpy(np.float32),
            "episode": labels["episode"].to_numpy(np.int32),
            **{name: labels[name].to_numpy() for name in PROBED},
            "z": z_test,
        },
        facts={
            "floor": float(np.bincount(labels["acceleration"]).max() / len(labels)),
            "frames": {
                "encoder_train": encoder.frames,
                "encoder_test": len(store.encoder.indices("test")),
                "policy_train": len(train[1]),
                "policy_test": len(labels),
            },
            "seconds": {
                "encoder": encoder.seconds,
                "encode": encoded - trained,
                "policies": ended - encoded,
                "cell": ended - started,
            },
            "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            "device": device_name(device),
            "precision": encoder.precision,
            "threads": job.threads,
            "provenance": origin,
        },
    )
    result.save(job.result_folder, lambda folder: export_driver(result, folder / NETWORK) if result.encoder else None)
    return result


def determinism() -> dict[str, Any]:
    """What torch has been told about speed against equal bits, and what it computes with on a CPU."""
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


def _seeds(job: CellJob) -> dict[str, Any]:
    return {
        "recording": job.settings.recording.seed,
        "frames": job.settings.frames.seed,
        "encoder": job.cell.encoder_seed,
        "policies": list(range(job.policy_seeds)),
    }


_NO_ENCODER = TrainedEncoder({}, pd.DataFrame(columns=["split", "epoch", "metric", "value"]), {}, 0, 0.0, "fp32")


def _train_encoder(job: CellJob, store: FrameStore, device: str, log: Log, progress: Progress) -> TrainedEncoder:
    settings, cell = job.settings, job.cell
    return train_encoder(
        store.encoder,
        cell.heads,
        cell.fraction,
        cell.encoder_seed,
        settings.encoder,
        settings.frames,
        device=device,
        checkpoint=job.scratch / "encoders" / encoder_key(settings, cell, store.key),
        log=lambda epoch, metrics: log("encoder", epoch, metrics),
        progress=lambda done, whole: progress("encoder", done, whole),
    )


def choose_device(job: CellJob) -> str:
    """The torch device for a job. Raises BadInputError for one that is not there."""
    return str(check_device(slot_device(job.device, job.slot, torch.cuda.device_count())))


def slot_device(device: str, slot: int, gpus: int) -> str:
    """The device of the worker in a slot: GPUs go round, unless one is named; "auto" is the CPU where there is none."""
    if device == "auto" and not gpus:
        return "cpu"
    return f"cuda:{slot % gpus}" if gpus and device in {"auto", "cuda"} else device


def device_name(device: str) -> str:
    """What a reader should know the device as."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU"


def _labelled(frames: Frames, split: Literal["train", "test"]) -> tuple[NDArray[np.int64], pd.DataFrame]:
    indices = frames.indices(split)
    return indices, frames.labels.iloc[indices].reset_index(drop=True)
