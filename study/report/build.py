"""Build a sweep's report: figures, JSON, Markdown and PDF."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command answers --help without the libraries that only a report needs
    from study.report.document import Block
    from study.results.sweep_record import SweepRecord
    from study.tracking.tracker import Tracker


TEMPLATE = Path(__file__).with_name("report.typ")
REPORTS = Path("reports")


def build_report(record: SweepRecord, folder: Path = REPORTS) -> Path:
    """Write `<folder>/<sweep>.pdf` and, under `<folder>/<sweep>/`, report.json, curves.parquet and figures/.

    The same record gives the same bytes. Works for a sweep with unfinished cells, and says so on its first page.
    """
    from study.figures.style import save  # noqa: PLC0415
    from study.report.drawings import draw  # noqa: PLC0415
    from study.report.model import FigureText  # noqa: PLC0415
    from study.report.summary import summarise  # noqa: PLC0415
    from study.report.text import document  # noqa: PLC0415

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


def publish(tracker: Tracker, name: str, profile: str | None, folder: Path) -> Path:
    """Build the report from the tracker alone, and add it to the sweep's run. Returns the PDF's path."""
    pdf = build_report(complete_cells(tracker, name, profile), folder)
    own, sweep_run = folder / name, tracker.reader.sweep_run(name, profile)
    tracker.log_files(sweep_run, [pdf, own / "report.json", own / "curves.parquet"], "report")
    tracker.log_files(sweep_run, sorted((own / "figures").iterdir()), "figures")
    return pdf


def complete_cells(tracker: Tracker, name: str, profile: str | None) -> SweepRecord:
    """Return a sweep with those that vary one of its confounds."""
    from study.tracking.variants import read_variants  # noqa: PLC0415

    record = tracker.reader.read_sweep(name, profile)
    return replace(record, variants=read_variants(tracker.reader, record))
