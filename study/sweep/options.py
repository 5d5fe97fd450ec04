"""Command-line options of the sweep commands."""

from __future__ import annotations

import argparse
from pathlib import Path

from study.config.files import named_files
from study.config.grid import Grid
from study.config.settings import StudySettings
from study.config.workspace import SWEEPS
from study.console.options import (
    GRID_OPTIONS,
    Parser,
    add_options,
    add_tracking_option,
)
from study.engine.cluster_options import check_cluster
from study.errors import BadInputError


def add_plan_options(parser: Parser) -> None:
    """What every command takes that works on a plan."""
    parser.add_argument(
        "sweep",
        metavar="NAME",
        help=f"name of a sweep file in {SWEEPS}/: {', '.join(named_files(SWEEPS)) or 'none here'}",
    )
    parser.add_argument(
        "--profile",
        default="laptop",
        help=f"{', '.join(named_files(SWEEPS / 'profiles'))} (default: laptop)",
    )
    parser.add_argument(
        "--data", type=Path, metavar="FOLDER", help="imported drives (study.data import); default: our town's"
    )
    add_options(parser, Grid, GRID_OPTIONS)
    add_options(parser, StudySettings)


def add_machine_options(parser: Parser) -> None:
    """What every command takes that trains cells."""
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:1, ... (default: cuda where there is one)")
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="threads each task computes with, for a lone large encoder; the last digits depend on it (default: 1)",
    )


def check_machine(options: argparse.Namespace) -> None:
    """Raise BadInputError for a device that is not there, or no threads."""
    if options.threads < 1:
        raise BadInputError(f"--threads is {options.threads}; it must be 1 or more")
    if options.device not in {"auto", "cpu"}:
        from study.compute.device import check_device  # noqa: PLC0415 - loads torch, which only a named GPU needs here

        check_device(options.device)


def add_run_options(parser: Parser) -> None:
    """Add the options of a command that trains the cells of a plan and commits them."""
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes on this machine, one task each (default: all cores)"
    )
    parser.add_argument(
        "--cluster",
        metavar="WHERE",
        help="run on a Dask cluster: its scheduler's address (tls://host:8786), or a YAML file for a batch system",
    )
    parser.add_argument(
        "--certificates", type=Path, metavar="DIR", help="with tls://: folder with ca.pem, cert.pem and key.pem"
    )
    add_machine_options(parser)
    add_tracking_option(parser)
    parser.add_argument("--wait", action="store_true", help="wait while another sweep runs on this tracking store")
    parser.add_argument("--retry-failed", action="store_true", help="try cells again that are listed as failed")


def check_run_options(options: argparse.Namespace) -> None:
    """Raise BadInputError for options of `add_run_options` that cannot be used."""
    if options.workers is not None and options.workers < 1:
        raise BadInputError(f"--workers is {options.workers}; it must be 1 or more")
    if options.cluster and options.workers is not None:
        raise BadInputError("--workers counts processes on this machine; a cluster has its own: leave one of them out")
    if options.certificates and not (options.cluster or "").startswith("tls://"):
        raise BadInputError("--certificates goes with --cluster tls://host:port")
    if options.cluster:
        check_cluster(options.cluster, options.certificates)
    if options.threads < 1 or (options.device not in {"auto", "cpu"} and not options.cluster):
        check_machine(options)
