"""Bird view: what lies where in the picture, in which colour, and what the masks cover."""

import dataclasses
import hashlib

import numpy as np
import pytest

from study.birdview import renderer as birdview
from study.birdview.renderer import Renderer, governing_light, valid_moments
from study.config.keys import FORMAT_VERSIONS
from study.config.settings import BirdviewSettings
from study.episode.checks import check_episode
from study.episode.schema import GREEN, RED, YELLOW, Agent, Episode, Lane, Light, empty_states
from study.errors import BadInputError
from tests.support.drives import bird_view, crossing_drive

SETTINGS = BirdviewSettings()
NOW = 10  # a step with a whole history and future


def drive(tracks, sizes=(4.8, 2.0), routes=None, lanes=(), light=None):
    """Return an Episode of 21 steps from tracks: each agent has (x, y, heading) at step 10 and a way per step [m]."""
    states = empty_states(21, len(tracks))
    for agent, (x, y, heading, pace) in enumerate(tracks):
        way = pace * (np.arange(21) - NOW)
        values = {"x": x + way * np.cos(heading), "y": y + way * np.sin(heading), "heading": heading}
        values |= {"speed": 10 * pace, "steering": 0.0, "acceleration": 1.0, "route_s": 30 + way, "present": True}
        for name, value in values.items():
            states[name][:, agent] = value
    light_state = np.zeros((21, 0), np.uint8)
    lights = ()
    if light is not None:
        state, distance = light
        states["light"][:, 0], states["light_distance"][:, 0] = 0, distance
        lights = (Light(7, np.array([[0.0, 0.0], [1.0, 0.0]])),)
        light_state = np.full((21, 1), state, np.uint8)
    episode = Episode(
        id="test",
        source={},
        rate_hz=10.0,
        labels="recorded",
        agents=tuple(Agent(10 + agent, *sizes) for agent in range(len(tracks))),
        lanes=lanes,
        lights=lights,
        light_state=light_state,
        routes=tuple(routes or [np.empty((0, 2), np.float32)] * len(tracks)),
        **states,
    )
    check_episode(episode, "test")
    return episode


def from_ego(heading, ahead, left, ego=(5.0, -3.0)):
    """Return the world position of a point seen from the ego."""
    forward = np.array([np.cos(heading), np.sin(heading)])
    return np.array(ego) + ahead * forward + left * np.array([-forward[1], forward[0]])


def pixel(ahead, left):
    """Return row and column of the pixel of a point seen from the ego (Sec. III-A: 40 m, 15 m behind the ego)."""
    return int((25 - ahead) * 1.6), int((20 - left) * 1.6)


def straight_route(heading, start=-30.0, end=60.0):
    return np.array([from_ego(heading, along, 0) for along in np.arange(start, end, 3.0)], np.float32)


def covered(episode, step, agent, poses, others):
    """Return which pixels [256, 256] have their centre in a box at one of the steps, seen from the agent at `step`."""
    rows, columns = np.mgrid[:256, :256]
    ahead, left = 25 - (rows + 0.5) / 6.4, 20 - (columns + 0.5) / 6.4
    at = episode.heading[step, agent].astype(float)
    x = episode.x[step, agent] + ahead * np.cos(at) - left * np.sin(at)
    y = episode.y[step, agent] + ahead * np.sin(at) + left * np.cos(at)
    union = np.zeros((256, 256), bool)
    for pose in poses:
        for other in others:
            heading = episode.heading[pose, other].astype(float)
            east, north = x - episode.x[pose, other], y - episode.y[pose, other]
            along = east * np.cos(heading) + north * np.sin(heading)
            across = north * np.cos(heading) - east * np.sin(heading)
            size = episode.agents[other]
            union |= (np.abs(along) <= size.length / 2) & (np.abs(across) <= size.width / 2)
    return union


