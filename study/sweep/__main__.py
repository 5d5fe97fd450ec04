"""Run a sweep: plan its cells, make the data, train what is not finished, commit to MLflow, write the report.

python -m study.sweep heads
python -m study.sweep datasize --profile smoke --dry-run
python -m study.sweep heads --data data/imported/scenes
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from study.config.heads import HEADS
from study.config.paper import parameter_counts
from study.console.interrupts import stoppable
from study.console.options import Parser, run, typed
from study.errors import BadInputError
from study.stages import Cost, cell_cost, duration_text, size_text, total
from study.sweep.options import add_plan_options, add_run_options, check_run_options
from study.sweep.plan import Plan, given_plan, look_up

if TYPE_CHECKING:
    from study.tracking.tracker import Tracker


# --- the command ----------------------------------------------------------------------------------------------------


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.sweep",
        usage="python -m study.sweep NAME [--profile P] [--dry-run] [--group.setting VALUE ...]\n"
        "       python -m study.sweep status NAME ...    what is done, what runs where, what is left\n"
        "       python -m study.sweep verify NAME ...    compute a finished cell again and compare\n"
        "       python -m study.sweep train NAME ...     train where there is no tracker; results become folders",
        description="Run a sweep to its report. Finished cells never run again; a killed sweep goes on.",
        epilog="In brackets: the value where the profile names no other.\n"
        "Example: python -m study.sweep heads --profile smoke --heads '[rec,full]' --encoder.epochs 50",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_plan_options(made)
    made.add_argument("--dry-run", action="store_true", help="show what would run, what is done, and what it costs")
    made.add_argument("--json", action="store_true", help="with --dry-run: one JSON object on stdout")
    add_run_options(made)
    made.add_argument(
        "--import-results",
        type=Path,
        metavar="DIR",
        help="train nothing: commit what study.sweep train has left in DIR",
    )
    made.add_argument("--no-report", action="store_true", help="stop when the cells are finished")
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    if args[:1] == ["status"]:
        from study.sweep.status import main as status  # noqa: PLC0415

        return status(args[1:])
    if args[:1] == ["train"]:
        from study.sweep.train import main as train  # noqa: PLC0415

        return train(args[1:])
    if args[:1] == ["verify"]:
        from study.sweep.verify import main as verify  # noqa: PLC0415

        return verify(args[1:])
    options = parser().parse(args)
    plan = given_plan(options)
    if options.json and not options.dry_run:
        raise BadInputError("--json goes with --dry-run; add --dry-run")
    check_run_options(options)
    if options.dry_run:
        return dry_run(plan, options.tracking, as_json=options.json)
    command = typed("study.sweep", args)
    run_plan = import_results if options.import_results else execute
    return stoppable(lambda: run_plan(plan, options, command), command)


# --- dry run --------------------------------------------------------------------------------------------------------


def dry_run(plan: Plan, tracking: str, *, as_json: bool) -> int:
    """Print the plan, what of it is finished, and what the rest costs."""
    tracker = look_up(tracking)
    done = tracker.finished(list(plan.cells)) if tracker else {}
    costs = [
        cell_cost(plan.settings, cell, plan.grid.policy_seeds) for key, cell in plan.cells.items() if key not in done
    ]
    ready = (plan.frames / "manifest.json").is_file()
    data = Cost(0, 0) if ready or not costs else plan.data_cost
    whole = total([data, *costs])
    frames = plan.settings.frames
    facts = {
        "sweep": plan.grid.name,
        "profile": plan.profile,
        "cells": [
            {
                "key": key,
                "heads": cell.heads,
                "fraction": cell.fraction,
                "encoder_seed": cell.encoder_seed,
                "status": "finished" if key in done else "waiting",
            }
            for key, cell in plan.cells.items()
        ],
        "policy_seeds": plan.grid.policy_seeds,
        "parameters": parameter_counts(),
        "frames": {"encoder": frames.encoder, "policy": frames.policy},
        "seconds": round(whole.seconds, 1),
        "bytes": whole.bytes,
    }
    if as_json:
        print(json.dumps(facts))
        return 0
    print(f"{plan.grid.name} ({plan.profile}): {plan.grid.title}\n")
    for key, cell in plan.cells.items():
        own = cell_cost(plan.settings, cell, plan.grid.policy_seeds)
        state = "finished" if key in done else f"waiting, about {duration_text(own.seconds)}"
        print(f"  {cell.label:<22} {key}  {plan.grid.policy_seeds} policies  {state}")
    counts = parameter_counts()
    heads = ", ".join(f"{head} head {counts[head]:,}" for head in HEADS)
    where = "there already" if ready else f"about {duration_text(data.seconds)} to make"
    print(f"\nparameters  encoder {counts['encoder']:,}, {heads}")
    print(f"frames      {frames.encoder:,} for encoders, {frames.policy:,} for policies; {where}")
    print(f"disk        about {size_text(whole.bytes)}")
    print(f"time        about {duration_text(whole.seconds)} on 2 CPU cores")
    return 0


# --- the run --------------------------------------------------------------------------------------------------------


def execute(plan: Plan, options: argparse.Namespace, command: str) -> int:
    """Run what is not finished, then write the report."""
    # Imported here, so that --help and --dry-run need none of it.
    from study.sweep.run import hold_store, report_failed, run_cells  # noqa: PLC0415
    from study.tracking.tracker import Tracker  # noqa: PLC0415

    with hold_store(options.tracking, plan.grid.name, wait=options.wait):
        tracker = Tracker(options.tracking)
        failed = run_cells(plan, options, tracker)
        if not options.no_report:
            print("writing the report", file=sys.stderr)
            print(f"report: {_publish(plan, tracker)}", file=sys.stderr)
    return report_failed(plan, failed, command)


def import_results(plan: Plan, options: argparse.Namespace, command: str) -> int:
    """Commit what was trained elsewhere; then write the report, or say which cells are missing."""
    from study.sweep.offline_results import planned_results, take_in  # noqa: PLC0415 - as above
    from study.sweep.run import hold_store  # noqa: PLC0415

    keys = planned_results(plan, options.import_results)
    from study.tracking.tracker import Tracker  # noqa: PLC0415

    with hold_store(options.tracking, plan.grid.name, wait=options.wait):
        tracker = Tracker(options.tracking)
        missing = take_in(plan, options.import_results, keys, tracker)
        for key in missing:
            print(f"missing: {plan.cells[key].label} ({key})", file=sys.stderr)
        if missing:
            here = command.replace(f"--import-results {options.import_results}", "").strip()
            print(f"Import them, too, or train them here: {here}", file=sys.stderr)
        elif not options.no_report:
            print(f"report: {_publish(plan, tracker)}", file=sys.stderr)
    return 0


def _publish(plan: Plan, tracker: Tracker) -> Path:
    from study.report.build import publish  # noqa: PLC0415

    return publish(tracker, plan.grid.name, plan.profile, Path("reports"))


if __name__ == "__main__":
    run(main)
