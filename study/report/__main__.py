"""The report of a sweep: every number in one JSON, the figures, and the document that Typst sets from both.

python -m study.report heads
python -m study.report datasize --profile smoke --tracking http://127.0.0.1:5000
python -m study.report heads --format md > heads.md
python -m study.report heads --format latex > tables.tex
python -m study.report compare reports/reference/heads heads:laptop@http://127.0.0.1:5000 --figure both.svg
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name  # the work is imported when it begins: --help needs none of it

import click

from study.config.workspace import HERE
from study.console.options import invoke, run, tracking_option
from study.errors import BadInputError

HINT = (
    "settings and options of a run go with python -m study.sweep: a report takes the sweep's name and, with --profile, "
    "its profile"
)


@click.command(epilog="python -m study.report compare A B sets two sweeps side by side; see its --help")
@click.argument("name", metavar="SWEEP")
@click.option("--profile", metavar="P", help="of the sweep [that of its latest run]")
@click.option("--format", "kind", type=click.Choice(["pdf", "md", "latex"]), default="pdf", show_default=True)
@click.option("--out", type=Path, metavar="DIR", help=f"of the PDF and what belongs to it [{HERE.reports}]")
@tracking_option()
def report(name: str, profile: str | None, kind: str, out: Path | None, tracking: str) -> int:
    """Write the report of SWEEP from what MLflow holds: PDF, figures, numbers and the tidy table.

    SWEEP: its name, for the latest run of that name, or the first six or more characters of a run id, which
    python -m study.sweep clean lists.

    With --format md, print the report without figures as Markdown; with --format latex, its tables for a paper. Exit
    code 1: the result of a finished cell is lost.
    """
    if kind != "pdf" and out:
        raise BadInputError(f"--out {out} goes with --format pdf; {kind} is printed: leave --out away, and use > FILE")
    reader = resolve_name("study.tracking.reader:Reader").existing(tracking)
    if kind != "pdf":
        text, code = resolve_name("study.report.build:report_as_text")(reader, name, profile, kind)
        print(text, end="")
    else:
        tracker = resolve_name("study.tracking.tracker:Tracker")(tracking)  # the report becomes part of the run
        pdf, code = resolve_name("study.report.build:publish")(tracker, name, profile, out or HERE.reports)
        print(pdf)
    return int(code)


@click.command
@click.argument("first", metavar="A")
@click.argument("second", metavar="B")
@click.option(
    "--figure",
    type=Path,
    metavar="FILE",
    help="draw accuracy and differences to the reference of both sweeps into FILE (.svg, .png or .pdf); the Markdown "
    "shows it by its path from the working folder",
)
@click.option("--format", "kind", type=click.Choice(["md", "latex"]), default="md", show_default=True)
@tracking_option()
def compare(first: str, second: str, figure: Path | None, kind: str, tracking: str) -> int:
    """Set two sweeps side by side on stdout: as Markdown, or the tables alone as LaTeX.

    A and B: each a report.json, a folder that holds one, or NAME[:PROFILE][@URI] of a sweep in MLflow, whose run id
    may stand for its name.
    """
    text, code = resolve_name("study.report.build:side_by_side")(first, second, tracking, figure, kind)
    print(text, end="")
    return int(code)


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return invoke(report, args, "study.report", {"compare": compare}, HINT)


if __name__ == "__main__":
    run(main)
