"""Flows that prepare a study's data: drives, frames and the data card."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from study.config.keys import drive_name, frames_key, recording_key
from study.config.modules import load_modules
from study.config.settings import StudySettings
from study.config.workspace import HERE
from study.engine.flows import run_flow
from study.errors import BadInputError
from study.intake.imported import Imported
from study.stages import Flow, data_cost, recording_cost, size_text

POLICY_SEED = 1_000_000  # the policy set's drives are numbered from here: never those of the encoder set (Sec. V-A)

Described = tuple[dict[str, Any], dict[str, bytes]]  # a manifest, and files by name


def frames_folder(settings: StudySettings, root: Path = HERE.data, imported: Imported | None = None) -> Path:
    """Return the folder of the frame store of these settings, made or not, of our town's or of imported drives."""
    return root / "frames" / frames_key(settings, imported.key if imported else None)


def drives_folder(settings: StudySettings, root: Path = HERE.data, imported: Imported | None = None) -> Path:
    """Return the folder of the drives of that frame store, recorded or not."""
    return imported.folder if imported else root / "episodes" / recording_key(settings)


def data_flow(settings: StudySettings, root: Path = HERE.data, imported: Imported | None = None) -> Flow[Path]:
    """Record and render whatever is missing, and return the frame store's folder.

    A damaged store is made again from its drives. Raises BadInputError when the settings cannot be met, the disk is
    too small or an imported drive has changed.
    """
    folder = frames_folder(settings, root, imported)
    # Imported here: planning needs no arrays, and frames that exist can be studied on a machine without the simulator.
    from study.data.build import frames_flow  # noqa: PLC0415
    from study.data.frames import DamagedFramesError, open_frames  # noqa: PLC0415

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
    yield from frames_flow(
        settings.frames,
        settings.birdview,
        encoder_drives,
        policy_drives,
        folder,
        key=folder.name,
        recordings=imported.recordings if imported else {},
    )
    return folder


def drives_flow(settings: StudySettings, root: Path = HERE.data) -> Flow[list[Path]]:
    """Record the drives of our town that are missing, and return all.

    Raises BadInputError when the settings cannot be met, or when drives are missing and the simulator is not installed.
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
    return (yield from record_flow(settings.town, settings.dynamics, recording, seeds, folder))


def describe_data(
    root: Path, settings: StudySettings, imported: Imported | None, modules: Sequence[str] = ()
) -> Described:
    """Return the manifest of the frame store and the files of its data card by name; makes what is missing."""
    from study.data.card import card_files, source_drives  # noqa: PLC0415 - pictures, which training needs not
    from study.data.frames import open_frames  # noqa: PLC0415

    load_modules(modules)
    folder = frames_folder(settings, root, imported)
    if not (folder / "manifest.json").is_file():
        run_flow(data_flow(settings, root, imported))
    store = open_frames(folder)
    files = card_files(store, source_drives(store, drives_folder(settings, root, imported)), folder)
    return store.manifest, {path.name: path.read_bytes() for path in files}


def _check_room(root: Path, need: int, taken: Sequence[Path]) -> None:
    """Raise BadInputError when `root` has too little room; files in `taken` are part of the need."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(root).free
    except OSError as error:
        raise BadInputError(f"cannot write to {root}: {error.strerror}; name another working folder") from error
    # What a killed command has written is not free.
    need -= sum(path.stat().st_blocks * 512 for folder in taken for path in folder.rglob("*") if path.is_file())
    if need > free:
        raise BadInputError(
            f"{root} has {size_text(free)} free and the data needs about {size_text(need)}: "
            "free some room, or lower --frames.encoder and --recording.encoder_episodes"
        )
