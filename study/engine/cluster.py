"""Engines of Dask distributed, which supervises every process of a study: this machine's cores, or a cluster.

Worker processes that die are restarted, and their tasks run again elsewhere. Each task computes in one thread of one
worker, so results do not depend on how many workers there are. Workers exit when this process does.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import pickle
import shutil
import signal
import sys
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Self
from urllib.parse import urlsplit

import cloudpickle  # comes with dask
import dask
from distributed import (
    CancelledError,
    Client,
    Future,
    KilledWorker,
    Nanny,
    Scheduler,
    Security,
    SpecCluster,
    get_worker,
)

from study.command import check_stopped
from study.config import BadInputError, masked, one_of, read_yaml
from study.engine.flows import TRIES, WAIT
from study.engine.tasks import Failure, Hear, perform
from study.stages import Task

CONNECT = 10.0  # [s] a scheduler has to answer in
SIZE = 5.0  # [s] between two looks at how many workers there are
SET_BACK = 5.0  # [s] by which this machine's clock may be set back while tasks run
GPU_DRIVERS = ("/dev/nvidiactl", "/dev/kfd", "/dev/dxg")  # of CUDA, ROCm, and either in WSL
GPU = "GPU"  # the resource that a worker with a GPU has one of
CERTIFICATES = {"tls_ca_file": "ca.pem", "tls_client_cert": "cert.pem", "tls_client_key": "key.pem"}
JOB_CLASSES = ("SLURMCluster", "PBSCluster", "SGECluster", "LSFCluster", "OARCluster", "MoabCluster", "HTCondorCluster")
CONFIGURATION = {
    "distributed.scheduler.allowed-failures": TRIES - 1,  # deaths of a worker with a task, before the task is given up
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.worker.daemon": False,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.worker.profile.enabled": False,
    "distributed.admin.large-graph-warning-threshold": "1GB",  # latents travel as arguments
    "distributed.admin.tick.limit": "1h",  # a busy machine is no news
}


class EngineLostError(BadInputError):
    """The scheduler is gone; once there is one again, the same command continues."""


class DaskEngine:
    """Runs tasks on the workers of a Dask scheduler."""

    def __init__(
        self, client: Client, close: Callable[[], None], address: str, renew: Callable[[], object] | None = None
    ) -> None:
        """Take a connected client; `close` ends what was started for it, `renew` replaces workers that were lost."""
        self._client, self._close, self._address, self._renew = client, close, address, renew
        self._topic = f"study-{uuid.uuid4().hex}"
        self._futures: dict[int, Future[Any]] = {}
        self._messages: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
        self._looked, self._slots, self._gpus = 0.0, 0, 0
        self._clock = time.time() - time.monotonic()
        client.subscribe_topic(self._topic, self._take)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:  # else the process is about to exit, and its workers with it: closing would wait for them
            self._close()

    def _take(self, event: tuple[float, tuple[int, tuple[Any, ...]]]) -> None:
        number, values = event[1]
        self._messages.put(("event", number, values))

    def _look(self) -> None:
        if time.monotonic() - self._looked > SIZE or not self._slots:
            with self._lost():
                workers = self._client.scheduler_info(n_workers=-1).get("workers")
            if workers is None:
                raise self._gone()
            workers = workers.values()
            # Never fewer than there were: while a GPU's worker restarts, its tasks must not go to a CPU.
            self._gpus = max(self._gpus, int(sum(worker["resources"].get(GPU, 0) for worker in workers)))
            # A worker with a GPU trains there, and leaves the rest to the others where there are any.
            plain = sum(worker["nthreads"] for worker in workers if not worker["resources"].get(GPU))
            self._slots = plain or sum(worker["nthreads"] for worker in workers)
            self._looked = time.monotonic()
            if self._renew:
                self._renew()

    def slots(self) -> int:
        """Return how many tasks can run at a time, just now; 1 while the cluster has no worker, which waits for it."""
        self._look()
        return max(1, self._slots)

    def gpus(self) -> int:
        """Return how many GPUs the workers have had at most."""
        self._look()
        return self._gpus

    def workers_see(self, file: Path) -> bool:
        """Wait for a worker, and return whether all there are see this file under this path, as in a shared folder."""
        said = False
        while not self._slots:
            self._look()
            if not self._slots and not said:
                print(f"waiting for a worker to come to the scheduler at {self._address}", file=sys.stderr, flush=True)
                said = True
            time.sleep(0 if self._slots else WAIT)
            check_stopped()
        name = str(file)  # a lambda travels by value: workers may lack this program, which the first task says
        with self._lost():
            seen = self._client.run(lambda: os.path.isfile(name))  # noqa: PTH113
        return bool(seen) and all(seen.values())

    def submit(self, number: int, task: Task) -> None:
        """Hand the task to the scheduler."""
        with self._lost():
            future = self._client.submit(
                _UNPACKED,
                cloudpickle.dumps(partial(_run_on_worker, self._topic, number, task)),
                key=f"{task.stage.name}-{uuid.uuid4().hex}",
                pure=False,
                priority=-number,
                resources={GPU: 1} if task.accelerated and self._gpus else None,
            )
        self._futures[number] = future
        future.add_done_callback(lambda _: self._messages.put(("end", number, None)))

    def cancel(self, numbers: Collection[int]) -> None:
        """Forget tasks: those that wait are dropped, those that run end when they next report."""
        for number in numbers:
            self._futures.pop(number, None)  # Dask releases what nobody holds

    def wait(self, seconds: float, hear: Hear) -> list[tuple[int, Any]]:
        """Return what has ended since; see `Engine`. Raises EngineLostError when the scheduler is gone."""
        self._check_clock()
        ended: list[tuple[int, Any]] = []
        deadline = time.monotonic() + seconds
        while not ended or not self._messages.empty():
            try:
                kind, number, values = self._messages.get(timeout=max(0.0, deadline - time.monotonic()))
            except Empty:
                break
            if kind == "event":
                hear(number, *values)
            elif (future := self._futures.pop(number, None)) is not None:
                ended.append((number, self._value(future)))
        if self._client.status != "running":  # what ran is lost to it, even if it connects again
            raise self._gone()
        return ended

    def _check_clock(self) -> None:
        """Raise EngineLostError when the clock was set back: Dask's messages may wait until it has caught up."""
        before, self._clock = self._clock, time.time() - time.monotonic()
        if before - self._clock > SET_BACK:
            raise EngineLostError(
                f"this machine's clock was set back by {before - self._clock:.0f} s, which stops messages between "
                "processes; nothing that was finished is lost: give the same command again"
            )

    def _value(self, future: Future[Any]) -> Any:
        try:
            return future.result()
        except KilledWorker:
            reason = f"the process that ran it was killed {TRIES} times; is memory short?"
            return Failure(reason, transient=True, exhausted=True)
        except CancelledError:
            raise self._gone() from None
        except Exception as error:  # noqa: BLE001 - what kept the task from running at all, such as a missing package
            step = (
                "; install this program and requirements.lock on every worker" if isinstance(error, ImportError) else ""
            )
            return Failure(f"{type(error).__name__}: {error}{step}", transient=False)

    @contextmanager
    def _lost(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, CancelledError) as error:
            raise self._gone() from error

    def _gone(self) -> EngineLostError:
        return EngineLostError(
            f"the scheduler at {self._address} went away; nothing that was finished is lost: start it again, with its "
            "workers, and give the same command"
        )


