"""Draws sweep records from known effects: real values of the real types, without any training."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from study.config.grid import Grid
from study.config.heads import HEAD_SETS
from study.config.paper import ACCELERATION_HIDDEN, CHANNELS, CORE, KERNEL, LATENT, STEERING_HIDDEN
from study.config.settings import StudySettings
from study.results.cell_result import CURVE_COLUMNS, NO_SEED, CellResult
from study.results.sweep_record import SweepRecord

FRAMES, EPISODES, SAMPLES = 600, 15, 16


@dataclass(frozen=True)
class World:
    """Holds the true effects of a study: accuracies and time constants by head set, noise by level."""

    accuracy: dict[str, float] = field(
        default_factory=lambda: {"rec": 0.78, "rec+pred": 0.83, "rec+plan": 0.88, "full": 0.93}
    )
    time: dict[str, float] = field(
        default_factory=lambda: {"rec": 28.0, "rec+pred": 20.0, "rec+plan": 12.0, "full": 9.0}
    )
    spread: dict[str, float] = field(
        default_factory=lambda: {"rec": 0.03, "rec+pred": 0.016, "rec+plan": 0.012, "full": 0.012}
    )
    by_fraction: float = 0.01  # accuracy lost for each halving of the data, rec; the others lose half of it
    slower: float = 0.25  # share by which learning is slower for each halving of the data
    steering: float = 0.0002
    steering_effect: float = 0.0
    encoder_sd: float = 0.0
    policy_sd: float = 0.002
    epoch_sd: float = 0.0015
    epochs: int = 100
    baselines: dict[str, float] = field(default_factory=lambda: {"trail-pca": 0.8, "supervised": 0.9, "state": 0.97})


HEADS_GRID = Grid(
    name="heads", title="Effect of different heads", heads=tuple(HEAD_SETS), claims=("H0", "H1", "H2", "H3", "H4", "H5")
)
DATASIZE_GRID = Grid(
    name="datasize",
    title="Effect of dataset size",
    heads=("rec", "full"),
    fractions=(1.0, 0.5, 0.25, 0.125, 0.0625),
    claims=("D1", "D2", "D3", "D4"),
)


# --- records --------------------------------------------------------------------------------------------------------


def _rows(seeds, stage, split, metric, values):
    """Return tidy rows of values [S, E]."""
    count, epochs = values.shape
    return pd.DataFrame(
        {
            "policy_seed": np.repeat(seeds, epochs),
            "stage": stage,
            "split": split,
            "epoch": np.tile(np.arange(1, epochs + 1), count),
            "metric": metric,
            "value": values.ravel(),
        }
    )[list(CURVE_COLUMNS)]


def policy_curves(cell, world, seeds, rng):
    """Return accuracy and steering loss by epoch on both splits, [S, E] each."""
    halvings = -np.log2(cell.fraction) * (1.0 if cell.heads == "rec" else 0.5)
    final = (
        world.accuracy.get(cell.heads, world.baselines.get(cell.heads, 0.78))
        - world.by_fraction * halvings
        + rng.normal(0, world.encoder_sd)
    )
    epoch = np.arange(1, world.epochs + 1)
    shape = np.exp(-epoch / (world.time.get(cell.heads, 5.0) * (1 + world.slower * halvings)))
    own = (
        rng.normal(0, world.policy_sd, (seeds, 1))
        + rng.normal(0, world.spread.get(cell.heads, 0.002), (seeds, 1)) * shape
    )
    test = final - 0.3 * shape + own + rng.normal(0, world.epoch_sd, (seeds, world.epochs))
    loss = world.steering * (1 + 2 * shape) + world.steering_effect * (cell.heads != "rec")
    loss = loss * (1 + rng.normal(0, 0.01, (seeds, 1)) + rng.normal(0, 0.005, (seeds, world.epochs)))
    return {
        ("test", "acceleration_accuracy"): test,
        ("train", "acceleration_accuracy"): test + 0.03 * (1 - shape),
        ("test", "balanced_accuracy"): test - 0.004,
        ("train", "balanced_accuracy"): test + 0.026,
        ("test", "steering_loss"): loss,
        ("train", "steering_loss"): loss * 0.9,
        ("test", "cross_entropy"): 1.1 - 0.8 * test,
        ("train", "cross_entropy"): 1.05 - 0.8 * test,
        **{
            (split, metric): values
            for split, shift in (("test", 0.0), ("train", 0.03))
            for metric, values in {
                "keyframe_accuracy": 2 * test - 1 + shift,
                "natural_accuracy": test + 0.02 + shift,
                "natural_steering_loss": loss * 0.8,
            }.items()
        },
    }


def simulate_cell(cell, key, settings, world, seeds, rng, labels):
    """Return a complete result: curves, pictures, predictions whose accuracy is the last epoch's."""
    curves = policy_curves(cell, world, seeds, rng)
    parts = [_rows(np.arange(seeds), "policy", split, metric, values) for (split, metric), values in curves.items()]
    heads = HEAD_SETS[cell.heads].heads if cell.heads in HEAD_SETS else ()  # the ceiling has no encoder
    for split in ("train", "test") if heads else ():
        losses = {head: (0.05 + 0.4 * np.exp(-np.arange(settings.encoder.epochs) / 4))[None] for head in heads}
        parts += [_rows(np.array([NO_SEED]), "encoder", split, f"loss_{head}", loss) for head, loss in losses.items()]
        parts.append(_rows(np.array([NO_SEED]), "encoder", split, "loss", sum(losses.values())))
    acceleration, steering, episode = labels
    accuracy = curves["test", "acceleration_accuracy"][:, -1:]
    wrong = rng.random((seeds, FRAMES)) > accuracy
    guess = (acceleration + wrong * rng.integers(1, 3, (seeds, FRAMES))) % 3
    images = _pictures(rng)
    samples = {"input": images, "rec_output": (images * 0.9 + 12).astype(np.uint8)} if heads else {}
    for head in set(heads) - {"rec"}:
        mask = np.where(images.max(axis=3) > 180, 255, 0).astype(np.uint8)
        samples |= {f"{head}_target": mask, f"{head}_output": (mask * 0.7 + 20).astype(np.uint8)}
    return CellResult(
        cell=cell,
        key=key,
        settings=settings.model_dump(mode="json") | {"policy_seeds": seeds, "frames_key": "f" * 16},
        curves=pd.concat(parts, ignore_index=True),
        encoder=_encoder() if heads else {},
        policies=_policies(seeds),
        samples=samples,
        predictions={
            "acceleration": guess.astype(np.uint8),
            "steering": (steering + rng.normal(0, 0.02, (seeds, FRAMES))).astype(np.float32),
            "acceleration_label": acceleration,
            "steering_label": steering,
            "episode": episode,
            "speed": (10 * rng.random(FRAMES) * (acceleration > 0)).astype(np.float32),
            "light": np.where(acceleration == 0, 2, 0).astype(np.uint8),
            "lead_gap": np.where(rng.random(FRAMES) < 0.5, np.nan, 20.0).astype(np.float32),
            "keyframe": np.arange(FRAMES) % 10 < 3,
            "weight": rng.uniform(0.5, 1.5, FRAMES).astype(np.float32),
            "z": (rng.normal(size=(FRAMES, 64)) + np.eye(64)[0] * 2 * acceleration[:, None]).astype(np.float32),
        },
        facts={
            "floor": float(np.bincount(acceleration).max() / FRAMES),
            "heads": {head: {"entropy": 0.04 * (head == "rec"), "constant": 0.4} for head in heads},
            "frames": {
                "encoder_train": round(20_000 * cell.fraction),
                "encoder_test": 5000,
                "policy_train": 10_000,
                "policy_test": FRAMES,
            },
            "seconds": {"encoder": 412.0 * cell.fraction, "encode": 6.1, "policies": 131.0, "cell": 551.0},
            "provenance": {"commit": "0123456789abcdef0123456789abcdef01234567", "time": "2026-05-01T12:00:00+00:00"},
            "peak_bytes": 1_300_000_000,
            "device": "cpu",
            "precision": "fp32",
            "threads": 2,
        },
    )