def average(picture):
    return picture.reshape(64, 4, 64, 4, -1).mean(axis=(1, 3)).squeeze()


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.0, -2.9])
@pytest.mark.parametrize(("ahead", "left"), [(15.0, 8.0), (15.0, -8.0), (-10.0, 12.0), (20.0, 0.0)])
def test_another_car_is_yellow_where_the_ego_sees_it(heading, ahead, left):
    """Whatever way the ego heads, ahead is up and left is left."""
    x, y = from_ego(heading, ahead, left)
    image, _, _ = bird_view(drive([(5, -3, heading, 0.0), (x, y, heading, 0.0)]), NOW, 0, SETTINGS)
    assert tuple(image[pixel(ahead, left)]) == (255, 255, 0)
    assert tuple(image[pixel(0, 0)]) == (0, 0, 255)
    image[
        pixel(ahead, left)[0] - 5 : pixel(ahead, left)[0] + 6, pixel(ahead, left)[1] - 2 : pixel(ahead, left)[1] + 3
    ] = 0
    image[35:46, 30:35] = 0
    assert not image.any()


def test_a_left_turn_looks_like_a_left_turn():
    """The real ways of the crossing: plan goes left for cars that turn left, right for those that turn right."""
    sides = set()
    for seed in range(6):
        episode = crossing_drive(seed)
        turned = np.zeros_like(episode.heading)
        turned[:-10] = episode.heading[10:] - episode.heading[:-10]
        for step, agent in valid_moments(episode, SETTINGS):
            if abs(turned[step, agent]) > 0.5:
                _, _, plan = bird_view(episode, step, agent, SETTINGS)
                far = np.flatnonzero(plan.any(axis=1))[0]
                side = np.flatnonzero(plan[far]).mean() - 31.5
                assert np.sign(side) == -np.sign(turned[step, agent])
                sides.add(np.sign(side))
                break
    assert sides == {-1, 1}


@pytest.mark.parametrize(("who", "colour"), [(0, [0, 0, 1]), (1, [1, 1, 0])])
def test_past_poses_fade_linearly_to_black(who, colour):
    """Poses that do not touch show each pose's light: full now, less by one step for each tenth of a second."""
    pace = 1.25  # two pixels per step
    tracks = [(0, 0, 0.0, pace), (0, 8, 0.0, pace)]
    image, _, _ = bird_view(drive(tracks, sizes=(1.25, 2.0)), NOW, 0, SETTINGS)
    column = pixel(0, 8 * who)[1]
    light = [image[pixel(-pace * age, 0)[0], column] for age in range(11)]
    expected = np.outer(255 * (11 - np.arange(11)) / 11, colour)
    np.testing.assert_allclose(light, expected, atol=1.5)


def on_foot(episode, kind, size=0.5):
    agents = (episode.agents[0], *(Agent(item.id, size, size, kind=kind) for item in episode.agents[1:]))
    return dataclasses.replace(episode, agents=agents)


@pytest.mark.parametrize(("kind", "shade"), [("cyclist", (128, 255, 0)), ("pedestrian", (255, 128, 0))])
def test_cyclists_and_pedestrians_have_shades_of_their_own(kind, shade):
    episode = on_foot(drive([(0, 0, 0.0, 0.0), (10, 5, 0.0, 0.0)]), kind, size=2.0)
    image, pred, _ = bird_view(episode, NOW, 0, SETTINGS)
    assert tuple(image[pixel(10, 5)]) == shade
    assert pred[pixel(10, 5)]
    assert tuple(image[pixel(0, 0)]) == (0, 0, 255)
    assert bird_view(dataclasses.replace(episode, agents=episode.agents[::-1]), NOW, 1, SETTINGS)[0].any()


def test_a_pedestrian_of_half_a_metre_is_seen_and_predicted_wherever_it_stands():
    """It is painted a metre long and wide: a square of 1.6 pixels covers more than half of some pixel."""
    rng = np.random.default_rng(0)
    tracks = [(0, 0, 0.0, 0.0)]
    for ahead, left, heading in rng.uniform((4, -15, -3), (20, 15, 3), (40, 3)):
        episode = on_foot(drive([*tracks, (ahead, left, heading, 0.0)]), "pedestrian")
        image, pred, _ = bird_view(episode, NOW, 0, SETTINGS)
        assert pred.sum() in (1, 2, 3, 4)
        assert image[..., 0].max() > 127
        without, _, _ = bird_view(drive(tracks), NOW, 0, SETTINGS)
        assert np.abs(image.astype(int) - without).sum() / (255 * 1.5) == pytest.approx(1.6**2, rel=0.25)


