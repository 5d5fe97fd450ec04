"""Anyone's Episodes: brought to 10 Hz, with commands and progress from the motion; importing is all or nothing."""

import dataclasses
import json
import shutil

import numpy as np
import pandas as pd
import pytest

from study.birdview.renderer import valid_moments
from study.config.files import load_profile
from study.config.settings import FramesSettings
from study.data.frames import open_frames
from study.data.prepare import data_flow
from study.engine.flows import run_flow
from study.episode.files import read_episode, write_episode
from study.episode.head import file_digest
from study.errors import BadInputError
from study.intake.adapt import STEERING_UNIT, adapt, derived_commands
from study.intake.imported import open_import
from study.intake.importing import import_drives
from study.planning.plan import make_plan
from study.sim.record import record_episode
from tests.support.drives import crossing_drive, write_drives


@pytest.fixture(scope="module")
def drive():
    return crossing_drive(seed=2, cars=6, steps=60)


@pytest.fixture(scope="module")
def town():
    """Return a drive of our town, whose commands are known."""
    settings = load_profile("smoke", {"town": {"vehicles": 30}, "recording": {"warm_up": 4, "duration": 8}})
    return record_episode(settings.town, settings.dynamics, settings.recording, 3)


@pytest.fixture
def folder(tmp_path):
    write_drives(tmp_path / "log", 4, cars=4, steps=60)
    return tmp_path / "log"


def unlabelled(episode, **changes):
    unknown = np.full_like(episode.steering, np.nan)
    return dataclasses.replace(episode, steering=unknown, acceleration=unknown, labels="none", **changes)


def thinned(episode, every):
    """Return the Episode at a lower rate: every n-th step."""
    names = [field.name for field in dataclasses.fields(episode)]
    arrays = {name: getattr(episode, name) for name in names}
    part = {name: v[::every] for name, v in arrays.items() if isinstance(v, np.ndarray) and len(v) == episode.steps}
    return dataclasses.replace(episode, rate_hz=episode.rate_hz / every, **part)


def test_a_drive_at_10_hz_stays_as_it_is(drive):
    adapted = adapt(drive, "drive")
    assert (adapted.derived, adapted.skipped, adapted.egos) == (0, 0, 6)
    assert adapted.episode.labels == "recorded"
    assert np.array_equal(adapted.episode.x, drive.x)
    assert np.array_equal(adapted.episode.steering, drive.steering)


