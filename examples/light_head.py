"""A fifth head, `light`: a mask of the stop lines in view whose light is not green. See docs/extend/head.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from study.birdview.targets import Moment, Polygon
from study.config.heads import Head, HeadSet
from study.episode.schema import GREEN

DEPTH = 2.0  # [m] along the road, of what is painted at a stop line


def lights_ahead(moment: Moment) -> Sequence[Polygon]:
    """Return a box at each stop line near the ego whose light is yellow or red."""
    episode, step, agent = moment.episode, moment.step, moment.agent
    if not episode.lights:
        return []
    lines = np.stack([light.stop_line for light in episode.lights])  # [L, 2, 2]
    ego = np.array([episode.x[step, agent], episode.y[step, agent]])
    near = np.hypot(*(lines.mean(axis=1) - ego).T) < moment.settings.view
    boxes = []
    for start, end in lines[near & (episode.light_state[step] != GREEN)]:
        across = (end - start) / max(float(np.hypot(*(end - start))), 1e-6)
        along = np.array([-across[1], across[0]]) * DEPTH / 2
        boxes.append(moment.polygon(np.stack([start + along, end + along, end - along, start - along])))
    return boxes


HEADS = (Head("light", channels=1, word="traffic lights", target="examples.light_head:lights_ahead"),)
HEAD_SETS = (HeadSet("rec+light", ("rec", "light"), "reconstruction and traffic lights", "#009E73", ":", "v"),)
