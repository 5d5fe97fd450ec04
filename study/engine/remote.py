"""Engines on many machines: a Dask scheduler's address, or a batch system's jobs."""

from __future__ import annotations

import ipaddress
import logging
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from distributed import (
    Client,
    Security,
)

from study.config.files import read_yaml
from study.engine.workers import DaskEngine, close_cluster, configure_dask
from study.errors import BadInputError, masked, one_of

CONNECT = 10.0  # [s] a scheduler has to answer in
CERTIFICATES = {"tls_ca_file": "ca.pem", "tls_client_cert": "cert.pem", "tls_client_key": "key.pem"}
JOB_CLASSES = ("SLURMCluster", "PBSCluster", "SGECluster", "LSFCluster", "OARCluster", "MoabCluster", "HTCondorCluster")


def cluster_engine(cluster: str, certificates: Path | None = None) -> DaskEngine:
    """Connect to a scheduler's address, or start the dask-jobqueue cluster that a YAML file describes.

    Raises BadInputError for an address that does not answer or is not secured, certificates that do not match, and a
    file that cannot be used.
    """
    check_cluster(cluster, certificates)
    configure_dask()
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
    return DaskEngine(client, partial(close_cluster, client), masked(cluster))


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
    return DaskEngine(client, partial(close_cluster, client, cluster), cluster.scheduler_address, renew)
