"""Preview: a contact sheet of frames with their targets and labels, and a film of one drive.

Both lie beside the frames, in `preview/`: `contact.png` shows training frames of both sets; `drive.gif` follows one
vehicle in real time, in the bird view that the encoder sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from study.atomic import atomic_folder
from study.birdview.renderer import Renderer
from study.config.paper import ACCELERATIONS, IMAGE
from study.config.settings import BirdviewSettings
from study.data.frames import Frames, FrameStore, unpack_masks
from study.data.selection import SETS
from study.episode.files import read_episode
from study.episode.schema import Episode
from study.errors import BadInputError
from study.figures.pictures import contact_sheet
from study.figures.style import write
from study.randomness import rng

FILES = ("contact.png", "drive.gif")
SHOWN = 12  # frames of each set on the contact sheet
SECONDS, EVERY = 24.0, 2  # of the drive that are shown, and every how many steps
LARGER = 4  # pixels of the film for one of the bird view
WORDS = 40  # height of the text below [px]
COLOURS = 128  # one palette for the whole film: what does not change need not be stored again


def write_preview(store: FrameStore, drives: Sequence[Path], folder: Path) -> tuple[Path, ...]:
    """Write both files below `folder`, atomically, and return them; the film shows the first of `drives`.

    Raises BadInputError when there is no drive or it cannot be read.
    """
    if not drives:
        raise BadInputError(
            f"none of the drives that {folder} was made from exists any more: "
            "delete that folder and build it again; this records the drives, too"
        )
    birdview = BirdviewSettings.model_validate(store.manifest["settings"]["birdview"])
    with atomic_folder(folder / "preview") as draft:
        sets = {name: sample(getattr(store, name), number) for number, name in enumerate(SETS)}
        write(contact_sheet(sets), draft / FILES[0])
        write_film(read_episode(drives[0]), birdview, draft / FILES[1])
    return tuple(folder / "preview" / name for name in FILES)


# --- contact sheet --------------------------------------------------------------------------------------------------


def sample(frames: Frames, seed: int, count: int = SHOWN) -> list[tuple[str, NDArray[np.uint8]]]:
    """Return random training frames: label in words, and input and masks as [1 + K, 64, 64, 3] uint8."""
    rows = np.sort(rng(seed, "preview").permutation(frames.indices("train"))[:count])
    masks = np.repeat(unpack_masks(frames.masks[rows])[..., None] * np.uint8(255), 3, axis=4)
    pictures = np.concatenate([frames.images[rows][:, None], masks], axis=1)
    return [(label_text(frames, row), picture) for row, picture in zip(rows.tolist(), pictures, strict=True)]


def label_text(frames: Frames, row: int) -> str:
    """Return the labels of a frame in two short lines."""
    label = frames.labels.iloc[row]
    light = ("no red light", "yellow", "red")[int(label["light"])]
    light += f" in {label['light_distance']:.0f} m" if label["light"] else ""
    gap = "way free" if np.isnan(label["lead_gap"]) else f"gap {label['lead_gap']:.0f} m"
    known = frames.labels["lead_gap"].notna().any()  # else nobody has written gaps: the way may be free or not
    command = f"command {ACCELERATIONS[int(label['acceleration'])]:g}, steering {label['steering']:+.3f}"
    return f"{command}\n{label['speed']:.1f} m/s, {light}" + (f", {gap}" if known else "")


# --- film -----------------------------------------------------------------------------------------------------------


def choose_ego(episode: Episode) -> tuple[int, NDArray[np.int64]]:
    """Return index and steps of the vehicle that is present longest, then passes most lights, then goes farthest.

    Raises BadInputError when no vehicle may be ego.
    """
    most = round(SECONDS * episode.rate_hz)
    steps = {
        index: np.flatnonzero(episode.present[:, index])[:most]
        for index, agent in enumerate(episode.agents)
        if agent.ego and episode.present[:, index].any()
    }
    if not steps:
        raise BadInputError(f"Episode {episode.id} has no vehicle that may be ego; choose another drive")

    def score(index: int) -> tuple[float, ...]:
        at = steps[index], index
        return len(at[0]), float(np.count_nonzero(np.diff(episode.light[at]))), float(np.abs(episode.speed[at]).sum())

    ego = max(steps, key=score)
    return ego, steps[ego][::EVERY]


def write_film(episode: Episode, birdview: BirdviewSettings, path: Path) -> None:
    """Write the film of one vehicle's drive as a GIF. Raises BadInputError for an Episode that has no ego."""
    ego, steps = choose_ego(episode)
    views, _ = Renderer(episode, birdview).render(np.stack([steps, np.full(len(steps), ego)], axis=1))
    font = ImageFont.load_default(11)
    frames = []
    for view, step in zip(views, steps.tolist(), strict=True):
        steering, command = episode.steering[step, ego], episode.acceleration[step, ego]
        words = (
            f"{episode.id}, vehicle {episode.agents[ego].id}, {step / episode.rate_hz:.1f} s\n"
            f"{abs(episode.speed[step, ego]):.1f} m/s, command {command:g}, steering {steering:+.3f}"
        )
        frame = Image.new("RGB", (IMAGE * LARGER, IMAGE * LARGER + WORDS))
        frame.paste(Image.fromarray(view.repeat(LARGER, axis=0).repeat(LARGER, axis=1)), (0, 0))
        ImageDraw.Draw(frame).multiline_text((4, IMAGE * LARGER + 4), words, font=font)
        frames.append(frame)
    few = np.concatenate([np.asarray(frame) for frame in frames[:: max(len(frames) // 8, 1)]])
    palette = Image.fromarray(few).quantize(COLOURS)
    first, *rest = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = round(1000 * EVERY / episode.rate_hz)
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0)
