"""The data stage: drives from the town (Sec. IV-A) or from elsewhere, then the frame store that the cells read.

Drives and frames carry their key in their path, so what is there is used again.

python -m study.data build --profile laptop
python -m study.data card
python -m study.data preview
python -m study.data import DIR
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from study.compute.provenance import cores
from study.config.files import load_profile, named_files
from study.config.settings import StudySettings
from study.config.workspace import DATA, SWEEPS
from study.console.display import Display
from study.console.options import Parser, add_options, run, study_overrides
from study.data.prepare import data_flow, drives_flow, drives_folder
from study.engine.flows import run_flow
from study.episode.imported import open_import
from study.errors import BadInputError
from study.stages import Flow, data_cost, recording_cost


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.data",
        usage="python -m study.data {record,build,card,preview} [--profile P] [--data FOLDER] [--group.setting V ...]\n"
        "       python -m study.data import DIR [--out FOLDER]",
        description="Make the data of a study, describe it, and show it.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="record   record the drives alone: they are small, and can be rendered on another machine\n"
        "build    record the drives and render the frames, whatever of them is missing\n"
        "card     what is in the data: PNG and text beside the frame store\n"
        "preview  pictures of frames, and an animated drive, beside the frame store\n"
        "import   check and adapt the Episodes in DIR, so that 'study.sweep NAME --data FOLDER' can use them",
    )
    made.add_argument("action", choices=("record", "build", "card", "preview", "import"), help="what to do (below)")
    made.add_argument("folder", nargs="?", metavar="DIR", type=Path, help="import: where the Episodes are")
    made.add_argument("--out", type=Path, metavar="FOLDER", help="import: default data/imported/<DIR's name>")
    made.add_argument(
        "--profile", default="laptop", help=f"{', '.join(named_files(SWEEPS / 'profiles'))} (default: laptop)"
    )
    made.add_argument(
        "--data", type=Path, metavar="FOLDER", help="imported drives (study.data import); default: our town's"
    )
    made.add_argument("--workers", type=int, default=cores(), metavar="N", help="processes (default: all cores)")
    add_options(made, StudySettings)
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = parser().parse(args)
    if options.action == "import" and options.folder is None:
        raise BadInputError("import: no DIR given; name the folder with the Episodes")
    if options.action != "import" and options.folder is not None:
        raise BadInputError(f"'{options.folder}' is one word too many; only import takes a DIR")
    if options.action == "import":
        from study.episode.importing import describe, import_drives  # noqa: PLC0415 - arrays, which --help can do without

        made = import_drives(options.folder, options.out or DATA / "imported" / options.folder.resolve().name)
        print(describe(made))
        print(made.folder)
        return 0
    settings = load_profile(options.profile, study_overrides(options))
    if options.workers < 1:
        raise BadInputError(f"--workers is {options.workers}; it must be 1 or more")
    imported = open_import(options.data) if options.data else None
    if options.action == "record":
        if imported:
            raise BadInputError(f"record: the drives in {options.data} are recorded already; leave out --data")
        with Display(f"drives ({options.profile})", {}, {}, recording_cost(settings).seconds) as display:
            print(_make(drives_flow(settings), options.workers, display)[0].parent)
        return 0
    expected = data_cost(settings, recorded=imported is None)
    with Display(f"data ({options.profile})", {}, {}, expected.seconds) as display:
        folder = _make(data_flow(settings, DATA, imported), options.workers, display)
    print(folder)
    if options.action != "build":
        _show(options.action, folder, drives_folder(settings, DATA, imported))
    return 0


def _make(flow: Flow[Any], workers: int, display: Display) -> Any:
    from study.engine.local import local_engine  # noqa: PLC0415 - Dask, which --help does not need

    if workers == 1:
        return run_flow(flow, progress=display.data)
    with local_engine(workers, DATA / "tmp") as engine:
        return run_flow(flow, engine, display.data)


def _show(action: str, folder: Path, drives_at: Path) -> None:
    """Make the card or the preview anew."""
    from study.data.card import source_drives, write_card  # noqa: PLC0415
    from study.data.frames import open_frames  # noqa: PLC0415

    store = open_frames(folder)
    drives = source_drives(store, drives_at)
    if action == "card":
        files = write_card(store, drives, folder)
        print(files[1].read_text(encoding="utf-8"))
    else:
        from study.data.preview import write_preview  # noqa: PLC0415

        files = write_preview(store, drives, folder)
    print(*files, sep="\n")


if __name__ == "__main__":
    run(main)
