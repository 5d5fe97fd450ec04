"""Encoders on a GPU at the paper's batch, compiled and not: `python benchmarks/gpu.py`. Two minutes.

For each head set: time of a training step and of a batch of the test split, with the losses, gradients and optimiser of
a sweep, in bf16, on random data that lie on the GPU; compiling; memory; and how far losses and gradients are from
float32. A sweep adds Lightning and its reports. `--quick` tries everything on any device with little data.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from study.compute.device import check_device, choose_device, device_name
from study.compute.provenance import provenance
from study.config.heads import HEAD_SETS, mask_heads
from study.config.paper import IMAGE
from study.config.settings import EncoderSettings
from study.encoder.autoencoder import MultiHeadAutoencoder

RESULT = Path(__file__).parent / "results" / "gpu.json"
BATCH, STEPS, WARM = 2048, 60, 5

Batch = tuple[Tensor, Tensor]


def random_batch(size: int, device: torch.device) -> Batch:
    """Return images [B, 64, 64, 3] and packed masks [B, K, 512], uint8."""
    shapes = (size, IMAGE, IMAGE, 3), (size, len(mask_heads()), IMAGE**2 // 8)
    images, masks = (torch.randint(0, 256, shape, dtype=torch.uint8, device=device) for shape in shapes)
    return images, masks


def build(heads: str, device: torch.device) -> MultiHeadAutoencoder:
    """Return an encoder with its heads, as `train_encoder` builds it on a GPU."""
    return MultiHeadAutoencoder(heads, EncoderSettings(), 0).to(device).to(memory_format=torch.channels_last)


def seconds(work: Callable[[], Any], device: torch.device, steps: int) -> float:
    """Return the seconds of one call, after some that are not counted."""
    started = 0.0
    for step in range(WARM + steps):
        if step == WARM:
            torch.cuda.synchronize() if device.type == "cuda" else None
            started = time.perf_counter()
        work()
    torch.cuda.synchronize() if device.type == "cuda" else None
    return (time.perf_counter() - started) / steps


def measure(heads: str, device: torch.device, batch: Batch, steps: int, *, compiled: bool) -> dict[str, Any]:
    """Return times, memory and errors of one head set."""
    module, cast = build(heads, device), lambda: torch.autocast(device.type, torch.bfloat16, cache_enabled=False)
    if compiled:
        module.fuse()
    optimiser = torch.optim.Adam(module.parameters(), lr=5e-3, fused=True)

    def train() -> None:
        module.train()
        optimiser.zero_grad()
        with cast():
            module.gradients(*batch, None)
        optimiser.step()

    def test() -> None:
        module.eval()
        with torch.inference_mode(), cast():
            module.validation_step(batch)

    started = time.perf_counter()
    train()
    test()
    ready = time.perf_counter() - started
    train_s, test_s = seconds(train, device, steps), seconds(test, device, steps)
    peak = torch.cuda.max_memory_allocated() if device.type == "cuda" else None
    reference, fast = build(heads, device), build(heads, device)
    expected = reference.gradients(*batch, None)
    with cast():
        losses = fast.gradients(*batch, None)
    pairs = [
        (mine.grad, theirs.grad)
        for mine, theirs in zip(fast.parameters(), reference.parameters(), strict=True)
        if mine.grad is not None and theirs.grad is not None
    ]
    wrong = sum(float((mine - theirs).square().sum()) for mine, theirs in pairs)
    right = sum(float(theirs.square().sum()) for _, theirs in pairs)
    return {
        "heads": heads,
        "compiled": compiled,
        "ready_s": ready,
        "train_ms": 1000 * train_s,
        "test_ms": 1000 * test_s,
        "images_per_s": len(batch[0]) / train_s,
        "peak_bytes": peak,
        "loss_error": float(((losses - expected) / expected).abs().max()),
        "gradient_error": (wrong / right) ** 0.5,
    }


def main() -> None:
    """Measure every head set and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto", help="as in a sweep [a GPU where there is one]")
    parser.add_argument("--quick", action="store_true", help="keep nothing")
    given = parser.parse_args()
    name = choose_device(given.device)
    device = check_device(name)
    torch.backends.cudnn.benchmark = True
    batch, steps = random_batch(8 if given.quick else BATCH, device), 2 if given.quick else STEPS
    rows = []
    for heads in HEAD_SETS:
        for compiled in (False,) if given.quick else (False, True):
            rows.append(measure(heads, device, batch, steps, compiled=compiled))
            print(json.dumps(rows[-1]), flush=True)
    if not given.quick:
        RESULT.write_text(json.dumps({"device": device_name(name), "rows": rows, "provenance": provenance()}, indent=1))


if __name__ == "__main__":
    main()
