"""Choose the device and the precision that training computes in."""

from __future__ import annotations

import contextlib
import ctypes
import resource
import sys
from typing import Any, Literal

import torch

from study.compute.provenance import cpu_lines
from study.errors import BadInputError, one_of

APPLE = "Apple GPU"


def check_device(name: str) -> torch.device:
    """Return the torch device of that name. Raises BadInputError when this machine lacks it."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise one_of("device", name, ("cpu", "cuda", "cuda:0", "...", "mps")) from error
    if device.type == "cpu":
        return torch.device("cpu")
    apple = torch.backends.mps.is_available()
    if device.type == "mps" and apple and not device.index:
        return torch.device("mps")
    count = torch.cuda.device_count()
    if device.type != "cuda" or (device.index or 0) >= count:
        names = ["cpu", *(f"cuda:{index}" for index in range(count)), *["mps"] * apple]
        raise BadInputError(f"device '{name}' is not on this machine; choose from {', '.join(names)}")
    return torch.device("cuda", device.index or 0)


def choose_precision(setting: Literal["auto", "fp32", "bf16"], device: torch.device) -> Literal["fp32", "bf16"]:
    """Return the precision of training; "auto" is bf16 where the hardware multiplies bf16 matrices itself.

    Raises BadInputError for bf16 on an Apple GPU.
    """
    if device.type == "mps":
        if setting == "bf16":
            raise BadInputError("encoder.precision bf16 is not available on device 'mps'; choose from auto, fp32")
        return "fp32"
    if setting != "auto":
        return setting
    if device.type == "cuda":
        native = torch.cuda.get_device_capability(device) >= (8, 0)
    else:
        native = not {"amx_bf16", "avx512_bf16"}.isdisjoint(cpu_lines("flags")[0].split())
    return "bf16" if native else "fp32"


def keep_memory() -> None:
    """Let glibc keep freed blocks: returning each costs a third of the speed at batch 2048 (page faults).

    Blocks above 150 MB are still returned: kept, they would leave gaps, and the paper's batch would take 5 GB, not 4.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        mmap_threshold, trim_threshold = -3, -1  # names in malloc.h
        libc.mallopt(mmap_threshold, 150_000_000)
        libc.mallopt(trim_threshold, 2**31 - 1)


def choose_device(name: str) -> str:
    """Return the torch device for "auto" or a device's name. Raises BadInputError when this machine lacks it."""
    if name in {"auto", "cuda"} or (name.startswith("cuda") and torch.cuda.device_count() == 1):
        # A worker sees the one GPU that is its own, under the number 0.
        name = "cuda:0" if torch.cuda.is_available() or name != "auto" else "cpu"
    return str(check_device(name))


def device_name(device: str) -> str:
    """Return the device's name for readers."""
    if device == "mps":
        return APPLE
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU"


def describe_determinism() -> dict[str, Any]:
    """Return torch's flags that trade equal bits for speed, and the vector instructions it uses on a CPU."""
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


def peak_bytes() -> int:
    """Return the most memory that this process has held so far."""
    unit = 1 if sys.platform == "darwin" else 1024  # [bytes]; macOS counts bytes, Linux KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
