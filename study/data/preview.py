"""Preview: a contact sheet of frames with their targets and labels, and a film of one drive.

Both lie beside the frames, in `preview/`: `contact.png` shows training frames of both sets; `drive.gif` follows one
vehicle in real time, in the bird view that the encoder sees and on the map of the town.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from study.atomic import atomic_folder
from study.config.paper import ACCELERATIONS, IMAGE
from study.config.settings import BirdviewSettings
from study.data.birdview import Renderer, governing_light
from study.data.frames import Frames, FrameStore, unpack_masks
from study.data.selection import SETS
from study.episode.files import read_episode
from study.episode.schema import GREEN, Episode
from study.errors import BadInputError
from study.figures.pictures import contact_sheet
from study.figures.style import write

FILES = ("contact.png", "drive.gif")
SHOWN = 12  # frames of each set on the contact sheet
SECONDS, EVERY = 24.0, 2  # of the drive that are shown, and every how many steps
LARGER = 4  # pixels of the film for one of the bird view
SIDE, GAP = 512, 8  # of the map in the film [px]
COLOURS = 128  # one palette for the whole film: what does not change need not be stored again

GROUND, ROAD, OTHERS, EGO, TEXT = (20, 20, 20), (80, 80, 80), (255, 225, 0), (90, 150, 255), (230, 230, 230)
LIGHTS = ((0, 220, 0), (255, 200, 0), (255, 40, 40))  # green, yellow, red

Pixels = NDArray[np.float64]


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
    rows = np.sort(np.random.default_rng([seed]).permutation(frames.indices("train"))[:count])
    masks = np.repeat(unpack_masks(frames.masks[rows])[..., None] * np.uint8(255), 3, axis=4)
    pictures = np.concatenate([frames.images[rows][:, None], masks], axis=1)
    return [(label_text(frames, row), picture) for row, picture in zip(rows.tolist(), pictures, strict=True)]


def label_text(frames: Frames, row: int) -> str:
    """Return the labels of a frame in two short lines."""
    label = frames.labels.iloc[row]
    light = ("no red light", "yellow", "red")[int(label["light"])]
    light += f" in {label['light_distance']:.0f} m" if label["light"] else ""
    free = "way free" if np.isnan(label["lead_gap"]) else f"gap {label['lead_gap']:.0f} m"
    command = f"command {ACCELERATIONS[int(label['acceleration'])]:g}, steering {label['steering']:+.3f}"
    return f"{command}\n{label['speed']:.1f} m/s, {light}, {free}"


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
    frames = [
        _frame(view, picture, episode, ego, step)
        for view, picture, step in zip(views, _maps(episode, birdview, ego, steps), steps.tolist(), strict=True)
    ]
    few = np.concatenate([np.asarray(frame) for frame in frames[:: max(len(frames) // 8, 1)]])
    palette = Image.fromarray(few).quantize(COLOURS)
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    flat[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=flat[1:],
        duration=round(1000 * EVERY / episode.rate_hz),
        loop=0,
    )


def _frame(view: NDArray[np.uint8], chart: Image.Image, episode: Episode, ego: int, step: int) -> Image.Image:
    """Return a frame of the film: bird view and words on the left, map on the right."""
    left = IMAGE * LARGER
    frame = Image.new("RGB", (left + GAP + SIDE, SIDE), GROUND)
    frame.paste(Image.fromarray(view.repeat(LARGER, axis=0).repeat(LARGER, axis=1)), (0, 0))
    frame.paste(chart, (left + GAP, 0))
    steering, command = episode.steering[step, ego], episode.acceleration[step, ego]
    words = (
        f"drive {episode.id}, vehicle {episode.agents[ego].id}\n"
        f"{step / episode.rate_hz:.1f} s\n{abs(episode.speed[step, ego]):.1f} m/s\n"
        f"command {command:g}, steering {steering:+.3f}\n\n"
        "map: the vehicle of the picture above\n(blue) with its route, which is red\nwhere its light is not green"
    )
    font = ImageFont.load_default(13)
    ImageDraw.Draw(frame).multiline_text((GAP, left + GAP), words, fill=TEXT, font=font, spacing=5)
    return frame


def _maps(episode: Episode, birdview: BirdviewSettings, ego: int, steps: NDArray[np.int64]) -> Iterator[Image.Image]:
    """Yield the map at each step: roads, lights, the way ahead of the ego, vehicles."""
    present = episode.present
    points = [lane.centre for lane in episode.lanes] or [np.stack([episode.x[present], episode.y[present]], axis=1)]
    low, high = (np.asarray(end(np.concatenate(points), axis=0), float) for end in (np.min, np.max))
    scale = (SIDE - 3 * GAP) / max(float((high - low).max()), 1.0)
    shift = np.array([SIDE / 2, SIDE / 2]) - scale * np.array([1, -1]) * (low + high) / 2

    def pixels(places: NDArray[np.floating]) -> list[tuple[float, float]]:
        return [(x, y) for x, y in (np.asarray(places, float) * [scale, -scale] + shift).tolist()]

    roads = Image.new("RGB", (SIDE, SIDE), GROUND)
    draw = ImageDraw.Draw(roads)
    for lane in episode.lanes:
        draw.line(pixels(lane.centre), ROAD, max(1, round(lane.width * scale)))
    lamps = pixels(np.array([light.stop_line.mean(axis=0) for light in episode.lights]).reshape(-1, 2))
    states = governing_light(episode, birdview, np.stack([steps, np.full(len(steps), ego)], axis=1))
    for step, state in zip(steps.tolist(), states.tolist(), strict=True):
        picture = roads.copy()
        draw = ImageDraw.Draw(picture)
        way = _way_ahead(episode, ego, step)
        if len(way) > 1:
            draw.line(pixels(way), LIGHTS[0] if state == GREEN else LIGHTS[2], 2)
        for (x, y), colour in zip(lamps, episode.light_state[step].tolist(), strict=True):
            draw.ellipse((x - 2, y - 2, x + 2, y + 2), fill=LIGHTS[colour])
        for index in np.flatnonzero(present[step]).tolist():
            draw.polygon(pixels(_box(episode, step, index, 5.0 / scale)), EGO if index == ego else OTHERS)
        ((x, y),) = pixels(np.array([[episode.x[step, ego], episode.y[step, ego]]]))
        draw.ellipse((x - 9, y - 9, x + 9, y + 9), outline=EGO, width=2)
        yield picture


def _box(episode: Episode, step: int, index: int, least: float) -> Pixels:
    """Return the corners [4, 2] [m] of a vehicle, at least `least` [m] long, so that its direction shows."""
    agent, heading = episode.agents[index], episode.heading[step, index]
    along = np.array([np.cos(heading), np.sin(heading)]) * max(agent.length, least) / 2
    across = np.array([-np.sin(heading), np.cos(heading)]) * max(agent.width, least / 2) / 2
    middle = np.array([episode.x[step, index], episode.y[step, index]])
    return np.stack(
        [middle + along + across, middle + along - across, middle - along - across, middle - along + across]
    )


def _way_ahead(episode: Episode, ego: int, step: int) -> Pixels:
    """Return the rest [P, 2] [m] of the ego's route, empty where route or progress is unknown."""
    route, progress = episode.routes[ego].astype(float), float(episode.route_s[step, ego])
    if len(route) < 2 or not np.isfinite(progress):
        return np.empty((0, 2))
    length = np.concatenate([[0.0], np.hypot(*np.diff(route, axis=0).T).cumsum()])
    here = np.array([[np.interp(progress, length, route[:, axis]) for axis in (0, 1)]])
    return np.concatenate([here, route[length > progress]])
