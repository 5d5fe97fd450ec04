"""Films of driven Episodes: see `Scene` for what they show.

Browsers, and so MLflow's pages, play WebM and GIF; an MP4 of OpenCV's is for players.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from study.birdview.renderer import Renderer
from study.birdview.scene import ENDINGS, GREEN, SIDE, WARNING, WORDS, Scene
from study.config.settings import BirdviewSettings
from study.episode.schema import Episode
from study.errors import BadInputError, one_of

Image = NDArray[np.uint8]
CODECS = {".mp4": "mp4v", ".webm": "VP80"}  # OpenCV's wheels encode no H.264; VP9 takes ten times as long
SUFFIXES = (*CODECS, ".gif")
EVERY = 2  # of how many steps a GIF shows one
HOLD = 2.0  # the last picture, with what ended the drive, stays this long [s]
COLOURS = 48  # of a GIF


def check_suffix(path: Path) -> None:
    """Raise BadInputError for a file that is no film by its name."""
    if path.suffix.lower() not in SUFFIXES:
        raise one_of("kind of film", path.suffix or path.name, SUFFIXES)


def film(episode: Episode, birdview: BirdviewSettings, suffix: str = ".mp4", score: float | None = None) -> bytes:
    """Return the film of a drive that `rollout` returned, in real time; `score` is its driving score, 0 to 100.

    A GIF shows every second step, the others show every one. Raises BadInputError for another suffix.
    """
    check_suffix(Path(f"film{suffix}"))
    every = EVERY if suffix.lower() == ".gif" else 1
    frames = pictures(episode, birdview, every, score)
    rate = episode.rate_hz / every
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix.lower()}"
        (_write_gif if every > 1 else _write_video)(path, frames, rate)
        return path.read_bytes()


def pictures(
    episode: Episode, birdview: BirdviewSettings, every: int = 1, score: float | None = None
) -> Iterator[Image]:
    """Yield the pictures [336, 512, 3] uint8 RGB of every few steps, and then the last one, with what ended the drive.

    A drive that ended before its first step has the last one only.
    """
    facts = episode.source["drive"]
    ego = [agent.id for agent in episode.agents].index(facts["ego"])
    first, last = facts["first_step"], episode.steps - 1
    scene = Scene(episode, ego, facts["crop"], min(first, last))
    steps = np.append(np.arange(first, last, every), last)
    views, _ = Renderer(episode, birdview, ()).render(np.stack([steps, np.full(len(steps), ego)], axis=1))
    title = f"{facts['actor']}, drive {episode.id}"
    for view, step in zip(views, steps.tolist(), strict=True):
        picture = scene.frame(step, view)
        scene.write(picture, title)
        yield picture
    picture = scene.frame(last, views[-1])
    if facts["collision"]:
        scene.crash(picture, facts["collision"])
    scored = "" if score is None else f", driving score {score:.0f}"
    scene.write(picture, f"{title}: {ENDINGS[facts['ended']]}{scored}", GREEN if facts["ended"] == "time" else WARNING)
    for _ in range(round(HOLD * episode.rate_hz / every)):
        yield picture


def _write_video(path: Path, frames: Iterator[Image], rate: float) -> None:
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*CODECS[path.suffix]), rate, (2 * SIDE, SIDE + WORDS)
    )
    if not writer.isOpened():
        raise BadInputError(f"this build of OpenCV cannot write {path.suffix} films; name a .gif")
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def _write_gif(path: Path, frames: Iterator[Image], rate: float) -> None:
    drawn = list(frames)
    palette = Pillow.fromarray(np.concatenate(drawn[:: max(len(drawn) // 8, 1)])).quantize(COLOURS)
    first, *rest = (Pillow.fromarray(frame).quantize(palette=palette, dither=Pillow.Dither.NONE) for frame in drawn)
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)
