"""The report of a sweep: every number in one JSON, the figures, and the document that Typst sets from both.

python -m study.report heads
python -m study.report datasize --profile smoke --tracking http://127.0.0.1:5000
python -m study.report heads --format md > heads.md
python -m study.report compare reports/reference/heads heads:laptop@http://127.0.0.1:5000 --figure both.svg
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from study.config.files import named_files
from study.config.workspace import REPORTS, SWEEPS
from study.console.options import Parser, add_tracking_option, run
from study.errors import BadInputError


def parser() -> Parser:
    """Return the command line."""
    made = Parser(
        prog="study.report",
        usage="python -m study.report SWEEP [--profile P] [--format {pdf,md}] [--tracking URI] [--out DIR]\n"
        "       python -m study.report compare A B [--figure FILE] [--tracking URI]",
        description="Write the report of a sweep from what MLflow holds: PDF, figures, numbers and the tidy table; or "
        "the report without figures as Markdown on stdout; or set two sweeps side by side, as Markdown on stdout, with "
        "a picture.",
        epilog="A and B: each a report.json, a folder that holds one, or NAME[:PROFILE][@URI] of a sweep in MLflow. "
        "Examples: python -m study.report heads --profile smoke; "
        "python -m study.report compare reports/reference/heads heads:laptop --figure both.svg > both.md",
    )
    made.add_argument(
        "words",
        nargs="+",
        metavar="SWEEP",
        help=f"name of a sweep that was run, such as {', '.join(named_files(SWEEPS)) or 'heads'}; or compare A B",
    )
    made.add_argument("--profile", help="of the sweep (default: that of its latest run)")
    made.add_argument("--format", choices=("pdf", "md"), default="pdf", help="default: %(default)s")
    add_tracking_option(made)
    made.add_argument(
        "--figure",
        type=Path,
        metavar="FILE",
        help="compare: draw both sweeps' accuracy and differences to the baseline into FILE (.svg, .png or .pdf); the "
        "Markdown shows it by its path from the working folder",
    )
    made.add_argument("--out", type=Path, metavar="DIR", help=f"default: {REPORTS}")
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = parser().parse(args)
    name, *rest = options.words
    if len(rest) != (2 if name == "compare" else 0):
        raise BadInputError(
            f"'{' '.join(options.words)}' names {len(options.words)} things; give one sweep, or: compare A B"
        )
    if name == "compare":
        for option, where in (("profile", "within a name: heads:smoke"), ("out", "with --figure FILE or > FILE")):
            if getattr(options, option) is not None:
                raise BadInputError(f"compare takes no --{option}; give it {where}")
    elif options.figure:
        raise BadInputError(f"--figure {options.figure} is for compare A B; a report has its own in DIR/SWEEP/figures")
    # --help is answered without the libraries that only a report needs.
    from study.report import build  # noqa: PLC0415
    from study.tracking.tracker import Tracker  # noqa: PLC0415

    if name == "compare":
        print(build.side_by_side(rest[0], rest[1], options.tracking, options.figure), end="")
    elif options.format == "md":
        print(build.report_as_markdown(Tracker(options.tracking), name, options.profile), end="")
    else:
        print(build.publish(Tracker(options.tracking), name, options.profile, options.out or REPORTS))
    return 0


if __name__ == "__main__":
    run(main)
