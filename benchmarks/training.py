"""Training against what one would write first: `python benchmarks/training.py [laptop|paper]`.

Policies: all 15 seeds by `study.policy` against one plain Lightning fit (nn.Sequential, DataLoader over a
TensorDataset, validation after each epoch), times 15. Both are timed by the epoch, side by side in one process and turn
about, so that a busy machine slows both; what is printed is medians with the lowest and highest. Latents are random:
values cost no time. OMP_NUM_THREADS=1 keeps both on one core: on a busy machine torch's threads wait for each other at
every operation, which slows the plain fit out of all proportion.
"""

from __future__ import annotations

import itertools
import json
import logging
import platform
import sys
import time
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader, TensorDataset

from study.config import DROPOUT, PolicySettings
from study.policy import WIDTHS, train_policies

RESULT = Path(__file__).parent / "results" / "training.json"
SIZES = {"laptop": (10_000, 2_500, 512), "paper": (64_000, 16_000, 2048)}  # train, test, batch
SEEDS = 15
ROUNDS = 3
EPOCHS = 5  # of each fit; the first is not counted


class PlainPolicy(lightning.LightningModule):
    """One policy as the paper's text reads."""

    def __init__(self) -> None:
        super().__init__()
        self.networks = nn.ModuleDict()
        for name, widths in WIDTHS.items():
            layers: list[nn.Module] = []
            for before, after in itertools.pairwise(widths):
                layers += [nn.Linear(before, after), nn.ReLU(), nn.Dropout(DROPOUT)]
            self.networks[name] = nn.Sequential(*layers[:-2])
        self.ends: list[float] = []

    def _losses(self, batch: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        z, steering, acceleration = batch
        logits = self.networks["acceleration"](z)
        accuracy = (logits.argmax(1) == acceleration).float().mean()
        error = functional.smooth_l1_loss(self.networks["steering"](z)[:, 0], steering)
        return error, functional.cross_entropy(logits, acceleration), accuracy

    def training_step(self, batch: list[Tensor]) -> Tensor:
        """One batch."""
        error, surprise, accuracy = self._losses(batch)
        self.log_dict({"steering_loss": error, "accuracy": accuracy}, on_epoch=True, on_step=False)
        return error + surprise

    def validation_step(self, batch: list[Tensor]) -> None:
        """One batch of the test split."""
        error, surprise, accuracy = self._losses(batch)
        self.log_dict({"val_steering_loss": error, "val_cross_entropy": surprise, "val_accuracy": accuracy})

    def on_train_epoch_end(self) -> None:
        """Note the time."""
        self.ends.append(time.perf_counter())

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.parameters(), lr=5e-4)


def latents(frames: int, seed: int) -> tuple[np.ndarray, pd.DataFrame]:
    """Latents and labels of the right kind."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(frames, 64)).astype(np.float32)
    return z, pd.DataFrame({"steering": np.tanh(z[:, 0]) / 4, "acceleration": np.digitize(z[:, 1], [-0.5, 0.5])})


def stacked_epochs(train: Any, test: Any, batch: int) -> list[float]:
    """Seconds of each epoch of all seeds, measuring included."""
    ends: list[float] = []
    train_policies(
        train[0],
        test[0],
        train[1],
        test[1],
        range(SEEDS),
        PolicySettings(epochs=EPOCHS, batch=batch),
        log=lambda *_: ends.append(time.perf_counter()),
    )
    return list(np.diff(ends))


def plain_epochs(train: Any, test: Any, batch: int) -> list[float]:
    """Seconds of each epoch of one plain fit, validation included."""
    sets = [
        TensorDataset(
            torch.from_numpy(z),
            torch.tensor(labels["steering"].to_numpy(np.float32)),
            torch.tensor(labels["acceleration"].to_numpy(np.int64)),
        )
        for z, labels in (train, test)
    ]
    policy = PlainPolicy()
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=EPOCHS,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(policy, DataLoader(sets[0], batch, shuffle=True), DataLoader(sets[1], batch))
    return list(np.diff(policy.ends))


def spread(values: Iterable[float]) -> dict[str, float]:
    """Median, lowest and highest."""
    values = sorted(values)
    return {"median": float(np.median(values)), "low": values[0], "high": values[-1], "n": len(values)}


def policies(size: str) -> dict[str, Any]:
    """Seconds an epoch of 15 policies, stacked and one after the other, and how many times faster the stack is."""
    frames, tests, batch = SIZES[size]
    train, test = latents(frames, 0), latents(tests, 1)
    ours, theirs, ratios = [], [], []
    for _ in range(ROUNDS):
        before = plain_epochs(train, test, batch)
        stack = stacked_epochs(train, test, batch)
        after = plain_epochs(train, test, batch)
        ours += stack
        theirs += [SEEDS * seconds for seconds in before + after]
        ratios.append(SEEDS * float(np.median(before + after)) / float(np.median(stack)))
    return {
        "frames": [frames, tests],
        "batch": batch,
        "seeds": SEEDS,
        "seconds_per_epoch": spread(ours),
        "seconds_per_epoch_sequential": spread(theirs),
        "ratio_to_sequential": spread(ratios)["median"],
        "ratio_spread": spread(ratios),
    }


def main() -> None:
    """Measure, print, and keep the result."""
    warnings.simplefilter("ignore")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    size = sys.argv[1] if len(sys.argv) > 1 else "laptop"
    result = json.loads(RESULT.read_text()) if RESULT.exists() else {"encoder": None, "policies": None, "gpu": None}
    result["machine"] = {"cores": torch.get_num_threads(), "processor": platform.processor() or platform.machine()}
    measured = policies(size)
    print(json.dumps(measured, indent=1))
    sizes = (result["policies"] or {}) | {size: measured}
    ratios = [sizes[name]["ratio_to_sequential"] for name in SIZES if name in sizes]
    result["policies"] = sizes | {"ratio_to_sequential": min(ratios)}
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
