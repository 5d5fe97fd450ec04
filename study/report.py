"""The report of a sweep: every number in one JSON, the figures, and the document that Typst sets from both.

python -m study.report heads
python -m study.report datasize --profile smoke --tracking http://127.0.0.1:5000
python -m study.report heads --format md > heads.md
python -m study.report compare reports/reference/heads heads:laptop@http://127.0.0.1:5000 --figure both.svg
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from study.command import Parser, add_tracking_option, run
from study.config import SWEEPS, BadInputError, masked, named_files

if TYPE_CHECKING:  # the command answers --help without the libraries that only a report needs
    from study.document import Block, Picture
    from study.report_model import Report
    from study.result import SweepRecord
    from study.tracking import Tracker

TEMPLATE = Path(__file__).with_name("report.typ")
REPORTS = Path("reports")


def build_report(record: SweepRecord, folder: Path = REPORTS) -> Path:
    """Write `<folder>/<sweep>.pdf` and, under `<folder>/<sweep>/`, report.json, curves.parquet and figures/.

    The same record gives the same bytes. Works for a sweep with unfinished cells, and says so on its first page.
    """
    from study.drawings import draw  # noqa: PLC0415
    from study.figures import save  # noqa: PLC0415
    from study.report_model import FigureText  # noqa: PLC0415
    from study.report_text import document  # noqa: PLC0415
    from study.summary import summarise  # noqa: PLC0415

    report, own = summarise(record), folder / record.grid.name
    drawings = draw(record, report)
    figures = tuple(FigureText.model_validate(drawing, from_attributes=True) for drawing in drawings)
    report = report.model_copy(update={"figures": figures})
    files = [file for drawing in drawings for file in save(drawing.figure, own / "figures", drawing.name)]
    for left in (own / "figures").glob("*"):
        if left not in files:  # of an earlier report with other cells
            left.unlink()
    _write(own / "report.json", report.json())
    draft = own / ".curves.parquet"
    record.table(ceiling=True).to_parquet(draft, index=False)
    draft.replace(own / "curves.parquet")
    pictures = {f"figures/{file.name}": file.read_bytes() for file in files if file.suffix == ".svg"}
    pdf = folder / f"{record.grid.name}.pdf"
    sweep = report.sweep
    title, footer = f"{sweep.title} ({sweep.name}, {sweep.profile})", f"{sweep.name} ({sweep.profile})"
    _write(pdf, typeset(title, footer, document(report), pictures))
    return pdf


def typeset(title: str, footer: str, blocks: Sequence[Block], pictures: dict[str, bytes]) -> bytes:
    """Return the PDF of a document and its pictures, with the fonts that Typst brings along."""
    import typst  # noqa: PLC0415

    listed = [{"kind": type(block).__name__, **asdict(block)} for block in blocks]
    content = json.dumps({"title": title, "footer": footer, "blocks": listed}).encode()
    files = {"main.typ": TEMPLATE.read_bytes(), "document.json": content, **pictures}
    # Its type stub does not know of files by name, which its documentation has.
    pdf: bytes = typst.compile(files, format="pdf", ignore_system_fonts=True)  # type: ignore[call-overload]
    return pdf


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}")
    draft.write_bytes(content)
    draft.replace(path)


# --- the command ----------------------------------------------------------------------------------------------------


def publish(tracker: Tracker, name: str, profile: str | None, folder: Path) -> Path:
    """Build the report from the tracker alone, and add it to the sweep's run. Returns the PDF's path."""
    pdf = build_report(_complete(tracker, name, profile), folder)
    own, sweep_run = folder / name, tracker.sweep_run(name, profile)
    tracker.log_files(sweep_run, [pdf, own / "report.json", own / "curves.parquet"], "report")
    tracker.log_files(sweep_run, sorted((own / "figures").iterdir()), "figures")
    return pdf


def _complete(tracker: Tracker, name: str, profile: str | None) -> SweepRecord:
    """Return a sweep with those that vary one of its confounds."""
    record = tracker.read_sweep(name, profile)
    return replace(record, variants=tracker.read_variants(record))


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
    from study.tracking import Tracker  # noqa: PLC0415

    tracker = Tracker(options.tracking)
    if options.format == "md":
        from study.markdown import markdown  # noqa: PLC0415
        from study.report_text import document  # noqa: PLC0415
        from study.summary import summarise  # noqa: PLC0415

        print(markdown(document(summarise(_complete(tracker, name, options.profile)))), end="")
    else:
        print(publish(tracker, name, options.profile, options.out or REPORTS))
    return 0


def side_by_side(first: str, second: str, tracking: str, figure: Path | None = None) -> str:
    """Return two sweeps' comparison as Markdown, each named by a path or as NAME[:PROFILE][@URI].

    Both are drawn into `figure` first, where there is one. Raises BadInputError for what cannot be read or written.
    """
    from study.comparison import compare  # noqa: PLC0415
    from study.markdown import markdown  # noqa: PLC0415

    if figure:
        _check_figure(figure)
    sides, names = (_report(first, tracking), _report(second, tracking)), (masked(first), masked(second))
    return markdown(compare(*sides, names, _draw(figure, *sides, names) if figure else None))


def _check_figure(file: Path) -> None:
    """Refuse what cannot become a figure, before anything is read."""
    from study.figures import METADATA  # noqa: PLC0415

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
    from study.document import Picture, plain  # noqa: PLC0415
    from study.drawings import draw_sweeps  # noqa: PLC0415
    from study.figures import write  # noqa: PLC0415

    drawing = draw_sweeps(first, second, names)
    try:
        write(drawing.figure, file)
    except OSError as error:
        raise BadInputError(f"cannot write {file}: {error.strerror}; name another file") from error
    return Picture(Path(os.path.relpath(file)).as_posix(), plain(drawing.caption), plain(drawing.alt))


def _report(source: str, tracking: str) -> Report:
    from study.report_model import read_report  # noqa: PLC0415

    sweep, _, uri = source.partition("@")
    if Path(source).exists() or "/" in sweep or sweep.endswith(".json"):
        return read_report(Path(source))
    from study.summary import summarise  # noqa: PLC0415
    from study.tracking import Tracker  # noqa: PLC0415

    name, _, profile = sweep.partition(":")
    return summarise(Tracker(uri or tracking).read_sweep(name, profile or None))


if __name__ == "__main__":
    run(main)
