"""The engine of this machine: one worker process for each core and GPU."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Sequence
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path

from distributed import Client, Nanny, Scheduler, SpecCluster

from study.engine.dask_engine import GPU, DaskEngine, configure_dask


def local_engine(workers: int, scratch: Path, gpus: Sequence[str] = ()) -> DaskEngine:
    """Start workers on this machine, behind a scheduler that listens on loopback.

    Args:
        workers: processes of one task at a time each; one more is started for each GPU.
        scratch: folder for the workers' temporary files.
        gpus: CUDA's names of the GPUs to use, such as "0".
    """
    configure_dask()
    options = {
        "nthreads": 1,
        "memory_limit": 0,
        "local_directory": str(scratch.absolute()),
        "host": "127.0.0.1",
        "dashboard": False,
        "silence_logs": logging.CRITICAL,
    }
    # Only a worker with a GPU may see it: tasks for a CPU must not open one by chance.
    kinds = [{"resources": {GPU: 1}, "env": {"CUDA_VISIBLE_DEVICES": name}} for name in gpus]
    kinds += [{"env": {"CUDA_VISIBLE_DEVICES": ""}} if gpus else {} for _ in range(workers)]
    address = {"host": "127.0.0.1", "port": 0, "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    _start_resource_tracker()  # starting it later would unblock the signal
    # A terminal sends Ctrl-C to every process, and this process alone handles it. Threads that start here inherit the
    # blocked signal, and so do the workers.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        cluster = SpecCluster(
            workers={index: {"cls": Nanny, "options": {**options, **kind}} for index, kind in enumerate(kinds)},
            scheduler={"cls": Scheduler, "options": address},
            silence_logs=logging.CRITICAL,
        )
        client = Client(cluster, timeout=60)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    # A worker that does not come back in time is given up by Dask, and started anew when the cluster is scaled again.
    return DaskEngine(client, cluster.scheduler_address, cluster, partial(cluster.scale, len(kinds)))


def _start_resource_tracker() -> None:
    """Start Python's resource tracker, which removes the semaphores of Dask's queues when this process ends at once.

    Its warning of "leaked semaphore objects" is filtered out: a stopped command leaves them to it on purpose.
    """
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [before, "ignore:resource_tracker:UserWarning"]))
    try:
        resource_tracker.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before
