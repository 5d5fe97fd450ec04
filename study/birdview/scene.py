"""Pictures of a driven Episode: the town around the ego from above, what the ego sees, and what it does."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from study.birdview.targets import FRACTION_BITS, Floats, corners, fixed_point, painted_sizes
from study.config.paper import ACCELERATIONS, IMAGE
from study.episode.schema import VEHICLE, Episode
from study.figures.style import BLUE, FRACTION_COLOUR, GREY, VERMILION

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

SIDE = 4 * IMAGE  # of the town's and of the view's picture [px]
WORDS = 80  # height of the words below [px]
LEAST = 1.5  # side of a cyclist or pedestrian at least, as painted [m]
SCALE = 2.56  # of the town's picture [px/m]: 100 m a side
ROAM, AHEAD = 25.0, 15.0  # the picture stands still until the ego is so far from its middle, then looks ahead [m]
WORD_OF_LEVEL = dict(zip(ACCELERATIONS, ("brake", "keep", "go"), strict=True))
ENDINGS = {
    "time": "drove to the end",
    "collision": "collision",
    "off route": "left its route",
    "blocked": "stood without cause",
    "failure": "no command",
}


def _colour(code: str) -> Colour:
    red, green, blue = bytes.fromhex(code[1:])
    return red, green, blue


EGO, WARNING, OTHERS = _colour(BLUE), _colour(VERMILION), _colour(GREY)
_, AMBER, GREEN, SKY, _ = map(_colour, FRACTION_COLOUR)
LIGHTS, WORD_OF_LIGHT = (GREEN, AMBER, WARNING), ("green", "yellow", "red")
LEVELS = dict(zip(ACCELERATIONS, (WARNING, OTHERS, GREEN), strict=True))
PAGE, KERB, ROAD, LINE, INK = map(_colour, ("#FFFFFF", "#969696", "#DEDEDE", "#FFFFFF", "#222222"))


class Scene:
    """Draws steps of an Episode whose `source["drive"]` says which agent is the ego, and where its crop lies.

    The town's picture has north up: the planned route light blue, the way driven orange. It stands still and jumps
    after the ego, so that it depends on the steps drawn before. `ego` is a column of the Episode.
    """

    def __init__(self, episode: Episode, ego: int, crop: float, first: int = 0) -> None:
        self.episode, self.ego, self.crop, self.first = episode, ego, crop, first
        self._fonts = [ImageFont.load_default(size) for size in (12, 16)]
        self._labels: dict[tuple[str, Colour, int], Pillow.Image] = {}
        self._sizes = painted_sizes(episode.agents, LEAST)
        self._middle = np.full(2, np.inf)  # of the town's picture [m]
        points = np.concatenate([lane.centre for lane in episode.lanes] or [np.zeros((1, 2))])
        margin = SIDE / SCALE
        west, north = points[:, 0].min() - margin, points[:, 1].max() + margin
        columns, rows = np.ceil((points.max(axis=0) - points.min(axis=0) + 2 * margin) * SCALE).astype(int).tolist()
        self._affine = np.array([[SCALE, 0, -west * SCALE], [0, -SCALE, north * SCALE]])
        self._map = np.full((rows, columns, 3), PAGE, np.uint8)
        self._paint_map()

    def _paint_map(self) -> None:
        lanes = [(fixed_point(lane.centre, self._affine), lane.width * SCALE) for lane in self.episode.lanes]
        for colour, more in ((KERB, 3), (ROAD, 0)):
            for centre, width in lanes:
                _line(self._map, centre, colour, round(width) + more)
        for lane in self.episode.lanes:
            if lane.left == "dashed":  # between two lanes
                way = np.gradient(lane.centre, axis=0)
                aside = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.hypot(*way.T)[:, None].clip(1e-9)
                _line(self._map, fixed_point(lane.centre + aside * lane.width / 2, self._affine), LINE, 1)
        if len(route := self.episode.routes[self.ego]):
            _line(self._map, fixed_point(route.astype(np.float64), self._affine), SKY, 3)

    def frame(self, step: int, view: Image, command: int | None = None) -> Image:
        """Return the picture [336, 512, 3] uint8 RGB of a step; `view` [64, 64, 3] is what the ego sees there.

        `command` is the step whose command is shown, if not the same.
        """
        words = self._words(step, step if command is None else command)
        enlarged = cv2.resize(view, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
        return np.vstack([np.hstack([self.town(step), enlarged]), words])

    def town(self, step: int) -> Image:
        """Return the town around the ego [256, 256, 3] uint8 RGB."""
        episode, ego = self.episode, self.ego
        at = np.array([episode.x[step, ego], episode.y[step, ego]], np.float64)
        if np.abs(at - self._middle).max() > ROAM:
            heading = episode.heading[step, ego]
            self._middle = at + AHEAD * np.array([np.cos(heading), np.sin(heading)])
        affine, picture = self._cut()
        for light, state in zip(episode.lights, episode.light_state[step].tolist(), strict=True):
            _line(picture, fixed_point(light.stop_line, affine), LIGHTS[state], 3)
        trail = np.stack([episode.x[self.first : step + 1, ego], episode.y[self.first : step + 1, ego]], axis=1)
        _line(picture, fixed_point(trail.astype(np.float64), affine), AMBER, 2)
        poses = np.stack([episode.x[step], episode.y[step], episode.heading[step]], axis=1).astype(np.float64)
        near = episode.present[step] & (np.abs(poses[:, :2] - self._middle).max(axis=1) < SIDE / SCALE)
        near[ego] = False
        agents = [*np.flatnonzero(near).tolist(), ego]
        for agent, box in zip(agents, self._boxes(poses[agents], affine, agents), strict=True):
            colour = EGO if agent == ego else OTHERS if episode.agents[agent].kind == VEHICLE else INK
            cv2.fillConvexPoly(picture, box, colour, cv2.LINE_AA, FRACTION_BITS)
        return picture

    def _cut(self) -> tuple[Floats, Image]:
        """Return the map from the world [m] to the town's picture [px], and the picture without anything that moves."""
        corner = np.rint(self._affine @ [*self._middle, 1.0] - SIDE / 2)
        column, row = corner.astype(int).clip(0, np.array(self._map.shape[1::-1]) - SIDE).tolist()
        affine = self._affine - np.array([[0, 0, column], [0, 0, row]])
        return affine, self._map[row : row + SIDE, column : column + SIDE].copy()

    def crash(self, picture: Image, collision: dict[str, Any]) -> None:
        """Mark in the frame drawn last where the ego and the other agent stood when they met."""
        affine, _ = self._cut()
        town = picture[:SIDE, :SIDE].copy()
        poses = np.array([collision["other"][:3], collision["ego"][:3]])
        other = [agent.id for agent in self.episode.agents].index(collision["agent"])
        for box, colour in zip(self._boxes(poses, affine, [other, self.ego]), (OTHERS, EGO), strict=True):
            cv2.fillConvexPoly(town, box, colour, cv2.LINE_AA, FRACTION_BITS)
            cv2.polylines(town, [box], True, WARNING, 2, cv2.LINE_AA, FRACTION_BITS)  # noqa: FBT003
        picture[:SIDE, :SIDE] = town

    def _boxes(self, poses: Floats, affine: Floats, agents: list[int]) -> NDArray[np.int32]:
        """Return the boxes [N, 4, 2] of agents at poses [N, 3] in fixed-point pixels."""
        return fixed_point(corners(poses, *self._sizes[agents].T).reshape(-1, 2), affine).reshape(-1, 4, 2)

    def _words(self, step: int, command: int) -> Image:
        """Return the words below a frame: time, speed, steering, acceleration and light."""
        episode, ego = self.episode, self.ego
        canvas = Pillow.new("RGB", (2 * SIDE, WORDS), PAGE)
        draw = ImageDraw.Draw(canvas)
        self._write(canvas, (10, 9), f"{(step - self.first) / episode.rate_hz:.1f} s")
        self._write(canvas, (78, 9), f"{abs(episode.speed[step, ego]):.1f} m/s")
        light, distance = int(episode.light[step, ego]), float(episode.light_distance[step, ego])
        if light >= 0:
            state = int(episode.light_state[step, light])
            draw.ellipse((158, 13, 168, 23), LIGHTS[state])
            self._write(canvas, (174, 11), f"{WORD_OF_LIGHT[state]} in {max(distance, 0):.0f} m", INK, 0)
        else:
            self._write(canvas, (158, 11), "no light ahead", OTHERS, 0)
        if command >= 0 and np.isfinite(episode.steering[command, ego]):
            self._steering(canvas, draw, float(episode.steering[command, ego]))
            level = float(episode.acceleration[command, ego])
            self._write(canvas, (460, 9), WORD_OF_LEVEL[level], LEVELS[level])
        return np.asarray(canvas)

    def _steering(self, canvas: Pillow.Image, draw: ImageDraw.ImageDraw, steering: float) -> None:
        """Draw the command as a bar from the middle to its side; the frame's ends are the crop."""
        middle, half = 362, 80
        self._write(canvas, (middle - half, 27), f"steering {round(steering, 2) + 0.0:+.2f}", OTHERS, 0)
        self._write(canvas, (middle + half - 56, 27), f"crop {self.crop:g}", OTHERS, 0)
        end = middle - half * float(np.clip(steering / self.crop, -1, 1))  # to the left is positive
        colour = WARNING if abs(steering) >= self.crop * (1 - 1e-6) else EGO
        draw.rectangle((min(middle, end), 10, max(middle, end), 23), colour)
        draw.rectangle((middle - half, 9, middle + half, 24), outline=KERB)
        draw.line((middle, 6, middle, 27), INK)

    def write(self, picture: Image, text: str, colour: Colour = INK) -> None:
        """Write a line of text at the bottom of a frame, in place."""
        canvas = Pillow.fromarray(picture[-WORDS + 48 :])
        self._write(canvas, (10, 4), text, colour, int(self._fonts[1].getlength(text) < 2 * SIDE - 12))
        picture[-WORDS + 48 :] = np.asarray(canvas)

    def _write(
        self, canvas: Pillow.Image, place: tuple[int, int], text: str, colour: Colour = INK, size: int = 1
    ) -> None:
        """Write a text, drawn once for all frames: drawing it takes longer than everything else of a frame."""
        label = self._labels.get((text, colour, size))
        if label is None:
            font = self._fonts[size]
            label = Pillow.new("RGB", (int(font.getlength(text)) + 2, 28), PAGE)
            ImageDraw.Draw(label).text((0, 0), text, colour, font)
            self._labels[text, colour, size] = label
        canvas.paste(label, place)


def _line(picture: Image, points: NDArray[np.int32], colour: Colour, width: int) -> None:
    cv2.polylines(picture, [points], False, colour, width, cv2.LINE_AA, FRACTION_BITS)  # noqa: FBT003
