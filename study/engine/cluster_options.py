"""Check what `--cluster` and `--certificates` name, before anything is started and without loading Dask."""

from __future__ import annotations

import ipaddress
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from study.config.files import read_yaml
from study.errors import BadInputError, masked, one_of

CERTIFICATES = {"tls_ca_file": "ca.pem", "tls_client_cert": "cert.pem", "tls_client_key": "key.pem"}
JOB_CLASSES = ("SLURMCluster", "PBSCluster", "SGECluster", "LSFCluster", "OARCluster", "MoabCluster", "HTCondorCluster")


def is_file(cluster: str) -> bool:
    """Return whether --cluster names a YAML file, not an address."""
    return cluster.endswith((".yaml", ".yml"))


def check_cluster(cluster: str, certificates: Path | None) -> None:
    """Raise BadInputError for an address, a file or certificates that cannot be used."""
    if is_file(cluster):
        read_jobs(Path(cluster))
        return
    check_address(cluster)
    if cluster.startswith("tls://") and certificates is None:
        raise BadInputError(
            f"{masked(cluster)} wants certificates; give the folder that holds them: --certificates DIR"
        )
    if certificates:
        certificate_files(certificates)


def check_address(address: str) -> None:
    """Raise BadInputError for an address that is malformed, or whose traffic others could read or forge."""
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


def certificate_files(folder: Path) -> dict[str, Path]:
    """Return the certificates in a folder by Dask's names. Raises BadInputError when one is missing."""
    files = {name: folder / file for name, file in CERTIFICATES.items()}
    if missing := [file.name for file in files.values() if not file.is_file()]:
        raise BadInputError(
            f"{folder} has no {', '.join(missing)}; --certificates needs {', '.join(CERTIFICATES.values())}"
        )
    return files


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
