"""Run a sweep: plan its cells, make the data, train what is not finished, commit to MLflow, write the report.

python -m study.sweep heads
python -m study.sweep datasize --profile smoke --dry-run
python -m study.sweep heads --data data/imported/scenes
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from study.command import Parser, run
from study.config import DEFAULT_TRACKING, HEADS, BadInputError, parameter_counts
from study.cost import Cost, cell_cost, clock, size, total
from study.data import DATA, prepare
from study.plan import Plan, add_machine_options, add_plan_options, check_machine, given_plan, look_up, thread_hint
from study.provenance import cores, provenance

if TYPE_CHECKING:
    from study.tracking import Tracker

EXIT_FAILED, EXIT_INTERRUPTED = 1, 130


# --- the command ----------------------------------------------------------------------------------------------------


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.sweep",
        usage="python -m study.sweep NAME [--profile P] [--dry-run] [--group.setting VALUE ...]\n"
        "       python -m study.sweep status NAME ...    what is done, what runs where, what is left\n"
        "       python -m study.sweep verify NAME ...    compute a finished cell again and compare",
        description="Run a sweep to its report. Finished cells never run again; a killed sweep goes on.",
        epilog="In brackets: the value where the profile names no other.\n"
        "Example: python -m study.sweep heads --profile smoke --heads '[rec,full]' --encoder.epochs 50",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_plan_options(made)
    made.add_argument("--dry-run", action="store_true", help="show what would run, what is done, and what it costs")
    made.add_argument("--json", action="store_true", help="with --dry-run: one JSON object on stdout")
    made.add_argument("--workers", type=int, default=1, metavar="N", help="cells trained at a time (default: 1)")
    add_machine_options(made)
    made.add_argument("--tracking", default=DEFAULT_TRACKING, metavar="URI", help="MLflow store (default: %(default)s)")
    made.add_argument(
        "--import-results", type=Path, metavar="DIR", help="train nothing: commit what study.train has left in DIR"
    )
    made.add_argument("--no-report", action="store_true", help="stop when the cells are finished")
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    if args[:1] == ["status"]:
        from study.status import main as status  # noqa: PLC0415

        return status(args[1:])
    if args[:1] == ["verify"]:
        from study.verify import main as verify  # noqa: PLC0415

        return verify(args[1:])
    options = parser().parse(args)
    plan = given_plan(options)
    if options.json and not options.dry_run:
        raise BadInputError("--json goes with --dry-run; add --dry-run")
    if options.workers < 1:
        raise BadInputError(f"--workers is {options.workers}; it must be 1 or more")
    check_machine(options)
    if options.dry_run:
        return dry_run(plan, options.tracking, as_json=options.json)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a batch system's stop ends as cleanly as Ctrl-C
    with only_sweep(Path("mlruns") / "sweep.lock"):
        try:
            return import_results(plan, options) if options.import_results else execute(plan, options)
        except KeyboardInterrupt:
            print("\nStopped. Nothing that was finished is lost; the same command goes on.", file=sys.stderr)
            return EXIT_INTERRUPTED


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
        state = "finished" if key in done else f"waiting, about {clock(own.seconds)}"
        print(f"  {cell.label:<22} {key}  {plan.grid.policy_seeds} policies  {state}")
    counts = parameter_counts()
    heads = ", ".join(f"{head} head {counts[head]:,}" for head in HEADS)
    where = "there already" if ready else f"about {clock(data.seconds)} to make"
    print(f"\nparameters  encoder {counts['encoder']:,}, {heads}")
    print(f"frames      {frames.encoder:,} for encoders, {frames.policy:,} for policies; {where}")
    print(f"disk        about {size(whole.bytes)}")
    print(f"time        about {clock(whole.seconds)} on 2 CPU cores")
    return 0


# --- the run --------------------------------------------------------------------------------------------------------


@contextmanager
def only_sweep(path: Path) -> Iterator[None]:
    """Hold the lock of this working folder: SQLite as a queue bears one process that asks."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            stream.seek(0)
            raise BadInputError(
                f"another sweep runs in this folder (process {stream.read().strip() or 'unknown'}); "
                "wait for it, or use --workers N there"
            ) from error
        stream.seek(0)
        stream.truncate()
        stream.write(str(os.getpid()))
        stream.flush()
        yield


