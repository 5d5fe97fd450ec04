"""The report of a sweep: every number in one JSON, the figures, and the PDF that Typst sets from both.

python -m study.report heads
python -m study.report datasize --profile smoke --tracking http://127.0.0.1:5000
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from study.command import Parser, run
from study.config import DEFAULT_TRACKING, SWEEPS, named_files

if TYPE_CHECKING:  # the command answers --help without the libraries that only a report needs
    from study.result import SweepRecord
    from study.tracking import Tracker

TEMPLATE = Path(__file__).with_name("report.typ")


def build_report(record: SweepRecord, folder: Path = Path("reports")) -> Path:
    """Write `<folder>/<sweep>.pdf` and, under `<folder>/<sweep>/`, report.json, curves.parquet and figures/.

    The same record gives the same bytes. Works for a sweep with unfinished cells, and says so on its first page.
    """
    from study.drawings import draw  # noqa: PLC0415
    from study.figures import save  # noqa: PLC0415
    from study.summary import numbers  # noqa: PLC0415

    made, own = numbers(record), folder / record.grid.name
    drawings = draw(record, made)
    made["figures"] = [
        {"name": item.name, "place": item.place, "caption": item.caption, "alt": item.alt} for item in drawings
    ]
    pictures = {}
    for item in drawings:
        vector, raster = save(item.figure, own / "figures", item.name)
        pictures[f"figures/{vector.name}"] = vector.read_bytes()
        pictures[f"figures/{raster.name}"] = b""
    for left in (own / "figures").glob("*"):
        if f"figures/{left.name}" not in pictures:  # of an earlier report with other cells
            left.unlink()
    text = json.dumps(made, indent=1, ensure_ascii=False, allow_nan=False).encode()
    _write(own / "report.json", text)
    draft = own / ".curves.parquet"
    record.table().to_parquet(draft, index=False)
    draft.replace(own / "curves.parquet")
    pdf = folder / f"{record.grid.name}.pdf"
    _write(pdf, typeset(text, {name: content for name, content in pictures.items() if content}))
    return pdf


def typeset(numbers: bytes, pictures: dict[str, bytes]) -> bytes:
    """The PDF of a report.json and its figures, with the fonts that Typst brings along."""
    import typst  # noqa: PLC0415

    files = {"main.typ": TEMPLATE.read_bytes(), "report.json": numbers, **pictures}
    # Its type stub does not know of files by name, which its documentation has.
    content: bytes = typst.compile(files, format="pdf", ignore_system_fonts=True)  # type: ignore[call-overload]
    return content


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}")
    draft.write_bytes(content)
    draft.replace(path)


# --- the command ----------------------------------------------------------------------------------------------------


def publish(tracker: Tracker, name: str, profile: str | None, folder: Path) -> Path:
    """Build the report from the tracker alone, and add it to the sweep's run. Returns the PDF's path."""
    record = tracker.read_sweep(name, profile)
    pdf = build_report(record, folder)
    own, sweep_run = folder / name, tracker.sweep_run(name, profile)
    tracker.log_files(sweep_run, [pdf, own / "report.json", own / "curves.parquet"], "report")
    tracker.log_files(sweep_run, sorted((own / "figures").iterdir()), "figures")
    return pdf


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.report",
        description="Write the report of a sweep from what MLflow holds: PDF, figures, numbers and the tidy table.",
        epilog="Example: python -m study.report heads --profile smoke",
    )
    made.add_argument(
        "sweep", help=f"name of a sweep that was run, such as {', '.join(named_files(SWEEPS)) or 'heads'}"
    )
    made.add_argument("--profile", help="of the sweep (default: that of its latest run)")
    made.add_argument("--tracking", default=DEFAULT_TRACKING, metavar="URI", help="MLflow store (default: %(default)s)")
    made.add_argument("--out", type=Path, default=Path("reports"), metavar="DIR", help="default: %(default)s")
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = parser().parse(args)
    from study.tracking import Tracker  # noqa: PLC0415

    print(publish(Tracker(options.tracking), options.sweep, options.profile, options.out))
    return 0


if __name__ == "__main__":
    run(main)
