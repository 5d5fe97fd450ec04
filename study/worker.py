"""A worker on any machine: takes cells of a sweep from the shared queue and commits their results, until none is left.

python -m study.worker heads --queue postgresql://study@host/study --tracking http://host:5000
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from study.command import Parser, run, stoppable, typed
from study.config import SHARED_QUEUES, BadInputError, masked
from study.plan import Plan, add_plan_options, add_run_options, check_run_options, given_plan


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.worker",
        usage="python -m study.worker NAME --queue URI --tracking URI [--profile P] [--group.setting VALUE ...]",
        description="Work on a sweep beside others; sweep file, profile and settings must be the same for all.",
        epilog="PGPASSWORD or PGPASSFILE, MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD hold the passwords.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_plan_options(made)
    add_run_options(made, "cells trained at a time")
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = parser().parse(args)
    plan = given_plan(options)
    if not options.queue.startswith(SHARED_QUEUES):
        raise BadInputError(
            f"a worker takes cells from a shared queue, not from {masked(options.queue)}; give --queue "
            f"{SHARED_QUEUES[0]}user@host/database, or, on one machine, use: python -m study.sweep --workers N"
        )
    check_run_options(options)
    command = typed("study.worker", args)
    return stoppable(lambda: _work(plan, options, command), command)


def _work(plan: Plan, options: argparse.Namespace, command: str) -> int:
    # Imported here, so that --help needs none of it.
    from study.crew import tell_failed, work  # noqa: PLC0415
    from study.tracking import Tracker  # noqa: PLC0415

    return tell_failed(plan, work(plan, options, Tracker(options.tracking), lead=False), command)


if __name__ == "__main__":
    run(main)
