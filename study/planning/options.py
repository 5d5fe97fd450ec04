"""Command-line options of the sweep commands."""

from __future__ import annotations

import importlib.util
import pkgutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from study.config.grid import Grid
from study.config.settings import StudySettings
from study.console.options import Decorator, bundled, nested, profile_option, settings_options, tracking_option
from study.engine.cluster_options import check_cluster
from study.errors import BadInputError
from study.planning.plan import Plan, make_plan

GRID_OPTIONS = ("heads", "fractions", "encoder_seeds", "policy_seeds", "reference", "baselines", "drive")


def _plan(name: str, profile: str, data: Path | None, **values: Any) -> Plan:
    grid = nested({option: values.pop(option) for option in GRID_OPTIONS})
    return make_plan(name, profile, nested(values), grid, data)


def plan_options() -> Decorator:
    """Take the name of a sweep and everything that changes its plan; the command gets the `plan`."""
    return bundled(
        "plan",
        _plan,
        click.argument("name"),
        profile_option(),
        click.option(
            "--data", type=Path, metavar="FOLDER", help="imported drives (study.data import) [those of our town]"
        ),
        *settings_options(Grid, GRID_OPTIONS),
        *settings_options(StudySettings),
    )


@dataclass(frozen=True)
class RunOptions:
    """How to train the cells of a plan, and where to commit them. Raises BadInputError for what cannot be used."""

    tracking: str
    device: str = "auto"
    threads: int = 1
    workers: int | None = None
    cluster: str | None = None
    certificates: Path | None = None
    wait: bool = False
    retry_failed: bool = False

    def __post_init__(self) -> None:
        if self.cluster and self.workers is not None:
            raise BadInputError(
                "--workers counts processes on this machine; a cluster has its own: leave one of them out"
            )
        if self.certificates and not (self.cluster or "").startswith("tls://"):
            raise BadInputError("--certificates goes with --cluster tls://host:port")
        if self.cluster:
            check_cluster(self.cluster, self.certificates)
        else:
            check_device(self.device)


def check_device(name: str) -> None:
    """Raise BadInputError for a device that this machine lacks."""
    if name not in {"auto", "cpu"}:  # torch is loaded for a named GPU only
        pkgutil.resolve_name("study.compute.device:check_device")(name)


device = click.option(
    "--device", default="auto", metavar="D", help="cpu, cuda, cuda:1, ..., mps [cuda where there is one]"
)
threads = click.option(
    "--threads",
    type=click.IntRange(min=1),
    default=1,
    metavar="N",
    help="threads of each task, for a lone large encoder; the last digits of results depend on it [1]",
)
workers = click.option(
    "--workers", type=click.IntRange(min=1), metavar="N", help="processes on this machine, one task each [cores]"
)
wait = click.option("--wait", is_flag=True, help="wait while another sweep runs on this tracking store")


def run_options() -> Decorator:
    """Choose how cells are trained and committed; the command gets `run_options`."""
    return bundled(
        "run_options",
        RunOptions,
        workers,
        click.option(
            "--cluster",
            metavar="WHERE",
            help="run on a Dask cluster: its scheduler's address (tls://host:8786), or a YAML file for a batch system",
        ),
        click.option(
            "--certificates",
            type=Path,
            metavar="DIR",
            help="with tls://: folder with ca.pem, cert.pem and key.pem",
        ),
        device,
        threads,
        tracking_option(),
        wait,
        click.option("--retry-failed", is_flag=True, help="try cells again that are listed as failed"),
    )


def accept_run_options() -> Decorator:
    """Accept what a sweep was started with, which looking at it does not need."""

    def decorate(command: Any) -> Any:
        for name in ("--workers", "--cluster", "--certificates", "--device", "--threads"):
            click.option(name, hidden=True, expose_value=False)(command)
        for name in ("--wait", "--retry-failed", "--no-report"):
            click.option(name, is_flag=True, hidden=True, expose_value=False)(command)
        return command

    return decorate


def check_installed() -> None:
    """Raise BadInputError when the machine lacks what training needs, before hours are spent on the data."""
    for name in ("torch", "lightning", "pandas", "pyarrow", "cv2", "safetensors", "filelock"):
        if importlib.util.find_spec(name) is None:
            raise BadInputError(
                f"{name} is not installed here; bring its wheel along (WHEELS in benchmarks/paper_scale.sh)"
            )
