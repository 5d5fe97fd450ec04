"""The GPUs of this machine, without loading torch where there are none."""

from __future__ import annotations

import os
from pathlib import Path

GPU_DRIVERS = ("/dev/nvidiactl", "/dev/kfd", "/dev/dxg")  # of CUDA, ROCm, and either in WSL


def visible_gpus(device: str) -> list[str]:
    """Return CUDA's names of the GPUs that `--device` asks for: all of them for auto and cuda, one for cuda:N.

    An Apple GPU ("mps") is used only when asked for by name: nobody has compared it with a CPU yet.
    """
    if device == "mps":
        return ["mps"]
    if device == "cpu" or (device == "auto" and not any(Path(file).exists() for file in GPU_DRIVERS)):
        return []
    import torch  # noqa: PLC0415 - takes seconds that a CPU run can do without

    names = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    count = torch.cuda.device_count()
    visible = names[:count] if len(names) >= count and names != [""] else [str(number) for number in range(count)]
    if device.startswith("cuda:"):
        return visible[int(device.removeprefix("cuda:")) :][:1]
    return visible