def test_the_present_pose_lies_on_top_of_older_ones():
    """A car that backs up covers where it was a moment ago with its full colour."""
    image, _, _ = bird_view(drive([(0, 0, 0.0, 0.0), (10, 0, 0.0, -0.2)]), NOW, 0, SETTINGS)
    assert tuple(image[pixel(10, 0)]) == (255, 255, 0)
    assert 0 < image[pixel(13.0, 0)][0] < 255


@pytest.mark.parametrize(
    ("light", "colour"),
    [
        (None, (0, 255, 0)),
        ((GREEN, 10.0), (0, 255, 0)),
        ((YELLOW, 10.0), (255, 0, 0)),
        ((RED, 26.9), (255, 0, 0)),
        ((RED, 27.1), (0, 255, 0)),
        ((RED, np.nan), (0, 255, 0)),
    ],
)
def test_the_route_has_the_colour_of_the_light_that_governs_it(light, colour):
    """Red for yellow and red within range, else green; only ahead of the ego."""
    heading = 0.4
    episode = drive([(5, -3, heading, 0.0)], routes=[straight_route(heading)], light=light)
    image, _, _ = bird_view(episode, NOW, 0, SETTINGS)
    assert tuple(image[pixel(15, 0)]) == colour
    assert tuple(image[pixel(24, 0)]) == colour
    assert tuple(image[pixel(15, 3)]) == (0, 0, 0)
    assert tuple(image[pixel(-8, 0)]) == (0, 0, 0)


def test_no_route_is_drawn_where_none_is_known():
    route = straight_route(0.0)
    unknown = drive([(5, -3, 0.0, 0.0)], routes=[route])
    unknown.route_s[:] = np.nan
    for episode in (drive([(5, -3, 0.0, 0.0)]), unknown):
        image, _, _ = bird_view(episode, NOW, 0, SETTINGS)
        assert not image[..., :2].any()


def test_the_route_lies_under_the_cars():
    episode = drive([(5, -3, 0.0, 0.0), (17, -3, 0.0, 0.0)], routes=[straight_route(0.0), np.empty((0, 2), np.float32)])
    image, _, _ = bird_view(episode, NOW, 0, SETTINGS)
    assert tuple(image[pixel(12, 0)]) == (255, 255, 0)
    assert tuple(image[pixel(6, 0)]) == (0, 255, 0)


def test_masks_are_the_boxes_at_the_next_ten_poses():
    """Against boxes tested pixel by pixel; only pixels about half covered may fall the other way."""
    episode = crossing_drive(4)
    for step, agent in valid_moments(episode, SETTINGS)[::97]:
        _, pred, plan = bird_view(episode, step, agent, SETTINGS)
        others = [other for other in range(len(episode.agents)) if other != agent]
        for mask, who in ((pred, others), (plan, [agent])):
            share = average(covered(episode, step, agent, range(step + 1, step + 11), who))
            clear = np.abs(share - 0.5) > 0.2
            np.testing.assert_array_equal(mask[clear], (share >= 0.5)[clear])
            assert abs(int(mask.sum()) - int((share >= 0.5).sum())) <= 0.1 * mask.sum() + 4


def test_cars_are_painted_oldest_first_and_the_ego_last():
    """Against a painter without short cuts, pixel by pixel, where no map and no route is in the way."""
    full = crossing_drive(2)
    episode = dataclasses.replace(full, lanes=(), routes=(np.empty((0, 2), np.float32),) * len(full.agents))
    for step, agent in valid_moments(episode, SETTINGS)[::83]:
        expected = np.zeros((256, 256, 3))
        others = [other for other in range(len(episode.agents)) if other != agent]
        for who, colour in ((others, (1, 1, 0)), ([agent], (0, 0, 1))):
            for age in range(10, -1, -1):
                there = covered(episode, step, agent, [step - age], who)
                expected[there] = np.multiply(colour, 255 * (11 - age) / 11)
        image, _, _ = bird_view(episode, step, agent, SETTINGS)
        difference = np.abs(image - average(expected))
        assert difference.mean() < 0.5
        assert (difference > 64).mean() < 1e-3


