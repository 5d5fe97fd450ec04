"""A trained cell as one network, from images to the commands of every policy, exported to a file without pickle.

The file is torch.export's archive: raw tensors and a graph of torch's own operations as JSON. It needs only torch to
run, and it cannot carry code, as a pickled module can.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from study.config.paper import LATENT
from study.encoder.inputs import to_float
from study.encoder.networks import encoder_of
from study.policy.networks import WIDTHS, through
from study.results.cell_result import CellResult


class Policies(nn.Module):
    """The S policies on an encoder, with the weights of a CellResult."""

    def __init__(self, policies: Mapping[str, NDArray[Any]]) -> None:
        super().__init__()
        self.unit_length = bool(policies["z_l2"][0])
        for name, value in policies.items():
            if name != "z_l2":
                self.register_buffer(name, torch.from_numpy(np.array(value)))

    def decide(self, z: Tensor) -> dict[str, Tensor]:
        """Return the commands of all policies for z [B, Z], or each policy's for its own z [S, 1, Z].

        "steering" [S, B] and "acceleration" [S, B, 3] float32, the logits of ACCELERATIONS, without dropout.
        """
        z = (z - self.get_buffer("z_mean")) / self.get_buffer("z_std")
        if self.unit_length:
            z = nn.functional.normalize(z, dim=-1, eps=torch.finfo(z.dtype).tiny)
        outputs = {
            name: through(
                [
                    (self.get_buffer(f"{name}_{layer}_weight"), self.get_buffer(f"{name}_{layer}_bias")[:, None])
                    for layer in range(len(widths) - 1)
                ],
                z,
            )
            for name, widths in WIDTHS.items()
        }
        return {"steering": outputs["steering"][..., 0], "acceleration": outputs["acceleration"]}


class Driver(Policies):
    """An encoder and the policies on it: images [B, 3, 64, 64] float32 in [0, 1] to the commands of `decide`."""

    def __init__(self, encoder: Mapping[str, NDArray[Any]], policies: Mapping[str, NDArray[Any]]) -> None:
        super().__init__(policies)
        self.encoder = encoder_of(encoder)

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        """Return the commands of all policies for images."""
        return self.decide(self.encoder(images))


def export_driver(result: CellResult) -> bytes:
    """Return the cell's Driver as a .pt2 archive that takes batches of any size, in about a second.

    Empty where policies were given more than images show (`policy.inputs`).
    """
    if len(result.policies["z_mean"]) != LATENT:
        return b""
    driver = Driver(result.encoder, result.policies).eval()
    images = to_float(torch.from_numpy(result.samples["input"][:1])).repeat(2, 1, 1, 1)  # one would become a constant
    with torch.no_grad():
        program = torch.export.export(driver, (images,), dynamic_shapes=({0: torch.export.Dim.DYNAMIC},))
    archive = io.BytesIO()
    torch.export.save(program, archive)
    return archive.getvalue()
