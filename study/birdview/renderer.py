"""Bird view: moments of an Episode as images and masks (Sec. III-A).

Layers, in paint order: map (drivable surface, road boundary, lane lines), the planned way ahead (green, or red by the
light that governs it), other agents' past and present poses (vehicles yellow, cyclists lime, pedestrians
orange), the ego's (blue). Everything is painted with
hard edges at `settings.render` pixels a side, as indices into a palette, and area-averaged to 64.

The map does not change during a drive, so it is painted once for each Episode; a frame cuts its window out of that
picture and paints the moving things into it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from study.birdview.targets import FRACTION_BITS, Floats, Moment, find_target, fixed_point, painted_sizes
from study.config.heads import mask_heads
from study.config.paper import IMAGE
from study.config.settings import BirdviewSettings
from study.episode.schema import CYCLIST, GREEN, PEDESTRIAN, RATE_HZ, VEHICLE, Episode, Lane
from study.errors import BadInputError

MASK_BYTES = IMAGE * IMAGE // 8

SURFACE = (16, 8)  # grey of a lane: the first, and how much lighter for each LIMIT_STEP of its speed limit
PLAIN_SURFACE = 80  # grey where all lanes have one limit, and that of 40 km/h
LIMIT_STEP, LIMIT_SHADES = 5 / 3.6, 20  # [m/s]; limits of 95 km/h and more look alike
BOUNDARY, LINE = 176, 255  # greys of curbs and of lane lines
BOUNDARY_WIDTH, LINE_WIDTH, ROUTE_WIDTH = 0.5, 0.3, 2.0  # [m]
# Palette of poses, RGB: by class, but for the ego
AGENTS = {VEHICLE: (255, 255, 0), "ego": (0, 0, 255), CYCLIST: (128, 255, 0), PEDESTRIAN: (255, 128, 0)}
LEAST = 1.6  # side of a painted cyclist or pedestrian at least [pixels of the image]: any such square sets a mask
DASH = 3.0  # [m], length of a dash and of the gap behind it
ROUTE_POINTS = 2.0  # [m] apart: 0.1 m off on the tightest turn of a car

MAP_BYTES = 1 << 26  # a larger map (1.3 km a side at 6.4 pixels per metre) is painted anew for every frame
MAP_SIDE = 32_000  # cv2 addresses the pixels of a picture it cuts from with 16 bits
CHUNK = 64  # moments whose geometry is computed together

_PLAIN, _BOUNDARY, _LINE = 1 + LIMIT_SHADES, 2 + LIMIT_SHADES, 3 + LIMIT_SHADES  # palette; 0 is beside the road
_GREEN, _RED, _OTHERS = 4 + LIMIT_SHADES, 5 + LIMIT_SHADES, 6 + LIMIT_SHADES  # others' oldest pose, then younger ones
_MASK = 240  # of a set pixel: averages of sixteen such are whole numbers

Image = NDArray[np.uint8]
Moments = NDArray[np.int64]
_Shape = tuple[Floats, int, float]  # points [P, 2] m, palette index, width of a line [m]; no width: a filled polygon


def check_rate(episode: Episode) -> None:
    """Raise BadInputError for an Episode that is not at 10 Hz, the rate of history and future (Sec. III-A)."""
    if abs(episode.rate_hz - RATE_HZ) > 0.01:
        raise BadInputError(
            f"Episode {episode.id} has {episode.rate_hz:g} steps per second; bird views need {RATE_HZ:g}: "
            "resample it with 'python -m study.data import'"
        )


def valid_moments(episode: Episode, settings: BirdviewSettings) -> Moments:
    """Return the moments (step, agent index) [M, 2] int64 that may become frames, sorted.

    The agent may be ego, is present during its history and future, and its steering and acceleration are known.
    """
    check_rate(episode)
    before, after = settings.history, settings.future
    presence = np.pad(episode.present.cumsum(axis=0, dtype=np.int64), ((1, 0), (0, 0)))
    span = before + after + 1
    good = np.zeros_like(episode.present)
    if episode.steps >= span:
        good[before : episode.steps - after] = presence[span:] - presence[:-span] == span
    good &= np.array([agent.ego for agent in episode.agents], bool)
    good &= np.isfinite(episode.steering) & np.isfinite(episode.acceleration)
    return np.argwhere(good).astype(np.int64, copy=False)


def governing_light(episode: Episode, settings: BirdviewSettings, moments: Moments) -> NDArray[np.uint8]:
    """Return the state [M] uint8 of each governing light, GREEN where there is none within `light_range`."""
    steps, agents = moments[:, 0], moments[:, 1]
    light = episode.light[steps, agents]
    near = (light >= 0) & (episode.light_distance[steps, agents] <= settings.light_range)  # an unknown distance is not
    state = np.full(len(moments), GREEN, np.uint8)
    state[near] = episode.light_state[steps[near], light[near]]
    return state


@dataclass(frozen=True)
class _Window:
    """Where the field of view lies around the ego: pixels per metre, ego's column and row in pixels."""

    scale: float
    column: float
    row: float

    def affines(self, x: Floats, y: Floats, heading: Floats) -> Floats:
        """Return the maps from the world [m] to pixel centres [M, 2, 3] for egos [M]; they look up."""
        east, north = self.scale * np.cos(heading), self.scale * np.sin(heading)
        affines = np.empty((len(x), 2, 3))
        affines[:, 0, 0], affines[:, 0, 1], affines[:, 0, 2] = north, -east, self.column - 0.5 - north * x + east * y
        affines[:, 1, 0], affines[:, 1, 1], affines[:, 1, 2] = -east, -north, self.row - 0.5 + east * x + north * y
        return affines