def test_neither_mask_holds_the_others_cars():
    """The ego is not in pred, the others are not in plan."""
    alone = bird_view(drive([(0, 0, 0.0, 1.0)]), NOW, 0, SETTINGS)
    two = bird_view(drive([(0, 0, 0.0, 1.0), (10, 5, 0.0, 1.0)]), NOW, 0, SETTINGS)
    assert not alone[1].any()
    assert two[1].any()
    np.testing.assert_array_equal(alone[2], two[2])


def test_a_car_that_leaves_is_painted_as_long_as_it_was_there():
    episode = drive([(0, 0, 0.0, 0.0), (10, 5, 0.0, 0.0)])
    episode.present[NOW:, 1] = False
    image, pred, _ = bird_view(episode, NOW, 0, SETTINGS)
    assert not pred.any()
    assert tuple(image[pixel(10, 5)]) == (232, 232, 0)  # its pose of a tenth of a second ago


def test_moments_at_the_edge_of_a_drive_show_what_is_recorded():
    """Live driving has no future: its masks are empty and its picture is the same as with one."""
    episode = drive([(0, 0, 0.0, 0.5), (10, 5, 0.0, 0.5)])
    arrays = [item.name for item in dataclasses.fields(episode) if isinstance(getattr(episode, item.name), np.ndarray)]
    cut = dataclasses.replace(episode, **{name: getattr(episode, name)[: NOW + 1] for name in arrays})
    image, pred, plan = bird_view(cut, NOW, 0, SETTINGS)
    np.testing.assert_array_equal(image, bird_view(episode, NOW, 0, SETTINGS)[0])
    assert not pred.any()
    assert not plan.any()


def test_the_map_cut_from_one_picture_is_the_map_painted_in_place(monkeypatch):
    """The short cut of painting the map once moves edges by less than a painted pixel."""
    episode = crossing_drive(1)
    moments = valid_moments(episode, SETTINGS)[::29]
    cut, masks = Renderer(episode, SETTINGS).render(moments)
    monkeypatch.setattr(birdview, "MAP_BYTES", 0)
    painted, same_masks = Renderer(episode, SETTINGS).render(moments)
    difference = np.abs(cut.astype(int) - painted)
    assert 0 < difference.mean() < 2
    assert (difference > 64).mean() < 2e-3
    np.testing.assert_array_equal(masks, same_masks)


def test_road_and_borders_lie_where_the_map_says():
    """A road along x, ego heading east: surface beside it, curb on its right, line on its left, nothing beyond."""
    road = Lane(1, np.array([[-60.0, 0.0], [60.0, 0.0]]), 8.0, left="solid", right="curb")
    image, _, _ = bird_view(drive([(0, 0, 0.0, 0.0)], lanes=(road,)), NOW, 0, SETTINGS)
    row = image[10].astype(int)
    assert len(np.unique(image[10] - image[10, :, :1])) == 1  # grey
    surface, left, right = row[32, 0], row[pixel(0, 4)[1] - 1 : pixel(0, 4)[1] + 2, 0], row[37:40, 0]
    assert surface == row[30, 0] == row[34, 0] > 0
    assert left.max() > surface
    assert right.max() > surface
    assert not row[:24].any()
    assert not row[41:].any()


def test_a_dashed_line_has_gaps_and_a_border_of_none_is_not_drawn():
    def edge(border):
        road = Lane(1, np.array([[-60.0, 0.0], [60.0, 0.0]]), 8.0, left=border)
        image, _, _ = bird_view(drive([(0, 0, 0.0, 0.0)], lanes=(road,)), NOW, 0, SETTINGS)
        return image[:, 24:27, 0].astype(int).max(axis=1) > 100

    assert edge("solid").all()
    assert not edge("none").any()
    assert 0.25 < edge("dashed").mean() < 0.75


def test_speed_limits_show_in_the_surface_only_where_they_differ():
    def greys(limits):
        lanes = tuple(
            Lane(number, np.array([[-60.0, 6.0 * number], [60.0, 6.0 * number]]), 5.0, speed_limit=limit)
            for number, limit in enumerate(limits)
        )
        image, _, _ = bird_view(drive([(0, 3, 0.0, 0.0)], lanes=lanes), NOW, 0, SETTINGS)
        return [int(image[(5, pixel(0, 6 * number - 3)[1], 0)]) for number in range(len(limits))]

    slow, fast = greys([25 / 3.6, 50 / 3.6])
    assert 0 < slow < fast
    assert greys([11.0, 11.0]) == greys([None, None])
    assert len(set(greys([11.0, 11.0]))) == 1