def _encoder():
    """Return weights of an encoder that maps every image to zero."""
    weights = {"mean.weight": (LATENT, CHANNELS[-1] * CORE * CORE), "mean.bias": (LATENT,)}
    for number, (before, after) in enumerate(itertools.pairwise((3, *CHANNELS))):
        layer = f"convolutions.{3 * number}"
        weights |= {f"{layer}.weight": (after, before, KERNEL, KERNEL), f"{layer}.bias": (after,)}
        layer = f"convolutions.{3 * number + 1}"
        weights |= {f"{layer}.{name}": (after,) for name in ("weight", "bias", "running_mean", "running_var")}
        weights[f"{layer}.num_batches_tracked"] = ()
    return {name: np.zeros(shape, np.int64 if shape == () else np.float32) for name, shape in weights.items()}


def _policies(seeds):
    """Return weights of policies that answer zero for every z."""
    weights = {
        "z_mean": np.zeros(LATENT, np.float32),
        "z_std": np.ones(LATENT, np.float32),
        "z_l2": np.zeros(1, np.uint8),
    }
    for network, widths in (("steering", (*STEERING_HIDDEN, 1)), ("acceleration", (*ACCELERATION_HIDDEN, 3))):
        for layer, (before, after) in enumerate(itertools.pairwise((LATENT, *widths))):
            weights[f"{network}_{layer}_weight"] = np.zeros((seeds, before, after), np.float32)
            weights[f"{network}_{layer}_bias"] = np.zeros((seeds, after), np.float32)
    return weights