@pytest.mark.parametrize("every", [2, 4])
def test_a_slower_log_comes_back_to_10_hz_near_where_it_was(drive, every):
    adapted = adapt(thinned(drive, every), "drive").episode
    steps = adapted.steps
    assert adapted.rate_hz == 10
    assert steps == (drive.steps - 1) // every * every + 1
    assert np.abs(adapted.x - drive.x[:steps]).max() < 0.15 * every
    assert np.array_equal(adapted.x[::every], drive.x[:steps:every])
    assert np.array_equal(adapted.light_state, drive.light_state[np.arange(steps) // every * every])


def test_headings_are_interpolated_the_short_way_round(drive):
    heading = np.where(np.arange(drive.steps)[:, None] % 2, np.pi - 0.1, -np.pi + 0.1) + np.zeros(6)
    still = np.zeros_like(drive.x)
    turning = dataclasses.replace(drive, x=still, y=still, speed=still, heading=heading.astype(np.float32), rate_hz=5.0)
    assert np.abs(adapt(turning, "drive").episode.heading).min() > np.pi - 0.11


def test_an_agent_is_there_between_steps_only_if_it_is_at_both(drive):
    present = drive.present.copy()
    present[20:, 0] = False
    adapted = adapt(dataclasses.replace(drive, present=present, rate_hz=5.0), "drive").episode
    assert np.flatnonzero(adapted.present[:, 0]).max() == 38


def test_the_steering_unit_is_the_towns(town):
    assert town.source["steering_unit"] == STEERING_UNIT


def test_derived_commands_are_those_of_the_autopilot(town):
    steering, acceleration = derived_commands(town)
    moving = town.present & (town.speed > 2) & np.isfinite(steering)
    assert np.median(np.abs(steering - town.steering)[moving]) < 0.005
    assert np.corrcoef(steering[moving], town.steering[moving])[0, 1] > 0.9
    assert (acceleration == town.acceleration)[moving].mean() > 0.8


def test_where_nobody_has_commands_all_are_derived_and_marked(drive):
    adapted = adapt(unlabelled(drive), "drive")
    assert adapted.episode.labels == "derived"
    assert adapted.derived == drive.present.sum()
    assert adapted.egos == 6


def test_an_agent_without_commands_among_others_is_traffic(drive):
    steering, acceleration = drive.steering.copy(), drive.acceleration.copy()
    steering[:, 2] = acceleration[:, 2] = np.nan
    steering[10, 0] = np.nan  # one of both: derived
    steering[11, 1] = acceleration[11, 1] = np.nan  # neither: unknown
    adapted = adapt(dataclasses.replace(drive, steering=steering, acceleration=acceleration), "drive")
    assert [agent.ego for agent in adapted.episode.agents] == [True, True, False, True, True, True]
    assert (adapted.derived, adapted.skipped, adapted.episode.labels) == (1, 1, "derived")
    moments = valid_moments(adapted.episode, load_profile("smoke").birdview)
    assert not (moments[:, 1] == 2).any()


def test_progress_follows_the_route(drive):
    unknown = np.full_like(drive.route_s, np.nan)
    adapted = adapt(dataclasses.replace(drive, route_s=unknown), "drive").episode
    assert np.abs(adapted.route_s - drive.route_s).max() < 0.3


def test_a_log_without_lights_or_routes_is_fine(drive):
    bare = dataclasses.replace(
        unlabelled(drive),
        lights=(),
        light=np.full_like(drive.light, -1),
        light_state=np.zeros((drive.steps, 0), np.uint8),
        routes=tuple(route[:0] for route in drive.routes),
        route_s=np.full_like(drive.route_s, np.nan),
    )
    adapted = adapt(bare, "drive").episode
    assert np.isnan(adapted.route_s).all()
    assert len(valid_moments(adapted, load_profile("smoke").birdview))


def test_too_low_a_rate_is_refused(drive):
    still = np.zeros_like(drive.x)
    with pytest.raises(BadInputError, match="rate_hz"):
        adapt(dataclasses.replace(drive, speed=still, x=still, rate_hz=1.0), "drive")


# --- importing ------------------------------------------------------------------------------------------------------


def content(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def spoil(folder, change):
    """Change a state table as a writer with a fault would."""
    path = folder / "states.parquet"
    change(pd.read_parquet(path)).to_parquet(path, index=False)
    head = json.loads((folder / "episode.json").read_text())
    head["digests"]["states.parquet"] = file_digest(path)
    (folder / "episode.json").write_text(json.dumps(head))


def test_the_same_drives_give_the_same_bytes(folder, tmp_path):
    import_drives(folder, tmp_path / "one")
    import_drives(folder, tmp_path / "two")
    import_drives(folder, tmp_path / "two")
    assert content(tmp_path / "one") == content(tmp_path / "two")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log", "one", "two"]


def test_what_was_imported_is_read_back(folder, tmp_path):
    adapted = import_drives(folder, tmp_path / "out")
    assert open_import(tmp_path / "out") == adapted
    assert [drive.name for drive in adapted.drives] == [f"drive-{number:03d}" for number in range(4)]
    assert {read_episode(tmp_path / "out" / drive.name).digest for drive in adapted.drives} == {
        drive.digest for drive in adapted.drives
    }


@pytest.mark.parametrize(
    ("field", "value"),
    [("x", np.inf), ("speed", np.nan), ("step", 1000), ("agent", 7), ("light", 99), ("acceleration", 0.3)],
)
def test_one_bad_row_is_named_and_nothing_is_written(folder, tmp_path, field, value):
    def change(table):
        table.loc[5, field] = value
        return table

    spoil(folder / "drive-002", change)
    with pytest.raises(BadInputError, match=rf"drive-002.*states\.parquet, row 5, field '{field}'"):
        import_drives(folder, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


def test_overlapping_steps_are_named(folder, tmp_path):
    spoil(folder / "drive-001", lambda table: pd.concat([table.iloc[:3], table.iloc[2:]]))
    with pytest.raises(BadInputError, match=r"row 3: agent \d+ stands twice in step 0"):
        import_drives(folder, tmp_path / "out")


def test_speeds_in_km_per_h_are_refused(folder, tmp_path):
    spoil(folder / "drive-001", lambda table: table.assign(speed=table["speed"] * np.float32(3.6)))
    with pytest.raises(BadInputError, match=r"'speed'.*does not fit the positions"):
        import_drives(folder, tmp_path / "out")


@pytest.mark.parametrize("what", ["drive", "file"])
def test_a_path_that_leads_out_is_refused(folder, tmp_path, what):
    outside = tmp_path / "outside"
    write_episode(crossing_drive(seed=9, cars=4, steps=30), outside)
    if what == "drive":
        (folder / "more").symlink_to(outside)
    else:
        (folder / "drive-000" / "map.json").unlink()
        (folder / "drive-000" / "map.json").symlink_to(outside / "map.json")
    with pytest.raises(BadInputError, match="leads out"):
        import_drives(folder, tmp_path / "out")


def test_a_folder_with_something_else_is_left_alone(folder, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(BadInputError, match="no import"):
        import_drives(folder, tmp_path / "out")
    assert (tmp_path / "out" / "thesis.tex").exists()


def test_the_sets_share_no_drive_and_each_can_be_split(folder, tmp_path):
    imported = import_drives(folder, tmp_path / "out")
    encoder, policy = imported.assign(FramesSettings(encoder=5000, policy=10))
    assert (len(encoder), len(policy)) == (2, 2)
    assert not set(encoder) & set(policy)


def test_too_few_drives_are_reported_with_what_is_needed(folder, tmp_path):
    imported = import_drives(folder, tmp_path / "out")
    with pytest.raises(BadInputError, match="needs 4 or more"):
        dataclasses.replace(imported, drives=imported.drives[:3]).assign(FramesSettings())


def test_a_sweeps_cells_are_known_by_the_drives_they_stand_on(folder, tmp_path):
    import_drives(folder, tmp_path / "one")
    write_drives(folder, 1, first_seed=50, cars=4, steps=60)
    import_drives(folder, tmp_path / "two")
    plans = [make_plan("heads", "smoke", {}, {}, data) for data in (None, tmp_path / "one", tmp_path / "two")]
    keys = [set(plan.cells) for plan in plans]
    assert not keys[0] & keys[1]
    assert not keys[1] & keys[2]
    assert len({plan.frames for plan in plans}) == 3


def test_imported_drives_become_the_frames_of_a_sweep(folder, tmp_path):
    imported = import_drives(folder, tmp_path / "out")
    settings = load_profile("smoke", {"frames": {"encoder": 10, "policy": 10}})
    store = open_frames(run_flow(data_flow(settings, tmp_path, imported)))
    assert (len(store.encoder), len(store.policy)) == (10, 10)
    assert not (tmp_path / "episodes").exists()


def test_drives_that_give_too_few_frames_are_reported_with_the_setting(folder, tmp_path):
    imported = import_drives(folder, tmp_path / "out")
    with pytest.raises(BadInputError, match=r"needs \d+ .*frames.*lower --frames\.encoder"):
        run_flow(data_flow(load_profile("smoke"), tmp_path, imported))


def test_a_drive_that_has_changed_since_is_reported(folder, tmp_path):
    imported = import_drives(folder, tmp_path / "out")
    shutil.copy(folder / "drive-000" / "episode.json", tmp_path / "out" / "drive-001" / "episode.json")
    with pytest.raises(BadInputError, match="drive-001 is not what was imported"):
        imported.check()
