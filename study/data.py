"""The data stage: drives from the town (Sec. IV-A), then the frame store that the cells read.

Both products carry their key in their path, so what is there is used again.

python -m study.data build --profile laptop
python -m study.data card
python -m study.data preview
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from study.command import Parser, add_options, run, study_overrides
from study.config import SWEEPS, BadInputError, StudySettings, frames_key, load_profile, named_files, recording_key
from study.cost import data_cost, size

DATA = Path("data")
POLICY_SEED = 1_000_000  # the policy set's drives are numbered from here: never those of the encoder set (Sec. V-A)

Progress = Callable[[str, int, int], None]


def frames_folder(settings: StudySettings, root: Path = DATA) -> Path:
    """Where the frame store of these settings lies, or will lie."""
    return root / "frames" / frames_key(settings)


def prepare(settings: StudySettings, root: Path, processes: int, progress: Progress) -> Path:
    """The frame store's folder, after recording and rendering whatever is missing.

    `progress(stage, done, total)` with stage "record" (drives) or "render" (frames).
    Raises BadInputError when the settings cannot be met, the disk is too small or the store there is damaged.
    """
    folder = frames_folder(settings, root)
    # Imported here: planning needs no arrays, and frames that exist can be studied on a machine without the simulator.
    from study.frames import build_frames, open_frames  # noqa: PLC0415

    if (folder / "manifest.json").is_file():
        open_frames(folder, check=True)  # a store that was damaged since is told now, not by every cell
        return folder
    _check_room(settings, root)
    from study.sim.record import record_all  # noqa: PLC0415

    recording = settings.recording
    first, second = recording.seed, recording.seed + POLICY_SEED
    seeds = [
        *range(first, first + recording.encoder_episodes),
        *range(second, second + recording.policy_episodes),
    ]
    drives = record_all(
        settings.town,
        recording,
        seeds,
        root / "episodes" / recording_key(settings),
        processes,
        lambda done, whole: progress("record", done, whole),
    )
    split = recording.encoder_episodes
    build_frames(
        settings.frames,
        settings.birdview,
        drives[:split],
        drives[split:],
        folder,
        processes,
        lambda stage, done, whole: progress(stage, done, whole) if stage == "render" else None,
        key=frames_key(settings),
    )
    return folder


def _check_room(settings: StudySettings, root: Path) -> None:
    try:
        root.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(root).free
    except OSError as error:
        raise BadInputError(f"cannot write to {root}: {error.strerror}; name another working folder") from error
    need = data_cost(settings).bytes
    if need > free:
        raise BadInputError(
            f"{root} has {size(free)} free and the data needs about {size(need)}: "
            "free some room, or lower --frames.encoder and --recording.encoder_episodes"
        )


# --- the command ----------------------------------------------------------------------------------------------------


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.data",
        usage="python -m study.data {build,card,preview} [--profile P] [--group.setting VALUE ...]",
        description="Make the data of a study, describe it, and show it.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="build    record the drives and render the frames, whatever of them is missing\n"
        "card     what is in the data: PNG and text beside the frame store\n"
        "preview  pictures of frames, and an animated drive, beside the frame store",
    )
    made.add_argument("action", choices=("build", "card", "preview"), help="what to do (below)")
    made.add_argument(
        "--profile", default="laptop", help=f"{', '.join(named_files(SWEEPS / 'profiles'))} (default: laptop)"
    )
    made.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores")
    add_options(made, StudySettings)
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = parser().parse(args)
    settings = load_profile(options.profile, study_overrides(options))
    if options.processes < 1:
        raise BadInputError(f"--processes is {options.processes}; it must be 1 or more")
    from study.display import Display  # noqa: PLC0415

    with Display(f"data ({options.profile})", {}, {}, data_cost(settings).seconds) as display:
        folder = prepare(settings, DATA, options.processes, display.data)
    print(folder)
    if options.action != "build":
        _show(options.action, settings, folder)
    return 0


def _show(action: str, settings: StudySettings, folder: Path) -> None:
    """Make the card or the preview anew."""
    from study.card import source_drives, write_card  # noqa: PLC0415
    from study.frames import open_frames  # noqa: PLC0415

    store = open_frames(folder)
    drives = source_drives(store, DATA / "episodes" / recording_key(settings))
    if action == "card":
        files = write_card(store, drives, folder)
        print(files[1].read_text(encoding="utf-8"))
    else:
        from study.preview import write_preview  # noqa: PLC0415

        files = write_preview(store, drives, folder)
    print(*files, sep="\n")


if __name__ == "__main__":
    run(main)
