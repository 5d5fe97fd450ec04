"""The data stage: drives from the town (Sec. IV-A) or from elsewhere, then the frame store that the cells read.

Drives and frames carry their key in their path, so what is there is used again.

python -m study.data build --profile laptop
python -m study.data card
python -m study.data preview
python -m study.data scenes --out scenes --episodes 30
python -m study.data import scenes
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from study.command import Parser, add_options, run, study_overrides
from study.config import (
    SWEEPS,
    BadInputError,
    StudySettings,
    drive_name,
    frames_key,
    load_profile,
    named_files,
    recording_key,
)
from study.display import Display
from study.engine.flows import run_flow
from study.imported import Imported, describe, import_drives, open_import
from study.provenance import cores
from study.stages import Flow, data_cost, recording_cost, size

DATA = Path("data")
POLICY_SEED = 1_000_000  # the policy set's drives are numbered from here: never those of the encoder set (Sec. V-A)

Described = tuple[dict[str, Any], dict[str, bytes]]  # a manifest, and files by name


def frames_folder(settings: StudySettings, root: Path = DATA, imported: Imported | None = None) -> Path:
    """Where the frame store of these settings lies, or will lie: of our town's drives, or of the imported ones."""
    return root / "frames" / frames_key(settings, imported.key if imported else None)


def drives_folder(settings: StudySettings, root: Path = DATA, imported: Imported | None = None) -> Path:
    """Where the drives behind that frame store lie, or will lie."""
    return imported.folder if imported else root / "episodes" / recording_key(settings)


def data_flow(settings: StudySettings, root: Path = DATA, imported: Imported | None = None) -> Flow[Path]:
    """Record and render whatever is missing; returns the frame store's folder.

    A store that was damaged is made again from its drives, and is what it was. Raises BadInputError when the settings
    cannot be met, the disk is too small or an imported drive has changed.
    """
    folder = frames_folder(settings, root, imported)
    # Imported here: planning needs no arrays, and frames that exist can be studied on a machine without the simulator.
    from study.frames import DamagedFramesError, frames_flow, open_frames  # noqa: PLC0415

    if (folder / "manifest.json").is_file():
        try:
            open_frames(folder, check=True)
        except DamagedFramesError as error:
            print(f"damaged frames: {error}", file=sys.stderr)
        else:
            return folder
    _check_room(
        root,
        data_cost(settings, recorded=imported is None).bytes,
        [drives_folder(settings, root), folder.with_name(f".{folder.name}.building")],
    )
    if imported:
        encoder_drives, policy_drives = imported.assign(settings.frames)
        imported.check()
    else:
        drives = yield from drives_flow(settings, root)
        split = settings.recording.encoder_episodes
        encoder_drives, policy_drives = drives[:split], drives[split:]
    yield from frames_flow(settings.frames, settings.birdview, encoder_drives, policy_drives, folder, key=folder.name)
    return folder


def drives_flow(settings: StudySettings, root: Path = DATA) -> Flow[list[Path]]:
    """Record the drives of our town that are missing, and return all; the simulator is loaded for these only.

    Raises BadInputError when the settings cannot be met, or when drives are missing where there is no simulator.
    """
    recording, folder = settings.recording, drives_folder(settings, root)
    first, second = recording.seed, recording.seed + POLICY_SEED
    seeds = [
        *range(first, first + recording.encoder_episodes),
        *range(second, second + recording.policy_episodes),
    ]
    paths = [folder / drive_name(seed) for seed in seeds]
    missing = sum(not path.exists() for path in paths)
    if not missing:
        return paths
    try:
        from study.sim.record import record_flow  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise BadInputError(
            f"{missing} of {len(paths)} drives are missing in {folder}, and {error.name}, which records them, is not "
            "installed here: run 'python -m study.data record' elsewhere with the same settings, and copy the folder"
        ) from error
    _check_room(root, recording_cost(settings).bytes, [folder])
    return (yield from record_flow(settings.town, recording, seeds, folder))


