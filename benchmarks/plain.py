"""What one would write first, to measure against: Lightning as its documentation shows it, and plain torch layers.

`fit_encoder` trains the paper's encoder and heads on a Dataset of single samples with a DataLoader, `fit_policy` one
policy on a TensorDataset. Both return the seconds of each epoch but the first, validation included.
"""

from __future__ import annotations

import itertools
import logging
import time
import warnings
from typing import Any

import lightning
import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset, TensorDataset

from study.config.heads import HEAD_SETS, HEADS
from study.config.paper import CHANNELS, CORE, DROPOUT, IMAGE, KERNEL, LATENT, STRIDE
from study.data.frames import Frames
from study.policy.networks import WIDTHS

WORKERS = 2  # of the encoder's DataLoader


class Timed(lightning.LightningModule):
    """Notes when each epoch ended."""

    def __init__(self) -> None:
        super().__init__()
        self.ends: list[float] = []

    def on_train_epoch_end(self) -> None:
        """Note the time."""
        self.ends.append(time.perf_counter())


def fit(module: Timed, train: DataLoader, test: DataLoader, epochs: int, precision: str) -> list[float]:
    """Train; seconds of each epoch but the first."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
        trainer = lightning.Trainer(
            accelerator="cpu",
            max_epochs=epochs,
            precision=precision,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
        )
        trainer.fit(module, train, test)
    return list(np.diff(module.ends))


# --- an encoder -----------------------------------------------------------------------------------------------------


class Samples(Dataset):
    """One frame at a time, as floats."""

    def __init__(self, frames: Frames, rows: np.ndarray, heads: str) -> None:
        self.frames, self.rows = frames, rows
        self.masks = [("pred", "plan").index(head) for head in HEAD_SETS[heads].heads if head != "rec"]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        row = self.rows[index]
        image = torch.from_numpy(self.frames.images[row]).permute(2, 0, 1).float() / 255
        masks = np.unpackbits(self.frames.masks[row][self.masks], axis=-1).reshape(-1, IMAGE, IMAGE)
        return image, torch.from_numpy(masks).float()


class PlainAutoencoder(Timed):
    """The paper's encoder and the heads of a set, of torch's own layers."""

    def __init__(self, heads: str, lr: float) -> None:
        super().__init__()
        self.lr = lr
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise((HEADS["rec"].channels, *CHANNELS)):
            layers += [nn.Conv2d(before, after, KERNEL, STRIDE), nn.BatchNorm2d(after), nn.ReLU()]
        core = CHANNELS[-1] * CORE * CORE
        self.encoder = nn.Sequential(*layers, nn.Flatten(), nn.Linear(core, LATENT))
        self.heads = nn.ModuleDict()
        for head in HEAD_SETS[heads].heads:
            layers = [nn.Linear(LATENT, core), nn.BatchNorm1d(core), nn.ReLU()]
            layers += [nn.Unflatten(1, (CHANNELS[-1], CORE, CORE))]
            for (before, after), extra in zip(itertools.pairwise(CHANNELS[::-1]), (0, 1), strict=True):
                layers += [nn.ConvTranspose2d(before, after, KERNEL, STRIDE, output_padding=extra)]
                layers += [nn.BatchNorm2d(after), nn.ReLU()]
            self.heads[head] = nn.Sequential(
                *layers, nn.ConvTranspose2d(CHANNELS[0], HEADS[head].channels, KERNEL, STRIDE)
            )

    def _loss(self, batch: list[Tensor], split: str) -> Tensor:
        image, masks = batch
        targets = [image, *(masks[:, [index]] for index in range(masks.shape[1]))]
        z = self.encoder(image)
        losses = {
            f"{split}_{name}": functional.binary_cross_entropy_with_logits(head(z), target)
            for (name, head), target in zip(self.heads.items(), targets, strict=True)
        }
        self.log_dict(losses, on_epoch=True, on_step=False)
        return sum(losses.values())  # type: ignore[return-value]

    def training_step(self, batch: list[Tensor]) -> Tensor:
        """One batch."""
        return self._loss(batch, "train")

    def validation_step(self, batch: list[Tensor]) -> None:
        """One batch of the test split."""
        self._loss(batch, "test")

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.parameters(), lr=self.lr)


def fit_encoder(frames: Frames, heads: str, batch: int, epochs: int, precision: str) -> list[float]:
    """Seconds of each epoch but the first; precision as Lightning names it, e.g. "32-true"."""
    options: dict[str, Any] = {"num_workers": WORKERS, "persistent_workers": True}
    train = DataLoader(Samples(frames, frames.indices("train"), heads), batch, shuffle=True, **options)
    test = DataLoader(Samples(frames, frames.indices("test"), heads), batch, **options)
    return fit(PlainAutoencoder(heads, 2e-3), train, test, epochs, precision)


# --- a policy -------------------------------------------------------------------------------------------------------


class PlainPolicy(Timed):
    """One policy as the paper's text reads."""

    def __init__(self, lr: float) -> None:
        super().__init__()
        self.lr = lr
        self.networks = nn.ModuleDict()
        for name, widths in WIDTHS.items():
            layers: list[nn.Module] = []
            for before, after in itertools.pairwise(widths):
                layers += [nn.Linear(before, after), nn.ReLU(), nn.Dropout(DROPOUT)]
            self.networks[name] = nn.Sequential(*layers[:-2])

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

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.parameters(), lr=self.lr)


Labelled = tuple[np.ndarray, pd.DataFrame]


def fit_policy(train: Labelled, test: Labelled, batch: int, epochs: int) -> list[float]:
    """Seconds of each epoch but the first, on latents with their labels."""
    sets = [
        TensorDataset(
            torch.from_numpy(z),
            torch.tensor(labels["steering"].to_numpy(np.float32)),
            torch.tensor(labels["acceleration"].to_numpy(np.int64)),
        )
        for z, labels in (train, test)
    ]
    loaders = DataLoader(sets[0], batch, shuffle=True), DataLoader(sets[1], batch)
    return fit(PlainPolicy(5e-4), *loaders, epochs, "32-true")
