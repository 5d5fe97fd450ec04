"""The display's plain lines and its estimate."""

import pytest

from study.display import Display

COSTS = {"a": 100.0, "b": 100.0}
LABELS = {"a": "rec 100% e0", "b": "full 100% e0", "c": "rec+plan 100% e0"}


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("study.display.time.monotonic", lambda: now[0])
    return now


def test_time_left_follows_what_was_measured(clock):
    with Display("heads", COSTS, LABELS, 0.0) as display:
        assert display.left() is None
        display.start("a")
        display.progress("a", "encoder", 0, 10)
        clock[0] += 400
        display.progress("a", "policy", 10, 10)
        assert display.left() == pytest.approx(400)  # twice as slow as expected, half is done


def test_what_was_done_before_a_restart_does_not_count_as_speed(clock):
    with Display("heads", {"a": 100.0}, LABELS, 0.0) as display:
        display.start("a")
        display.progress("a", "encoder", 5, 10)
        clock[0] += 40
        display.progress("a", "encoder", 10, 10)
        assert display.left() == pytest.approx(20)


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
