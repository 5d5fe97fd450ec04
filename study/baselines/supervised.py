"""A network of the encoder's shape and the policies', trained end to end on the commands of the policy set.

It shows what the images alone let a network of this size learn from the policy set, without any pretraining. Policies
are then trained on its frozen latent, as on every other.
"""

from __future__ import annotations

import itertools
import math

import lightning
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from study.baselines.inputs import BaselineInputs, Z, learned
from study.compute.device import check_device, keep_memory
from study.compute.trainer import trainer
from study.config.paper import ACCELERATION_HIDDEN, ACCELERATIONS, DROPOUT, LATENT, STEERING_HIDDEN
from study.encoder.inputs import to_float
from study.encoder.latents import encode
from study.encoder.networks import initialise, seeded_generator, untrained_encoder
from study.errors import TrainingDivergedError
from study.products import Arrays
from study.randomness import rng
from study.stages import SUPERVISED_EPOCHS


def supervised_latents(inputs: BaselineInputs) -> Z:
    """Return the latents of the trained network. Raises TrainingDivergedError for a loss that is not finite."""
    images = inputs.store.policy.images
    return encode(supervised_weights(inputs), images, np.arange(len(images)), device=inputs.device)


def supervised_weights(inputs: BaselineInputs) -> Arrays:
    """Return the weights of the trained encoder."""
    return learned(inputs, lambda: _train(inputs))


def _train(inputs: BaselineInputs) -> Arrays:
    device = check_device(inputs.device)
    if device.type == "cpu":
        keep_memory()
    network = _Supervised(inputs)
    load = f"batch {inputs.settings.encoder.batch}"
    with trainer(device, SUPERVISED_EPOCHS, load, "lower --encoder.batch") as lightning_trainer:
        lightning_trainer.fit(network, train_dataloaders=range(network.batches))
    return {name: value.numpy(force=True) for name, value in network.encoder.state_dict().items()}


class _Head(nn.Module):
    """Fully connected layers with ReLU and dropout after all but the last (Sec. IV-C)."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(widths))

    def forward(self, z: Tensor, generator: torch.Generator) -> Tensor:
        *hidden, last = self.layers
        for layer in hidden:
            z = layer(z).relu()
            z = z * (torch.rand(z.shape, generator=generator, device=z.device) >= DROPOUT) / (1 - DROPOUT)
        output: Tensor = last(z)
        return output


class _Supervised(lightning.LightningModule):
    """The encoder, and on its latent both policy networks, with the policies' loss."""

    def __init__(self, inputs: BaselineInputs) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.inputs, self.images = inputs, inputs.store.policy.images
        settings, labels = inputs.settings, inputs.store.policy.labels
        self.train_rows = inputs.store.policy.subset(settings.policy.share, "frame", settings.frames.seed)
        self.batches = math.ceil(len(self.train_rows) / settings.encoder.batch)
        self.commands = (
            torch.tensor(labels["steering"].to_numpy(np.float32)),
            torch.tensor(labels["acceleration"].to_numpy(np.int64)),
        )
        self.encoder = untrained_encoder(inputs.seed)
        self.heads = nn.ModuleDict(
            {
                "steering": _Head(LATENT, *STEERING_HIDDEN, 1),
                "acceleration": _Head(LATENT, *ACCELERATION_HIDDEN, len(ACCELERATIONS)),
            }
        )
        initialise(self.heads, seeded_generator(inputs.seed, "supervised heads"))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=self.inputs.settings.encoder.lr, fused=True)

    def on_train_epoch_start(self) -> None:
        seed, purpose = self.inputs.seed, f"supervised epoch {self.current_epoch}"
        self.parts = np.array_split(rng(seed, purpose).permutation(self.train_rows), self.batches)
        self.dropout = seeded_generator(seed, f"{purpose} dropout", self.device)

    def training_step(self, batch: int) -> None:
        rows = np.sort(self.parts[batch])
        steering, acceleration = (values[rows].to(self.device) for values in self.commands)
        z = self.encoder(to_float(torch.from_numpy(self.images[rows]).to(self.device)))
        loss: Tensor = functional.smooth_l1_loss(self.heads["steering"](z, self.dropout).squeeze(1), steering)
        loss = loss + functional.cross_entropy(self.heads["acceleration"](z, self.dropout), acceleration)
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        self.inputs.progress(self.current_epoch * self.batches + batch + 1, SUPERVISED_EPOCHS * self.batches)
        if not math.isfinite(value := float(loss.detach())):
            raise TrainingDivergedError(
                f"baseline supervised: the loss is {value} in epoch {self.current_epoch + 1}; lower --encoder.lr"
            )
