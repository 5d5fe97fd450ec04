"""The drawn town: its streets, junctions, right of way and lights."""

import itertools

import numpy as np
import pytest

from study.config.settings import TownSettings
from study.episode.schema import GREEN, RED, YELLOW
from study.errors import BadInputError
from study.sim.geometry import LANE_WIDTH
from study.sim.lights import plan_lights
from study.sim.town import Town, draw_town, highway_lane

SEEDS = range(12)


def town_of(seed: int, **settings: object) -> Town:
    return draw_town(TownSettings(**settings), np.random.default_rng(seed))


def arms(town: Town, node: int) -> set[int]:
    return {movement.arm for movement in town.movements if movement.node == node}


@pytest.mark.parametrize("seed", SEEDS)
def test_a_default_town_has_sixteen_junctions_four_way_and_t_bends_and_both_kinds_of_street(seed: int) -> None:
    town = town_of(seed)
    assert len(np.flatnonzero(town.phases)) >= 16
    assert {len(arms(town, node)) for node in np.flatnonzero(town.phases)} == {3, 4}
    assert any(strip.piece.curvature and not strip.junction for strip in town.strips)
    lanes = {}
    for entry in town.ways:
        start, end, lane = town.strips[entry].index
        lanes[start, end] = max(lanes.get((start, end), 0), lane + 1)
    assert set(lanes.values()) == {1, 2}


@pytest.mark.parametrize("seed", SEEDS)
def test_every_lane_leads_to_every_other(seed: int) -> None:
    town = town_of(seed)
    exits = {entry: {town.movements[way].exit for way in ways} for entry, ways in town.ways.items()}
    for start in list(exits)[::7]:
        reached, todo = {start}, [start]
        while todo:
            for lane in exits[todo.pop()] - reached:
                reached.add(lane)
                todo.append(lane)
        assert reached == set(exits)


def test_streets_are_dropped_as_asked() -> None:
    full, fewer = town_of(0, dropped_edges=0, two_lane_share=0), town_of(0, dropped_edges=3, two_lane_share=0)
    assert len(full.ways) - len(fewer.ways) == 2 * 3


@pytest.mark.parametrize("seed", SEEDS)
def test_movements_join_their_streets_without_a_gap_or_a_kink(seed: int) -> None:
    town = town_of(seed)
    for movement in town.movements:
        chain = [town.strips[k].piece for k in (movement.entry, *movement.strips, movement.exit)]
        for one, other in itertools.pairwise(chain):
            x, y, heading = one.end()
            assert np.hypot(x - other.x, y - other.y) < 1e-6
            assert abs((heading - other.heading + np.pi) % (2 * np.pi) - np.pi) < 1e-6


def test_pieces_are_the_same_lines_as_highway_envs_lanes() -> None:
    for strip in town_of(1).strips:
        lane, s = highway_lane(strip), np.array([0.3, strip.piece.length / 2, strip.piece.length])
        assert lane.length == pytest.approx(strip.piece.length)
        for x, y, heading, along in zip(*strip.piece.at(s), s, strict=True):
            assert lane.position(along, 0) == pytest.approx([x, y])
            assert lane.local_coordinates(np.array([x, y])) == pytest.approx((along, 0), abs=1e-6)
            assert (lane.heading_at(along) - heading + np.pi) % (2 * np.pi) == pytest.approx(np.pi)


@pytest.mark.parametrize("seed", SEEDS)
def test_right_of_way_knows_left_turns_across_and_streets_from_the_side(seed: int) -> None:
    town = town_of(seed)
    meet = ~np.isnan(town.enter)
    assert (meet == meet.T).all()
    left = np.array([movement.turn == "left" for movement in town.movements])
    straight = np.array([movement.turn == "straight" for movement in town.movements])
    assert (meet & town.opposing & left[:, None] & straight[None]).any()
    # what may be green together and is no left turn needs no rule: such ways never meet, nor do opposing left turns
    assert not (meet & town.opposing & (left[:, None] == left[None])).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_lanes_of_one_approach_never_merge_inside_a_junction(seed: int) -> None:
    town = town_of(seed)
    for exit_ in {movement.exit for movement in town.movements}:
        into = [(m.node, m.arm, m.entry) for m in town.movements if m.exit == exit_]
        assert len({(node, arm) for node, arm, _ in into}) == len({entry for _, _, entry in into})


def test_two_way_streets_keep_right() -> None:
    town = town_of(2)
    by_index = {strip.index: strip.piece for strip in town.strips}
    for (start, end, lane), piece in by_index.items():
        back = by_index.get((end.replace("<", ">"), start.replace(">", "<"), lane))
        if back is None or "." in start + end or lane:
            continue
        x, y, _heading = back.end()
        side = -(x - piece.x) * np.sin(piece.heading) + (y - piece.y) * np.cos(piece.heading)
        assert side == pytest.approx(-LANE_WIDTH)  # the way back lies to the left


def test_road_limits_are_drawn_for_streets() -> None:
    limits = {round(strip.limit * 3.6, 6) for strip in town_of(0, road_limits=(25.0, 45.0)).strips}
    assert limits == {25.0, 45.0}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"dropped_edges": 30}, "dropped_edges"),
        ({"block": (20.0, 84.0)}, "block"),
        ({"speed_limit": 90.0}, "speed_limit"),
        ({"rows": 2, "columns": 2, "dropped_edges": 1}, "larger grid"),
    ],
)
def test_towns_that_cannot_be_built_are_refused_with_the_way_out(settings: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        town_of(0, **settings)


# --- lights ---------------------------------------------------------------------------------------------------------


def test_every_light_goes_green_yellow_red_for_its_times() -> None:
    town, settings = town_of(3), TownSettings()
    plan = plan_lights(town, settings, np.random.default_rng(0))
    steps = round(4 * (settings.green + settings.yellow + settings.all_red) / 0.1)
    states = np.array([plan.states(k * 0.1) for k in range(2 * steps)])
    for light in states.T:
        changes = np.flatnonzero(np.diff(light))
        runs = np.diff(changes)
        after = light[changes[:-1] + 1]
        assert [(a, b) for a, b in itertools.pairwise(after) if (a + 1) % 3 != b] == []
        assert set(runs[after == GREEN]) == {round(settings.green / 0.1)}
        assert set(runs[after == YELLOW]) == {round(settings.yellow / 0.1)}


def test_crossing_streets_are_never_open_together_and_all_red_lies_between() -> None:
    town, settings = town_of(4), TownSettings()
    plan = plan_lights(town, settings, np.random.default_rng(1))
    states = np.array([plan.states(k * 0.1) for k in range(500)])
    all_red = round(settings.all_red / 0.1)
    for node in np.flatnonzero(town.phases):
        own = [k for k, signal in enumerate(town.signals) if signal.node == node]
        phase = np.array([town.signals[k].phase for k in own])
        one, other = states[:, np.array(own)[phase == 0]] != RED, states[:, np.array(own)[phase == 1]] != RED
        one, other = one.any(axis=1), other.any(axis=1)
        assert one.any()
        assert other.any()
        for shift in range(all_red + 1):
            assert not (one[: len(one) - shift] & other[shift:]).any()
            assert not (other[: len(one) - shift] & one[shift:]).any()