def describe_data(folder: Path, drives: Path, settings: StudySettings, imported: Imported | None) -> Described:
    """Return the manifest of the frame store and the files of its data card by name; makes what is missing."""
    from study.card import card_files, source_drives  # noqa: PLC0415 - pictures, which training needs not
    from study.frames import open_frames  # noqa: PLC0415

    if not (folder / "manifest.json").is_file():
        run_flow(data_flow(settings, DATA, imported))
    store = open_frames(folder)
    files = card_files(store, source_drives(store, drives), folder)
    return store.manifest, {path.name: path.read_bytes() for path in files}


def _check_room(root: Path, need: int, taken: Sequence[Path]) -> None:
    """Raise BadInputError when `root` has less room than what is to be made; what lies in `taken` is part of that."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(root).free
    except OSError as error:
        raise BadInputError(f"cannot write to {root}: {error.strerror}; name another working folder") from error
    need -= sum(map(_held, taken))  # what a killed command has taken is not free
    if need > free:
        raise BadInputError(
            f"{root} has {size(free)} free and the data needs about {size(need)}: "
            "free some room, or lower --frames.encoder and --recording.encoder_episodes"
        )


def _held(folder: Path) -> int:
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*") if path.is_file())


# --- the command ----------------------------------------------------------------------------------------------------


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.data",
        usage="python -m study.data {record,build,card,preview} [--profile P] [--data FOLDER] [--group.setting V ...]\n"
        "       python -m study.data import DIR [--out FOLDER]\n"
        "       python -m study.data scenes [--out FOLDER] [--episodes N]",
        description="Make the data of a study, describe it, and show it.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="record   record the drives alone: they are small, and can be rendered on another machine\n"
        "build    record the drives and render the frames, whatever of them is missing\n"
        "card     what is in the data: PNG and text beside the frame store\n"
        "preview  pictures of frames, and an animated drive, beside the frame store\n"
        "import   check and adapt the Episodes in DIR, so that 'study.sweep NAME --data FOLDER' can use them\n"
        "scenes   record highway-env's intersection, roundabout and merge as Episodes, to be imported",
    )
    made.add_argument(
        "action", choices=("record", "build", "card", "preview", "import", "scenes"), help="what to do (below)"
    )
    made.add_argument("folder", nargs="?", metavar="DIR", type=Path, help="import: where the Episodes are")
    made.add_argument(
        "--out", type=Path, metavar="FOLDER", help="import: default data/imported/<DIR's name>; scenes: data/scenes"
    )
    made.add_argument("--episodes", type=int, default=30, metavar="N", help="scenes: drives in all (default: 30)")
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
        made = import_drives(options.folder, options.out or DATA / "imported" / options.folder.resolve().name)
        print(describe(made))
        print(made.folder)
        return 0
    if options.action == "scenes":
        from study.sim.scenes import record_scenes  # noqa: PLC0415

        folder = options.out or DATA / "scenes"
        record_scenes(folder, options.episodes, progress=_count)
        print(folder)
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
    from study.engine.cluster import local_engine  # noqa: PLC0415 - Dask, which --help does not need

    if workers == 1:
        return run_flow(flow, progress=display.data)
    with local_engine(workers, DATA / "tmp") as engine:
        return run_flow(flow, engine, display.data)


def _show(action: str, folder: Path, drives_at: Path) -> None:
    """Make the card or the preview anew."""
    from study.card import source_drives, write_card  # noqa: PLC0415
    from study.frames import open_frames  # noqa: PLC0415

    store = open_frames(folder)
    drives = source_drives(store, drives_at)
    if action == "card":
        files = write_card(store, drives, folder)
        print(files[1].read_text(encoding="utf-8"))
    else:
        from study.preview import write_preview  # noqa: PLC0415

        files = write_preview(store, drives, folder)
    print(*files, sep="\n")


def _count(done: int, whole: int) -> None:
    print(f"{done} of {whole} drives", file=sys.stderr)


if __name__ == "__main__":
    run(main)
