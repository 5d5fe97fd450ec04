"""Engines on many machines: a Dask scheduler at an address, or the jobs of a batch system."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client, Security

from study.config.workspace import HERE
from study.engine.cluster_options import CERTIFICATES, certificate_files, check_cluster, is_file, read_jobs
from study.engine.dask_engine import DaskEngine, configure_dask
from study.errors import BadInputError, masked

CONNECT = 10.0  # [s] within which a scheduler must answer


def cluster_engine(cluster: str, certificates: Path | None = None, scratch: Path = HERE.tmp) -> DaskEngine:
    """Connect to a scheduler's address, or start the dask-jobqueue cluster that a YAML file describes.

    Raises BadInputError for an address that does not answer or is not secured, certificates that do not match, and a
    file that cannot be used.
    """
    check_cluster(cluster, certificates)
    configure_dask()
    if is_file(cluster):
        return start_jobs(*read_jobs(Path(cluster)), cluster, scratch)
    try:
        security = _security(certificates) if certificates else None
        client = Client(cluster, security=security, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise BadInputError(
            f"no Dask scheduler answers at {masked(cluster)} within {CONNECT:.0f} s ({reason}); start one with 'dask "
            "scheduler', check address and port, and for tls:// that --certificates holds its certificates"
        ) from None
    return DaskEngine(client, masked(cluster))


def start_jobs(
    kind: Callable[..., Any], arguments: Mapping[str, Any], workers: int, source: str, scratch: Path = HERE.tmp
) -> DaskEngine:
    """Start a scheduler here and ask a batch system for workers, over TLS with certificates made for this run."""
    defaults = {
        "cores": 1,
        "processes": 1,
        "memory": "8GB",  # the batch system's limit; Dask's own would count frames that are only mapped
        "worker_extra_args": ["--memory-limit", "0"],
        "security": _security(_make_certificates(scratch.absolute() / "certificates")),
        "protocol": "tls://",
        "silence_logs": logging.CRITICAL,
    }
    quiet = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}  # else anyone could read it
    options = {**defaults, **arguments, "scheduler_options": quiet | arguments.get("scheduler_options", {})}
    try:
        cluster = kind(**options)
        cluster.scale(workers)
        client = Client(cluster, timeout=CONNECT)
    except (OSError, TypeError, ValueError, RuntimeError, ImportError) as error:
        reason = " ".join(str(error).split())[:300]
        raise BadInputError(f"{source}: {kind.__name__} cannot be started with these arguments: {reason}") from None
    # Scaling again replaces jobs whose time is up or whose machine has failed.
    return DaskEngine(client, cluster.scheduler_address, cluster, partial(cluster.scale, workers))


def _security(folder: Path) -> Security:
    files = certificate_files(folder)
    roles = {
        name.replace("client", role): str(file)
        for name, file in files.items()
        for role in ("client", "scheduler", "worker")
    }
    return Security(require_encryption=True, **roles)


def _make_certificates(folder: Path) -> Path:
    """Write new certificates for one run into a folder that the jobs share, and return it."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    temporary = Security.temporary()
    for name, file in CERTIFICATES.items():
        path = folder / file
        path.touch(mode=0o600)
        path.write_text(getattr(temporary, name), encoding="ascii")
    return folder