def execute(plan: Plan, options: argparse.Namespace) -> int:
    """Run what is not finished, then write the report."""
    # Imported here, so that --help and --dry-run need none of it.
    from study.display import Display  # noqa: PLC0415
    from study.grid import Queue  # noqa: PLC0415
    from study.result import CellJob  # noqa: PLC0415
    from study.tracking import Tracker  # noqa: PLC0415
    from study.worker import Workers  # noqa: PLC0415

    tracker = Tracker(options.tracking)
    done = tracker.finished(list(plan.cells))
    waiting = [key for key in plan.cells if key not in done]
    costs = {key: cell_cost(plan.settings, plan.cells[key], plan.grid.policy_seeds).seconds for key in waiting}
    ready = (plan.frames / "manifest.json").is_file()
    with Display(
        f"{plan.grid.name} ({plan.profile})",
        costs,
        {key: cell.label for key, cell in plan.cells.items()},
        0.0 if ready else plan.data_cost.seconds,
    ) as display:
        frames = plan.frames
        if waiting:
            if hint := thread_hint(options.workers, options.threads, cores()):
                display.say(hint)
            frames = prepare(plan.settings, DATA, cores(), display.data, plan.imported)
        manifest = frames / "manifest.json"
        data = json.loads(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
        if plan.imported:
            data["writers"] = plan.imported.writers  # a report must not call these drives our town's
        sweep_run = tracker.open_sweep(plan.grid, plan.profile, plan.settings, plan.cells, data, provenance())
        status: Literal["FINISHED", "FAILED", "KILLED"] = "KILLED"
        queue = Queue(f"{plan.grid.name} {plan.profile} {plan.key}", plan.cells)
        queue.plan(waiting)
        jobs = {
            key: CellJob(
                cell,
                key,
                plan.settings,
                plan.grid.policy_seeds,
                frames,
                plan.drives,
                DATA,
                options.device,
                options.threads,
            )
            for key, cell in plan.cells.items()
            if key in waiting
        }
        try:
            if data:
                from study.card import card_files, source_drives  # noqa: PLC0415
                from study.frames import open_frames  # noqa: PLC0415

                store = open_frames(frames)
                tracker.log_files(sweep_run, card_files(store, source_drives(store, plan.drives), frames), "data")
            with Workers(jobs, options.workers, tracker, sweep_run, queue, display) as workers:
                failed = workers.run()
            status = "FAILED" if failed else "FINISHED"
        finally:
            tracker.close_sweep(sweep_run, status)
        if not options.no_report:
            display.say("writing the report")
            display.say(f"report: {_publish(plan, tracker)}")
    for key, reason in failed.items():
        print(f"failed: {plan.cells[key].label} ({key}): {reason.strip()}", file=sys.stderr)
    return EXIT_FAILED if failed else 0


def import_results(plan: Plan, options: argparse.Namespace) -> int:
    """Commit what was trained elsewhere; then write the report, or say which cells are missing."""
    from study.intake import planned_results, take_in  # noqa: PLC0415 - as above

    keys = planned_results(plan, options.import_results)
    from study.tracking import Tracker  # noqa: PLC0415

    tracker = Tracker(options.tracking)
    missing = take_in(plan, options.import_results, keys, tracker)
    for key in missing:
        print(f"missing: {plan.cells[key].label} ({key})", file=sys.stderr)
    if missing:
        print("Import them, too, or train them here: the same command without --import-results.", file=sys.stderr)
    elif not options.no_report:
        print(f"report: {_publish(plan, tracker)}", file=sys.stderr)
    return 0


def _publish(plan: Plan, tracker: Tracker) -> Path:
    from study.report import publish  # noqa: PLC0415

    return publish(tracker, plan.grid.name, plan.profile, Path("reports"))


if __name__ == "__main__":
    run(main)
