"""The report of a sweep: every number in one JSON, the figures, and the document that Typst sets from both.

python -m study.report heads
python -m study.report datasize --profile smoke --tracking http://127.0.0.1:5000
python -m study.report heads --format md > heads.md
python -m study.report compare reports/reference/heads heads:laptop@http://127.0.0.1:5000 --figure both.svg
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from study.config.files import named_files
from study.config.workspace import SWEEPS
from study.console.options import Parser, add_tracking_option, run
from study.errors import BadInputError, masked
from study.report.build import REPORTS, complete_cells, publish

if TYPE_CHECKING:  # the command answers --help without the libraries that only a report needs
    from study.report.document import Picture
    from study.report.model import Report


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
        print(side_by_side(rest[0], rest[1], options.tracking, options.figure), end="")
        return 0
    if options.figure:
        raise BadInputError(f"--figure {options.figure} is for compare A B; a report has its own in DIR/SWEEP/figures")
    from study.tracking.tracker import Tracker  # noqa: PLC0415

    tracker = Tracker(options.tracking)
    if options.format == "md":
        from study.report.markdown import markdown  # noqa: PLC0415
        from study.report.summary import summarise  # noqa: PLC0415
        from study.report.text import document  # noqa: PLC0415

        print(markdown(document(summarise(complete_cells(tracker, name, options.profile)))), end="")
    else:
        print(publish(tracker, name, options.profile, options.out or REPORTS))
    return 0


def side_by_side(first: str, second: str, tracking: str, figure: Path | None = None) -> str:
    """Return two sweeps' comparison as Markdown, each named by a path or as NAME[:PROFILE][@URI].

    Both are drawn into `figure` first, where there is one. Raises BadInputError for what cannot be read or written.
    """
    from study.report.comparison import compare  # noqa: PLC0415
    from study.report.markdown import markdown  # noqa: PLC0415

    if figure:
        _check_figure(figure)
    sides, names = (_report(first, tracking), _report(second, tracking)), (masked(first), masked(second))
    return markdown(compare(*sides, names, _draw(figure, *sides, names) if figure else None))


def _check_figure(file: Path) -> None:
    """Refuse what cannot become a figure, before anything is read."""
    from study.figures.style import METADATA  # noqa: PLC0415

    if file.suffix[1:].lower() not in METADATA:
        raise BadInputError(
            f"--figure {file}: write {', '.join(f'.{kind}' for kind in METADATA)}, chosen by its ending"
        )
    if not file.parent.is_dir():
        raise BadInputError(f"--figure {file}: there is no folder {file.parent}; make it first: mkdir -p {file.parent}")
    if file.is_dir():
        raise BadInputError(f"--figure {file} is a folder; name a file in it")


def _draw(file: Path, first: Report, second: Report, names: tuple[str, str]) -> Picture:
    """Draw two sweeps into a file. Returns the picture by its path from the working folder."""
    from study.figures.style import write  # noqa: PLC0415
    from study.report.document import Picture, plain  # noqa: PLC0415
    from study.report.drawings import draw_sweeps  # noqa: PLC0415

    drawing = draw_sweeps(first, second, names)
    try:
        write(drawing.figure, file)
    except OSError as error:
        raise BadInputError(f"cannot write {file}: {error.strerror}; name another file") from error
    return Picture(Path(os.path.relpath(file)).as_posix(), plain(drawing.caption), plain(drawing.alt))


def _report(source: str, tracking: str) -> Report:
    from study.report.model import read_report  # noqa: PLC0415

    sweep, _, uri = source.partition("@")
    if Path(source).exists() or "/" in sweep or sweep.endswith(".json"):
        return read_report(Path(source))
    from study.report.summary import summarise  # noqa: PLC0415
    from study.tracking.tracker import Tracker  # noqa: PLC0415

    name, _, profile = sweep.partition(":")
    return summarise(Tracker(uri or tracking).reader.read_sweep(name, profile or None))


if __name__ == "__main__":
    run(main)