class Renderer:
    """Paints moments of one Episode, with the masks of `targets`, by default those of all heads.

    Raises BadInputError when the Episode is not at 10 Hz, or a target cannot be found.
    """

    def __init__(self, episode: Episode, settings: BirdviewSettings, targets: Sequence[str] | None = None) -> None:
        check_rate(episode)
        names = [head.target for head in mask_heads().values()] if targets is None else targets
        self._targets = [find_target(name) for name in names]
        self.settings = settings
        self._palette = _palette(settings.history)
        scale = settings.render / settings.view
        self._window = _Window(scale, settings.render / 2, (settings.view - settings.behind) * scale)
        self._map = _Map(episode.lanes, scale, settings.render)
        self._take(episode)
        corner = np.hypot(settings.view / 2, max(settings.behind, settings.view - settings.behind))
        self._route_ahead = np.arange(0, 1.5 * corner, ROUTE_POINTS)

    def on(self, episode: Episode) -> Renderer:
        """Return the renderer of another Episode on the same map, which is not painted again."""
        other = copy.copy(self)
        other._take(episode)  # noqa: SLF001 - its own kind
        return other

    def _take(self, episode: Episode) -> None:
        self.episode = episode
        self._sizes = painted_sizes(episode.agents, LEAST * self.settings.view / IMAGE)
        self._palette_of = np.array([list(AGENTS).index(agent.kind) for agent in episode.agents], np.int64)
        self._reach = np.hypot(*self._sizes.T).max(initial=0) / 2 + 1  # of a box from its centre, with a metre to spare
        self._routes = [
            (np.concatenate([[0.0], np.hypot(*np.diff(route, axis=0).T).cumsum()]), *route.T.astype(np.float64))
            if len(route) > 1
            else None
            for route in episode.routes
        ]

    def render(self, moments: NDArray[np.integer[Any]]) -> tuple[Image, Image]:
        """Paint moments [M, 2] of (step, agent index): images [M, 64, 64, 3] uint8 RGB, masks [M, K, 512] uint8.

        A mask of a target is set where its polygons cover at least half of a pixel: 4096 bits in row-major order,
        packed by `np.packbits`. Poses outside the recorded steps are not painted.
        Raises BadInputError when a moment's agent is not there.
        """
        moments = np.asarray(moments, np.int64).reshape(-1, 2)
        self._check(moments)
        images = np.empty((len(moments), IMAGE, IMAGE, 3), np.uint8)
        masks = np.empty((len(moments), len(self._targets), MASK_BYTES), np.uint8)
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)  # frames are too small to share; processes are what we spread them over
        try:
            for start in range(0, len(moments), CHUNK):
                part = slice(start, start + CHUNK)
                self._render(moments[part], images[part], masks[part])
        finally:
            cv2.setNumThreads(threads)
        return images, masks

    def _check(self, moments: Moments) -> None:
        steps, agents = self.episode.present.shape
        for step, agent in moments.tolist():
            if not (0 <= step < steps and 0 <= agent < agents and self.episode.present[step, agent]):
                raise BadInputError(
                    f"Episode {self.episode.id}: no agent with index {agent} at step {step}; "
                    f"it has {agents} agents and {steps} steps"
                )

    def _render(self, moments: Moments, images: Image, masks: Image) -> None:
        episode, size = self.episode, self.settings.render
        now = (moments[:, 0], moments[:, 1])
        x, y, heading = (values[now].astype(np.float64) for values in (episode.x, episode.y, episode.heading))
        affines = self._window.affines(x, y, heading)
        cuts = self._map.cuts(affines)
        boxes, colours, ends = self._boxes(moments, affines, heading)
        states = governing_light(episode, self.settings, moments).tolist()
        canvas, flat = np.empty((size, size), np.uint8), np.empty((size, size), np.uint8)
        grey = np.zeros((*masks.shape[:2], IMAGE, IMAGE), np.uint8)
        start = 0
        for index, (seen, pred, plan) in enumerate(ends):
            self._map.paint(canvas, affines[index], cuts[index])
            self._paint_route(canvas, affines[index], moments[index], states[index])
            for box, colour in zip(boxes[start:seen], colours[start:seen], strict=True):
                cv2.fillConvexPoly(canvas, box, colour, cv2.LINE_8, FRACTION_BITS)
            channels = [_shrink(cv2.LUT(canvas, channel, dst=flat)) for channel in self._palette]
            cv2.merge(channels, dst=images[index])
            step, agent = moments[index].tolist()
            boxes_ahead = boxes[seen:pred], boxes[pred:plan]
            moment = Moment(episode, step, agent, self.settings, affines[index], *boxes_ahead)
            for mask, target in enumerate(self._targets):
                polygons = target(moment)
                if polygons:
                    flat.fill(0)
                    for polygon in polygons:
                        cv2.fillConvexPoly(flat, polygon, _MASK, cv2.LINE_8, FRACTION_BITS)
                    grey[index, mask] = _shrink(flat)
            start = plan
        if self._targets:
            masks[:] = np.packbits((grey >= _MASK // 2).reshape(*masks.shape[:2], IMAGE * IMAGE), axis=2)

    def _boxes(
        self, moments: Moments, affines: Floats, heading: Floats
    ) -> tuple[list[NDArray[np.int32]], list[int], list[list[int]]]:
        """Return boxes in paint order, frame by frame, their palette indices, and the ends of each frame's three parts.

        The parts are past and present poses, the others' next poses, the ego's next poses.
        """
        episode, history, size = self.episode, self.settings.history, self.settings.render
        scale = self._window.scale
        offsets = np.arange(-history, self.settings.future + 1 if self._targets else 1)  # an image shows no future
        steps = moments[:, :1] + offsets
        inside = (steps >= 0) & (steps < episode.steps)
        steps = np.minimum(np.maximum(steps, 0), episode.steps - 1)  # `clip` takes far longer for so few
        # Cull around the centre of the view in float32: cheap, and a metre of margin covers its rounding.
        centre = np.array([size / 2, size / 2]) - affines[:, :, 2]
        middle = (np.einsum("mij,mi->mj", affines[:, :, :2], centre) / scale**2).astype(np.float32)
        east = episode.x[steps] - middle[:, 0, None, None]
        north = episode.y[steps] - middle[:, 1, None, None]
        near = east * east + north * north < np.float32(self.settings.view / 2**0.5 + self._reach) ** 2  # NaN: far
        near &= episode.present[steps] & inside[..., None]
        place = near.ravel().nonzero()[0]  # much faster than `nonzero` of the table
        row, agent = np.divmod(place, near.shape[2])
        frame, pose = np.divmod(row, near.shape[1])
        step = steps[frame, pose]

        at = np.ones((len(step), 3))
        at[:, 0], at[:, 1] = episode.x[step, agent], episode.y[step, agent]
        column, row = np.einsum("kij,kj->ik", affines[frame], at)
        margin = self._reach * scale
        seen = (column > -margin) & (column < size + margin) & (row > -margin) & (row < size + margin)
        frame, pose, agent, step, column, row = (v[seen] for v in (frame, pose, agent, step, column, row))

        turn = episode.heading[step, agent] - heading[frame]
        # cv2 fills a pixel whose centre lies up to half a pixel outside: boxes are made that much smaller.
        half = self._sizes[agent] * (scale / 2) - 0.5
        sine, cosine, corners = np.sin(turn), np.cos(turn), np.empty((len(turn), 4, 2))
        for axis, middle, along, across in ((0, column, -sine, -cosine), (1, row, -cosine, sine)):
            ahead, aside = along * half[:, 0], across * half[:, 1]
            front, back = ahead + aside, ahead - aside
            for corner, shift in enumerate((front, back, -front, -back)):
                corners[:, corner, axis] = middle + shift
        fixed = np.rint(corners * (1 << FRACTION_BITS)).astype(np.int32)

        # A pose that stands where the next younger one stands is painted over by it: leave it out.
        number = np.full((len(moments), len(offsets) + 1, near.shape[2]), -1)
        number[frame, pose, agent] = np.arange(len(frame))
        younger = number[frame, pose + 1, agent]
        hidden = (younger >= 0) & (pose != history) & (fixed == fixed[younger]).reshape(-1, 8).all(axis=1)
        is_ego = agent == moments[frame, 1]
        layer = np.where(pose <= history, 0, 2) + is_ego  # others' past, ego's past, pred, plan
        order = np.lexsort((pose, layer, frame))
        order = order[~hidden[order]]
        colour = _OTHERS + pose + np.where(is_ego, list(AGENTS).index("ego"), self._palette_of[agent]) * (history + 1)
        part = (frame * 3 + np.maximum(layer - 1, 0))[order]
        ends = np.searchsorted(part, np.arange(len(moments) * 3), side="right").reshape(-1, 3)
        return list(fixed[order]), colour[order].tolist(), ends.tolist()

    def _paint_route(self, canvas: Image, affine: Floats, moment: Moments, light: int) -> None:
        route, progress = self._routes[moment[1]], self.episode.route_s[moment[0], moment[1]]
        if route is None or not np.isfinite(progress):
            return
        length, x, y = route
        along = progress + self._route_ahead
        along = along[: np.searchsorted(along, length[-1]) + 1]
        way = np.stack([np.interp(along, length, x), np.interp(along, length, y)], axis=1)
        width = max(1, round(ROUTE_WIDTH * self._window.scale))
        colour = _GREEN if light == GREEN else _RED  # yellow counts as red
        cv2.polylines(canvas, [fixed_point(way, affine)], False, colour, width, cv2.LINE_8, FRACTION_BITS)  # noqa: FBT003


def _palette(history: int) -> Image:
    """Return the colours [3, 256] RGB by palette index. Past poses fade to black, linear in their age."""
    if _OTHERS + len(AGENTS) * (history + 1) > 256:
        raise BadInputError(f"birdview.history: at most {(256 - _OTHERS) // len(AGENTS) - 1} past poses, got {history}")
    colours = np.zeros((256, 3), np.uint8)
    first, step = SURFACE
    colours[1 : 1 + LIMIT_SHADES] = (first + step * np.arange(LIMIT_SHADES))[:, None]
    colours[[_PLAIN, _BOUNDARY, _LINE]] = np.array([[PLAIN_SURFACE], [BOUNDARY], [LINE]])
    colours[_GREEN], colours[_RED] = (0, 255, 0), (255, 0, 0)
    light = np.arange(1, history + 2)[:, None] / (history + 1)
    poses = np.rint(np.concatenate([np.array(colour) * light for colour in AGENTS.values()]))
    colours[_OTHERS : _OTHERS + len(poses)] = poses
    return np.ascontiguousarray(colours.T)


def _shrink(picture: Image) -> Image:
    """Return the area average [64, 64] of a square picture; to halve twice is four times faster than one step."""
    while picture.shape[0] % (2 * IMAGE) == 0:
        side = picture.shape[0] // 2
        picture = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
    if picture.shape[0] != IMAGE:
        picture = cv2.resize(picture, (IMAGE, IMAGE), interpolation=cv2.INTER_AREA)
    return picture


class _Map:
    """The painted map of an Episode: one large picture where it fits into memory, else painted window by window."""

    def __init__(self, lanes: Sequence[Lane], scale: float, window: int) -> None:
        self._scale, self._reach = scale, window / scale / 2**0.5 + BOUNDARY_WIDTH
        self._shapes = _shapes(lanes)
        self._picture: Image | None = None
        self._origin = np.zeros(2)
        if not self._shapes:
            return
        points = np.concatenate([shape for shape, _, _ in self._shapes])
        starts = np.cumsum([0] + [len(shape) for shape, _, _ in self._shapes[:-1]])
        self._low, self._high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
        self._origin = self._low.min(axis=0) - 1
        columns, rows = np.ceil((self._high.max(axis=0) + 1 - self._origin) * scale).astype(int).tolist()
        if max(columns, rows) <= MAP_SIDE and columns * rows <= MAP_BYTES:
            self._picture = np.zeros((rows, columns), np.uint8)
            affine = np.column_stack([np.eye(2) * scale, -self._origin * scale - 0.5])
            _paint(self._picture, self._shapes, affine, scale)

    def cuts(self, affines: Floats) -> Floats:
        """Return the maps from the window to the large picture [M, 2, 3], in pixels, of the maps from the world [m]."""
        back = affines[:, :, :2].transpose(0, 2, 1) / self._scale  # a turn times scale: its inverse, times scale
        shift = -back @ affines[:, :, 2:] - (self._origin * self._scale + 0.5)[:, None]
        return np.concatenate([back, shift], axis=2)

    def paint(self, canvas: Image, affine: Floats, cut: Floats) -> None:
        """Overwrite the canvas with the map as it lies under `affine`, world [m] -> pixels; `cut` is its `cuts`."""
        if self._picture is not None:
            flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            cv2.warpAffine(self._picture, cut, canvas.shape, dst=canvas, flags=flags)
            return
        canvas.fill(0)
        if self._shapes:
            centre = np.linalg.solve(affine[:, :2], np.array(canvas.shape) / 2 - affine[:, 2])
            near = ((self._low < centre + self._reach) & (self._high > centre - self._reach)).all(axis=1)
            _paint(canvas, [self._shapes[number] for number in np.flatnonzero(near)], affine, self._scale)


def _shapes(lanes: Sequence[Lane]) -> list[_Shape]:
    """Return the shapes of the lanes in paint order: surfaces, boundaries, lane lines."""
    if not lanes:
        return []
    centre = np.concatenate([lane.centre for lane in lanes])
    lane_of = np.repeat(np.arange(len(lanes)), [len(lane.centre) for lane in lanes])
    new = np.diff(lane_of, prepend=-1) > 0
    distinct = new | (np.diff(centre, axis=0, prepend=np.nan) != 0).any(axis=1)  # a point twice has no direction
    centre, lane_of = centre[distinct], lane_of[distinct]
    starts = np.searchsorted(lane_of, np.arange(len(lanes) + 1))
    here = np.arange(len(centre))
    after, before = np.minimum(here + 1, starts[lane_of + 1] - 1), np.maximum(here - 1, starts[lane_of])
    tangent = centre[after] - centre[before]
    tangent /= np.hypot(*tangent.T)[:, None].clip(1e-9)
    half = np.array([lane.width / 2 for lane in lanes])[lane_of, None]
    left = centre + half * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    right = 2 * centre - left

    plain = len({lane.speed_limit for lane in lanes}) < 2
    shades = [_PLAIN if plain or lane.speed_limit is None else _shade(lane.speed_limit) for lane in lanes]
    joined = np.flatnonzero(after > here)
    quads = np.stack([left[joined], left[joined + 1], right[joined + 1], right[joined]], axis=1)
    surfaces = [(quad, shades[lane], 0) for quad, lane in zip(quads, lane_of[joined].tolist(), strict=True)]
    boundaries: list[_Shape] = []
    lines: list[_Shape] = []
    for number, lane in enumerate(lanes):
        for edge, border in ((left, lane.left), (right, lane.right)):
            side = edge[starts[number] : starts[number + 1]]
            if border == "curb":
                boundaries.append((side, _BOUNDARY, BOUNDARY_WIDTH))
            elif border == "solid":
                lines.append((side, _LINE, LINE_WIDTH))
            elif border == "dashed":
                lines.extend((dash, _LINE, LINE_WIDTH) for dash in _dashes(side))
    return surfaces + boundaries + lines


def _shade(limit: float) -> int:
    return 1 + min(round(limit / LIMIT_STEP), LIMIT_SHADES - 1)


def _dashes(line: Floats) -> list[Floats]:
    length = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    starts = np.arange(0, length[-1], 2 * DASH)
    along = (starts[:, None] + np.linspace(0, DASH, 4)).clip(max=length[-1])
    return list(np.stack([np.interp(along, length, line[:, 0]), np.interp(along, length, line[:, 1])], axis=2))


def _paint(canvas: Image, shapes: Sequence[_Shape], affine: Floats, scale: float) -> None:
    points = fixed_point(np.concatenate([shape for shape, _, _ in shapes] or [np.empty((0, 2))]), affine)
    end = 0
    for shape, colour, metres in shapes:
        start, end = end, end + len(shape)
        if metres:
            width = max(1, round(metres * scale))
            cv2.polylines(canvas, [points[start:end]], False, colour, width, cv2.LINE_8, FRACTION_BITS)  # noqa: FBT003
        else:
            cv2.fillConvexPoly(canvas, points[start:end], colour, cv2.LINE_8, FRACTION_BITS)
