"""Write what the command line asks for: a sweep's report with its files, or a comparison."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from study.atomic import write_atomic
from study.config.workspace import HERE
from study.document.blocks import Block
from study.document.latex import latex
from study.document.markdown import markdown
from study.document.typesetting import rasterise, typeset
from study.errors import EXIT_FAILED, BadInputError, masked
from study.figures.fonts import fonts_for, lettering
from study.figures.style import METADATA, paint, write
from study.report.comparison import compare
from study.report.drawings import draw, draw_sweeps
from study.report.model import Report, read_report
from study.report.summary import summarise
from study.report.text import document
from study.results.sweep_record import SweepRecord
from study.tracking.reader import Reader
from study.tracking.tracker import Tracker
from study.tracking.variants import with_variants

DRIVES = "drives.parquet"


def build_report(record: SweepRecord, folder: Path = HERE.reports) -> Path:
    """Write `<folder>/<sweep>.pdf` and, under `<folder>/<sweep>/`, report.json, curves.parquet and figures/.

    Where policies have driven, there is drives.parquet, too. The same record gives the same bytes. Works for a sweep
    with unfinished cells, and says so on its first page.
    """
    report, files = summarise(record), folder / record.grid.name
    fonts = fonts_for(report.json().decode())
    if fonts.warning:
        print(f"warning: {fonts.warning}", file=sys.stderr)
    with lettering(fonts):
        figures = draw(record, report)
        pictures = {f"figures/{name}.svg": paint(figure, "svg") for name, figure in figures.items()}
    report = report.model_copy(update={"figures": tuple(figures), "characters": fonts.warning})
    written = pictures | rasterise(pictures)
    for name, content in written.items():
        write_atomic(files / name, content)
    for file in (files / "figures").glob("*"):
        if f"figures/{file.name}" not in written:  # of an earlier report with other cells
            file.unlink()
    write_atomic(files / "report.json", report.json())
    write_atomic(files / "curves.parquet", record.table(baselines=True).to_parquet(index=False))
    if record.drive_table.empty:
        (files / DRIVES).unlink(missing_ok=True)  # of an earlier report
    else:
        write_atomic(files / DRIVES, record.drive_table.to_parquet(index=False))
    pdf = folder / f"{record.grid.name}.pdf"
    sweep = report.sweep
    title, footer = f"{sweep.title} ({sweep.name}, {sweep.profile})", f"{sweep.name} ({sweep.profile})"
    write_atomic(pdf, typeset(title, footer, document(report), pictures, fonts.files))
    return pdf


def publish(tracker: Tracker, name: str, profile: str | None, folder: Path) -> tuple[Path, int]:
    """Build the report from the tracker alone, and add it to the sweep's run. Returns the PDF's path and exit code."""
    record = complete_cells(tracker.reader, name, profile)
    pdf, files = build_report(record, folder), folder / record.grid.name
    tables = [files / name for name in ("report.json", "curves.parquet", DRIVES) if (files / name).exists()]
    tracker.log_files(record.run_id, [pdf, *tables], "report")
    tracker.log_files(record.run_id, sorted((files / "figures").glob("*")), "figures")
    return pdf, exit_code(record)


def exit_code(record: SweepRecord) -> int:
    """Return 1 when the result of a finished cell is lost, which `complete_cells` has named, else 0."""
    return EXIT_FAILED if record.lost else 0


def complete_cells(reader: Reader, name: str, profile: str | None) -> SweepRecord:
    """Return a sweep with those that vary one of its confounds; say on stderr what cannot be read."""
    record = with_variants(reader, reader.read_sweep(name, profile))
    _say_unread(record)
    return record


def _say_unread(record: SweepRecord) -> None:
    for line in record.unread:
        print(f"left out of the report: {line}", file=sys.stderr)


def report_as_text(reader: Reader, name: str, profile: str | None, kind: str) -> tuple[str, int]:
    """Return the report of a sweep without figures, as "md" or its tables as "latex", and the exit code."""
    record = complete_cells(reader, name, profile)
    return _text(document(summarise(record)), record.grid.name, kind), exit_code(record)


def _text(blocks: Sequence[Block], name: str, kind: str) -> str:
    return latex(blocks, name) if kind == "latex" else markdown(blocks)


def side_by_side(
    first: str, second: str, tracking: str, figure: Path | None = None, kind: str = "md"
) -> tuple[str, int]:
    """Return two sweeps' comparison, as "md" or its tables as "latex", and the exit code.

    Each is a path or NAME[:PROFILE][@URI]. Both are drawn into `figure` first, where there is one. Raises BadInputError
    for what cannot be read or written.
    """
    if figure:
        _check_figure(figure)
    read, names = (_report(first, tracking), _report(second, tracking)), (masked(first), masked(second))
    sides = (read[0][0], read[1][0])
    if figure:
        try:
            with lettering(fonts_for("".join([*names, *(side.json().decode() for side in sides)]))):
                write(draw_sweeps(*sides, names), figure)
        except OSError as error:
            raise BadInputError(f"cannot write {figure}: {error.strerror}; name another file") from error
    blocks = compare(*sides, names, Path(os.path.relpath(figure)).as_posix() if figure else "")
    return _text(blocks, "-".join(name.partition("@")[0] for name in names), kind), max(code for _, code in read)


def _check_figure(file: Path) -> None:
    """Refuse what cannot become a figure, before anything is read."""
    if file.suffix[1:].lower() not in METADATA:
        raise BadInputError(
            f"--figure {file}: write {', '.join(f'.{kind}' for kind in METADATA)}, chosen by its ending"
        )
    if not file.parent.is_dir():
        raise BadInputError(f"--figure {file}: there is no folder {file.parent}; make it first: mkdir -p {file.parent}")
    if file.is_dir():
        raise BadInputError(f"--figure {file} is a folder; name a file in it")


def _report(source: str, tracking: str) -> tuple[Report, int]:
    """Return a report and the exit code."""
    sweep, _, uri = source.partition("@")
    if Path(source).exists() or "/" in sweep or sweep.endswith(".json"):
        return read_report(Path(source)), 0
    name, _, profile = sweep.partition(":")
    record = Reader.existing(uri or tracking).read_sweep(name, profile or None)
    _say_unread(record)
    return summarise(record), exit_code(record)
