"""Which device a cell is trained on."""

from collections import Counter

import pytest

from study.cell import slot_device


@pytest.mark.parametrize("gpus", [1, 2, 3, 8])
@pytest.mark.parametrize("workers", [1, 2, 3, 7, 8])
def test_workers_share_the_gpus_evenly(gpus, workers):
    load = Counter(slot_device("auto", slot, gpus) for slot in range(workers))
    assert set(load) <= {f"cuda:{number}" for number in range(gpus)}
    assert len(load) == min(gpus, workers)
    assert max(load.values()) - min(load.values()) <= 1


def test_without_a_gpu_every_worker_is_on_the_cpu():
    assert {slot_device("auto", slot, 0) for slot in range(4)} == {"cpu"}


def test_cuda_without_a_number_is_any_gpu_but_never_the_cpu():
    assert [slot_device("cuda", slot, 2) for slot in range(3)] == ["cuda:0", "cuda:1", "cuda:0"]
    assert slot_device("cuda", 1, 0) == "cuda"


@pytest.mark.parametrize("device", ["cpu", "cuda:1"])
def test_a_named_device_is_every_workers(device):
    assert {slot_device(device, slot, 4) for slot in range(6)} == {device}