def test_pixels_are_area_averages():
    """Halving twice rounds twice: at most one step of 255 away from the exact mean."""
    picture = np.random.default_rng(0).integers(0, 256, (256, 256), np.uint8)
    assert np.abs(birdview._shrink(picture) - average(picture)).max() <= 1
    odd = birdview._shrink(picture[:192, :192])
    assert np.abs(odd - picture[:192, :192].reshape(64, 3, 64, 3).mean(axis=(1, 3))).max() <= 1


def test_frames_do_not_depend_on_their_company():
    """The same moment gives the same bytes alone, in another order, and beyond the size of a batch."""
    episode = crossing_drive(0)
    moments = valid_moments(episode, SETTINGS)[:150]
    images, masks = Renderer(episode, SETTINGS).render(moments)
    order = np.random.default_rng(0).permutation(len(moments))
    shuffled = Renderer(episode, SETTINGS).render(moments[order])
    np.testing.assert_array_equal(images[order], shuffled[0])
    np.testing.assert_array_equal(masks[order], shuffled[1])
    image, pred, plan = bird_view(episode, *moments[99], SETTINGS)
    np.testing.assert_array_equal(image, images[99])
    np.testing.assert_array_equal(np.packbits([pred, plan], axis=None), masks[99].ravel())


def test_valid_moments_have_history_future_and_commands():
    """Against the definition, moment by moment."""
    episode = crossing_drive(0, cars=5, steps=50)
    episode.present[20, 1] = False
    episode.steering[15:17, 2] = np.nan
    episode.acceleration[30, 3] = np.nan
    agents = (*episode.agents[:4], dataclasses.replace(episode.agents[4], ego=False))
    episode = dataclasses.replace(episode, agents=agents)
    expected = [
        (step, agent)
        for step in range(10, 40)
        for agent in range(4)
        if episode.present[step - 10 : step + 11, agent].all()
        and np.isfinite(episode.steering[step, agent] + episode.acceleration[step, agent])
    ]
    np.testing.assert_array_equal(valid_moments(episode, SETTINGS), expected)
    assert len(valid_moments(crossing_drive(0, cars=2, steps=20), SETTINGS)) == 0


def test_the_governing_light_is_known_without_a_picture():
    episode = drive([(0, 0, 0.0, 0.0)], light=(YELLOW, 20.0))
    assert governing_light(episode, SETTINGS, np.array([[NOW, 0]])).tolist() == [YELLOW]
    near = SETTINGS.model_copy(update={"light_range": 19.0})
    assert governing_light(episode, near, np.array([[NOW, 0]])).tolist() == [GREEN]


def test_another_rate_is_refused_with_the_way_out():
    episode = dataclasses.replace(crossing_drive(0, cars=2, steps=30), rate_hz=25.0)
    for function in (lambda: valid_moments(episode, SETTINGS), lambda: Renderer(episode, SETTINGS)):
        with pytest.raises(BadInputError, match=r"25 steps per second.*resample"):
            function()


@pytest.mark.parametrize("moment", [(NOW, 3), (21, 0), (-1, 0), (5, 0)])
def test_a_moment_without_its_agent_is_refused(moment):
    episode = drive([(0, 0, 0.0, 0.0)])
    episode.present[5, 0] = False
    with pytest.raises(BadInputError, match="no agent with index"):
        bird_view(episode, *moment, SETTINGS)


def test_a_history_with_more_shades_than_colours_is_refused():
    with pytest.raises(BadInputError, match=r"birdview\.history"):
        Renderer(crossing_drive(0, cars=2, steps=30), BirdviewSettings(history=200))


def test_the_pixels_are_those_of_the_format_version():
    """Code that changes the pixels must raise FORMAT_VERSIONS["frames"], and then this digest."""
    episode = crossing_drive(0)
    images, masks = Renderer(episode, SETTINGS).render(valid_moments(episode, SETTINGS)[::50])
    digest = hashlib.sha256(images.tobytes() + masks.tobytes()).hexdigest()[:16]
    assert (FORMAT_VERSIONS["frames"], digest) == (3, "81fef599fc2b0e89")
