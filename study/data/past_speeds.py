"""True speeds of the past second, from the drives that frames were made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.birdview.renderer import Moments
from study.episode.files import read_episode
from study.episode.head import episode_digest
from study.episode.schema import Episode
from study.errors import BadInputError


def past_speeds(
    labels: pd.DataFrame, sources: Sequence[Mapping[str, str]], drives: Path, steps: Sequence[int]
) -> NDArray[np.float64]:
    """Return the speed that many steps of 0.1 s before each frame [N, len(steps), m/s]; an unrecorded one is unchanged.

    `sources` lists the set's drives, name and digest, as a frame store's manifest does; they lie in `drives`.
    Raises BadInputError when a drive is missing or has changed.
    """
    past = np.empty((len(labels), len(steps)))
    for number, rows in labels.reset_index(drop=True).groupby("episode"):
        source = sources[int(str(number))]
        folder = drives / Path(source["name"]).name
        if not (folder / "episode.json").is_file() or episode_digest(folder) != source["digest"]:
            raise BadInputError(
                f"true speeds need the drives that the frames were made from, and {folder} is missing or has changed; "
                "delete the frame store to make both again, or leave out what needs them: state of --baselines, "
                "--policy.inputs z"
            )
        episode = read_episode(folder)
        column = {agent.id: place for place, agent in enumerate(episode.agents)}
        moments = np.stack([rows["step"].to_numpy(), rows["agent"].map(column).to_numpy()], axis=1)
        past[rows.index] = speeds_before(episode, moments, steps)
    return past


def speeds_before(episode: Episode, moments: Moments, steps: Sequence[int]) -> NDArray[np.float64]:
    """Return the same of moments [M, 2] of one Episode."""
    times, agents = moments[:, :1] - np.asarray(steps), moments[:, 1:]
    speed = np.where(times < 0, np.nan, episode.speed[np.maximum(times, 0), agents])
    return np.where(np.isnan(speed), episode.speed[moments[:, :1], agents], speed).astype(np.float64)
