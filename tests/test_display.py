"""The display's plain lines and its estimate."""

import pytest

from study.config.grid import Cell
from study.config.settings import StudySettings
from study.console.display import Display
from study.stages import CELL_STAGES, ENCODER, Work, share_done

COSTS = {"a": 100.0, "b": 100.0}
WORKS = {key: Work(StudySettings(), Cell(heads="rec"), 15) for key in COSTS}
LABELS = {"a": "rec 100% e0", "b": "full 100% e0", "c": "rec+plan 100% e0"}


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("study.console.display.time.monotonic", lambda: now[0])
    return now


def test_time_left_follows_what_was_measured(clock):
    with Display("heads", COSTS, LABELS, 0.0, WORKS) as display:
        assert display.left() is None
        display.start("a")
        display.progress("a", "encoder", 0, 10)
        clock[0] += 400
        display.progress("a", "result", 1, 1)
        assert display.left() == pytest.approx(400)  # four times as slow as expected, half is done


def test_what_was_done_before_a_restart_does_not_count_as_speed(clock):
    encoder = share_done(CELL_STAGES, WORKS["a"], ENCODER, 1.0)
    with Display("heads", {"a": 100.0}, LABELS, 0.0, WORKS) as display:
        display.start("a")
        display.progress("a", "encoder", 5, 10)
        clock[0] += 40
        display.progress("a", "encoder", 10, 10)
        assert display.left() == pytest.approx(40 * (1 - encoder) / (encoder / 2))


def test_plain_lines_count_the_cells(clock, capsys):
    with Display("heads (smoke)", COSTS, LABELS, 0.0) as display:
        display.start("a")
        display.finish("a")
        display.start("b")
        display.fail("b")
    err = capsys.readouterr().err
    assert "1 of 3 cells finished" in err
    assert "rec 100% e0: finished; cells 2/3" in err
    assert "full 100% e0: FAILED; cells 2/3, 1 failed" in err


def test_the_data_line_tells_rate_and_time_left(clock, capsys):
    """Half of the drives were there before this start: only the others count as speed."""
    with Display("data (smoke)", {}, {}, 100.0) as display:
        display.data("record", 50, 100)
        clock[0] += 40
        display.data("record", 75, 100)
        assert display.left() == pytest.approx(80)
    assert "recording drives 75/100, 0.62/s" in capsys.readouterr().err


@pytest.mark.parametrize("stages", [("record", "select", "render", "describe"), ("record", "select", "render")])
def test_data_that_is_made_leaves_nothing_to_wait_for_or_to_show(clock, capsys, stages):
    """With the cells' own time left alone, whether or not the data are described."""
    with Display("heads", {"a": 100.0}, LABELS, 100.0, WORKS) as display:
        for stage in stages:
            display.data(stage, 0, 10)
            clock[0] += 100 / len(stages)
            display.data(stage, 10, 10)
        assert display.left() == pytest.approx(100)
        capsys.readouterr()
        display.tick(now=True)
    assert capsys.readouterr().err.split("  ")[1].startswith("waiting")