def _pictures(rng):
    """Draw simple bird views: road, lane line, route, cars."""
    images = np.zeros((SAMPLES, 64, 64, 3), np.uint8)
    for image in images:
        left = int(rng.integers(18, 30))
        image[:, left : left + 16] = 70
        image[:, left + 8] = 200
        image[:40, left + 3 : left + 5] = (0, 200, 0)
        image[36:44, left + 2 : left + 6] = (40, 60, 255)
        top = int(rng.integers(2, 24))
        image[top : top + 8, left + 10 : left + 14] = (255, 230, 0)
    return images


def simulate(grid=HEADS_GRID, world=None, seed=0, settings=None, unfinished=(), failed=()):
    """Return the record of a sweep. `unfinished` and `failed` are labels of cells without a result."""
    world = world or World()
    settings = settings or StudySettings()
    rng = np.random.default_rng(seed)
    labels = (
        rng.choice(3, FRAMES, p=[0.34, 0.33, 0.33]).astype(np.uint8),
        np.where(rng.random(FRAMES) < 0.4, 0, rng.uniform(-0.2, 0.2, FRAMES)).astype(np.float32),
        np.sort(rng.integers(0, EPISODES, FRAMES)).astype(np.int32),
    )
    planned = {f"{index:016x}": cell for index, cell in enumerate(grid.cells(), 1)}
    results = {
        key: simulate_cell(cell, key, settings, world, grid.policy_seeds, rng, labels) for key, cell in planned.items()
    }
    broken = {key: "TrainingDivergedError: loss is nan" for key, cell in planned.items() if cell.label in failed}
    missing = {key for key, cell in planned.items() if cell.label in (*unfinished, *failed)}
    return SweepRecord(
        grid=grid,
        profile="laptop",
        settings=settings,
        planned=planned,
        results={key: result for key, result in results.items() if key not in missing},
        failed=broken,
        provenance={
            "commit": "0123456789abcdef0123456789abcdef01234567",
            "dirty": False,
            "diff": "",
            "lock": "ab" * 32,
            "packages": {"torch": "2.13.0", "lightning": "2.6.6", "highway-env": "1.12.1", "numpy": "2.4.0"},
            "python": "3.11.9",
            "platform": "Linux 6.1 x86_64",
            "cpu": "A processor at 2.5 GHz",
            "cores": 2,
        },
        data=manifest(),
    )


def manifest():
    """Return the part of a frame store's manifest that the report reads."""

    def labels(frames, drives, classes, near_zero):
        rest = (frames - near_zero) // 6
        return {
            "frames": frames,
            "drives": drives,
            "steering_edges": [-0.15, -0.05, -0.01, 0.01, 0.05, 0.15],
            "steering": [rest, rest, rest, near_zero, rest, rest, rest],
            "acceleration": [round(share * frames) for share in classes],
            "standing": frames // 10,
            "light": [frames // 3] * 3,
            "majority_accuracy": max(classes),
            "steering_beyond_crop": 0.006,
        }

    def one(train, test, classes, near_zero):
        parts = {name: labels(n, 80, classes, round(near_zero * n)) for name, n in (("train", train), ("test", test))}
        all_labels = labels(train + test, 80, classes, round(near_zero * (train + test)))
        candidates = labels(180_000, 80, (0.5, 0.1, 0.4), 120_000)
        return {
            "frames": train + test,
            "train": train,
            "test": test,
            "test_drives": 16,
            "candidates": candidates,
            "chosen": {"all": all_labels, **parts},
        }

    return {
        "schema_version": 1,
        "key": "f" * 16,
        "sources": {name: [{"name": str(i), "digest": "0"} for i in range(80)] for name in ("encoder", "policy")},
        "sets": {
            "encoder": one(20_000, 5000, (0.45, 0.15, 0.4), 0.6),
            "policy": one(10_000, FRAMES, (0.34, 0.33, 0.33), 0.4),
        },
    }