class _UnwantedError(RuntimeError):
    """Nobody waits for this task any more: its flow has failed, or its client or scheduler is gone."""


# A lambda travels by value: the scheduler needs none of this program, and a worker that lacks a part of it says so in
# the task's failure. A task that Dask itself unpacked there would end the worker, and its flow would wait for ever.
_UNPACKED = lambda packed: pickle.loads(packed)()  # noqa: E731, S301


def _run_on_worker(topic: str, number: int, task: Task) -> Any:
    worker = get_worker()
    key = worker.get_current_task()

    def report(*values: Any) -> None:
        # Dask cannot stop a thread. Ended here, the task leaves the worker free for those who still want something.
        state = worker.state.tasks.get(key)
        if state is None or state.state == "cancelled":
            raise _UnwantedError
        worker.log_event(topic, (number, values))

    return perform(task, report)


# --- this machine ---------------------------------------------------------------------------------------------------


def local_engine(workers: int, scratch: Path, gpus: Sequence[str] = ()) -> DaskEngine:
    """Start workers on this machine, behind a scheduler that listens on loopback.

    Args:
        workers: processes of one task at a time each; one more is started for each GPU.
        scratch: folder for the workers' temporary files.
        gpus: CUDA's names of the GPUs to use, such as "0".
    """
    _configure()
    options = {
        "nthreads": 1,
        "memory_limit": 0,
        "local_directory": str(scratch.absolute()),
        "host": "127.0.0.1",
        "dashboard": False,
        "silence_logs": logging.CRITICAL,
    }
    # Only workers with a GPU may see it: what computes on a CPU must not open one by chance.
    kinds = [{"resources": {GPU: 1}, "env": {"CUDA_VISIBLE_DEVICES": name}} for name in gpus]
    kinds += [{"env": {"CUDA_VISIBLE_DEVICES": ""}} if gpus else {} for _ in range(workers)]
    address = {"host": "127.0.0.1", "port": 0, "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    resource_tracker.ensure_running()  # its start would lift the mask again
    # Ctrl-C reaches every process of a terminal, and is this one's to answer. The threads that are born here never see
    # it, nor do the workers that they start, from their first moment on.
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
    return DaskEngine(client, partial(_close, client, cluster), cluster.scheduler_address)


def _close(client: Client, cluster: Any = None) -> None:
    with suppress(OSError, TimeoutError):
        client.close()
        if cluster is not None:
            cluster.close()


def _configure() -> None:
    """Set Dask's configuration for this process and the workers that it starts."""
    dask.config.set(CONFIGURATION)
    for name in ("distributed", "distributed.client", "distributed.core", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


# --- many machines --------------------------------------------------------------------------------------------------


def cluster_engine(cluster: str, certificates: Path | None = None) -> DaskEngine:
    """Connect to a scheduler's address, or start the dask-jobqueue cluster that a YAML file describes.

    Raises BadInputError for an address that does not answer or is not secured, certificates that do not match, and a
    file that cannot be used.
    """
    check_cluster(cluster, certificates)
    _configure()
    if is_file(cluster):
        return start_jobs(*read_jobs(Path(cluster)), cluster)
    security = _security(certificates) if certificates else None
    try:
        client = Client(cluster, security=security, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise BadInputError(
            f"no Dask scheduler answers at {masked(cluster)} within {CONNECT:.0f} s ({reason}); start one with 'dask "
            "scheduler', check address and port, and for tls:// that --certificates holds its certificates"
        ) from None
    return DaskEngine(client, partial(_close, client), masked(cluster))


def is_file(cluster: str) -> bool:
    """Return whether --cluster names a YAML file, not an address."""
    return cluster.endswith((".yaml", ".yml"))


def check_cluster(cluster: str, certificates: Path | None) -> None:
    """Raise BadInputError for what `cluster_engine` cannot use, before anything is started."""
    if is_file(cluster):
        read_jobs(Path(cluster))
        return
    check_address(cluster)
    if cluster.startswith("tls://") and certificates is None:
        raise BadInputError(
            f"{masked(cluster)} wants certificates; give the folder that holds them: --certificates DIR"
        )
    if certificates:
        _security(certificates)


def check_address(address: str) -> None:
    """Raise BadInputError for an address that is none, or whose traffic could be read or forged by others."""
    parts = urlsplit(address)
    if parts.scheme not in {"tcp", "tls"} or not parts.hostname:
        raise BadInputError(
            f"--cluster is '{masked(address)}'; give a scheduler's address such as tls://host:8786, or a YAML file"
        )
    if parts.scheme == "tcp" and not _is_loopback(parts.hostname):
        raise BadInputError(
            f"{masked(address)} is not on this machine and not encrypted: tasks are Python objects, and whoever can "
            "send them can run code; start the scheduler with TLS and give tls://..., with --certificates"
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _security(folder: Path) -> Security:
    files = {name: folder / file for name, file in CERTIFICATES.items()}
    if missing := [file.name for file in files.values() if not file.is_file()]:
        raise BadInputError(
            f"{folder} has no {', '.join(missing)}; --certificates needs {', '.join(CERTIFICATES.values())}"
        )
    everyone = {
        name.replace("client", role): str(file)
        for name, file in files.items()
        for role in ("client", "scheduler", "worker")
    }
    return Security(require_encryption=True, **everyone)


def _make_certificates(folder: Path) -> Path:
    """Write new certificates for one run. Jobs read them, so they lie in the working folder, which is shared."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    temporary = Security.temporary()
    for name, file in CERTIFICATES.items():
        path = folder / file
        path.touch(mode=0o600)
        path.write_text(getattr(temporary, name), encoding="ascii")
    return folder


def read_jobs(path: Path) -> tuple[Callable[..., Any], dict[str, Any], int]:
    """Return the dask-jobqueue class that a file names, its arguments, and how many workers to ask for."""
    content = read_yaml(path)
    if unknown := sorted(content.keys() - {"class", "arguments", "workers"}):
        raise BadInputError(f"{path}: unknown setting '{unknown[0]}'; choose from class, arguments, workers")
    name, arguments, workers = content.get("class"), content.get("arguments", {}), content.get("workers", 1)
    if name not in JOB_CLASSES:
        raise one_of(f"{path}: class", str(name), JOB_CLASSES)
    if not isinstance(arguments, Mapping) or not isinstance(workers, int) or workers < 1:
        raise BadInputError(f"{path}: 'arguments' must be a mapping and 'workers' a number of 1 or more")
    if arguments.keys() & {"security", "protocol"}:
        raise BadInputError(f"{path}: leave out 'security' and 'protocol'; workers always connect over TLS")
    try:
        import dask_jobqueue  # noqa: PLC0415 - an extra that only batch systems need
    except ModuleNotFoundError:
        raise BadInputError(f"{path} needs dask-jobqueue: pip install 'study[cluster]'") from None
    kind = getattr(dask_jobqueue, name)
    command = kind.job_cls.submit_command.split()[0]
    if shutil.which(command) is None:  # Dask would wait for workers that nobody starts
        raise BadInputError(
            f"{path}: {name} submits jobs with {command}, which is not on this machine; start the sweep "
            "where jobs are submitted, such as a login node"
        )
    return kind, dict(arguments), workers


def start_jobs(kind: Callable[..., Any], arguments: Mapping[str, Any], workers: int, source: str) -> DaskEngine:
    """Start a scheduler here and ask a batch system for workers, over TLS with certificates made for this run."""
    defaults = {
        "cores": 1,
        "processes": 1,
        "memory": "8GB",  # the batch system's limit; Dask's own would count frames that are only mapped
        "worker_extra_args": ["--memory-limit", "0"],
        "security": _security(_make_certificates(Path("data").absolute() / "tmp" / "certificates")),
        "protocol": "tls://",
        "silence_logs": logging.CRITICAL,
    }
    quiet = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}  # which would be for everyone to read
    options = {**defaults, **arguments, "scheduler_options": quiet | arguments.get("scheduler_options", {})}
    try:
        cluster = kind(**options)
        cluster.scale(workers)
        client = Client(cluster, timeout=CONNECT)
    except (OSError, TypeError, ValueError, RuntimeError, ImportError) as error:
        reason = " ".join(str(error).split())[:300]
        raise BadInputError(f"{source}: {kind.__name__} cannot be started with these arguments: {reason}") from None
    # A job whose time is up, or whose machine has failed, is asked for again when the cluster is scaled the next time.
    renew = partial(cluster.scale, workers)
    return DaskEngine(client, partial(_close, client, cluster), cluster.scheduler_address, renew)


def visible_gpus(device: str) -> list[str]:
    """Return CUDA's names of the GPUs that `--device` asks for: all of them for auto and cuda, one for cuda:N."""
    if device == "cpu" or (device == "auto" and not any(Path(file).exists() for file in GPU_DRIVERS)):
        return []
    import torch  # noqa: PLC0415 - seconds of work that a CPU run does not need

    names = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    count = torch.cuda.device_count()
    listed = names[:count] if len(names) >= count and names != [""] else [str(number) for number in range(count)]
    if device.startswith("cuda:"):
        return listed[int(device.removeprefix("cuda:")) :][:1]
    return listed
