import io
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from study.analysis.claims import OUTCOMES
from study.config.grid import Grid
from study.config.heads import HEAD_SETS
from study.document.blocks import Picture
from study.document.markdown import markdown
from study.document.typesetting import rasterise
from study.errors import BadInputError
from study.figures import curves, differences, driving, pictures, style
from study.report.comparison import compare
from study.report.drawings import draw, draw_sweeps
from study.report.summary import summarise
from study.report.text import document
from study.statistics import intervals, learning_curves
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, World, simulate


@pytest.fixture(scope="module")
def bands():
    table = simulate(HEADS_GRID, World(epochs=40)).table()
    return intervals.curve_bands(table, learning_curves.STEERING), intervals.curve_bands(
        table, learning_curves.ACCURACY
    )


@pytest.fixture
def heads_figure(bands):
    return curves.compare_heads(*bands, steering_floor=0.004, accuracy_floor=0.34)


def texts(figure):
    return [text.get_text() for text in figure.findobj(lambda item: hasattr(item, "get_text")) if text.get_text()]


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return np.dot([0.2126, 0.7152, 0.0722], linear)


def test_every_head_set_has_a_colour_and_a_marker_of_its_own():
    for mark in ("colour", "marker"):
        assert len({getattr(style.look(name), mark) for name in HEAD_SETS}) == len(HEAD_SETS)


def test_a_head_set_that_no_record_names_has_a_look_of_its_own():
    other = style.look("rec+weather")
    assert other == style.look("rec+weather")
    assert other.colour not in {style.look(name).colour for name in HEAD_SETS}


def test_head_sets_of_similar_grey_differ_in_line_style():
    for first in map(style.look, HEAD_SETS):
        for second in map(style.look, HEAD_SETS):
            if first.name < second.name and abs(luminance(first.colour) - luminance(second.colour)) < 0.1:
                assert first.line != second.line


def test_curves_are_labelled_directly_and_axes_have_units(heads_figure):
    assert set(HEAD_SETS) <= set(texts(heads_figure))
    loss, accuracy = heads_figure.axes
    assert accuracy.get_ylabel() == "accuracy [%]"
    assert loss.get_ylabel().startswith("smooth L1 loss")
    assert all(axes.get_xlabel() == "policy epoch" for axes in heads_figure.axes)


def test_the_loss_axis_starts_at_zero_and_a_cut_accuracy_axis_says_so(heads_figure):
    loss, accuracy = heads_figure.axes
    assert loss.get_ylim()[0] == 0
    assert accuracy.get_ylim()[0] > 34
    assert any("axis cut; majority class at 34.0 %" in text for text in texts(heads_figure))


def test_a_floor_in_sight_is_a_line(bands):
    steering, accuracy = bands
    figure = curves.compare_heads(steering, accuracy, steering_floor=0.0003, accuracy_floor=0.8)
    assert {"best constant ", "majority class "} <= set(texts(figure))


def test_lines_show_the_means_they_are_given(bands, heads_figure):
    _, accuracy = bands
    drawn = [line.get_ydata() for line in heads_figure.axes[1].lines if len(line.get_ydata()) == 40]
    for heads, data in zip(HEAD_SETS, drawn, strict=True):
        np.testing.assert_allclose(data, 100 * accuracy[accuracy["heads"] == heads]["mean"])


def test_labels_at_the_ends_do_not_touch(bands):
    steering, accuracy = bands
    same = accuracy.assign(mean=0.8 + 0.001 * accuracy["epoch"])
    figure = curves.compare_heads(steering, same, 0.004, 0.34)
    axes = figure.axes[1]
    heights = sorted(text.get_position()[1] for text in axes.texts if text.get_text() in HEAD_SETS)
    assert min(np.diff(heights)) > 0.05


def test_labels_that_have_room_stay_at_their_curves(bands):
    """Those that crowd at the bottom do not push away the one at the top."""
    steering, _ = bands
    names = list(HEAD_SETS)
    crowd = steering.assign(mean=[0.001 + 0.002 * (name == names[0]) for name in steering["heads"]])
    figure = curves.compare_heads(crowd, bands[1], 0.004, 0.34)
    low, high = figure.axes[0].get_ylim()
    places = {text.get_text(): text.get_position()[1] for text in figure.axes[0].texts}
    assert places[names[0]] == pytest.approx((3 - low) / (high - low))
    assert min(places[name] for name in names) >= 0.02


def test_a_figure_is_the_same_bytes_each_time(bands):
    figures = [curves.compare_heads(*bands, steering_floor=0.004, accuracy_floor=0.34) for _ in range(2)]
    one, two = ({f"f.{kind}": style.paint(figure, kind) for kind in ("svg", "png")} for figure in figures)
    assert one == two
    assert b"<dc:date>" not in one["f.svg"]


def grey(picture):
    return np.asarray(Image.open(io.BytesIO(picture)).convert("L"), np.float64)


def test_typst_paints_svg_pictures_as_matplotlib_does(heads_figure, bands):
    other = curves.converge_speed(bands[1], "rec", {}, 0.34)
    drawn = {"a": heads_figure, "b": other}
    painted = rasterise({f"{name}.svg": style.paint(figure, "svg") for name, figure in drawn.items()})
    assert list(painted) == ["a.png", "b.png"]
    for name, figure in drawn.items():
        ours, theirs = (grey(content) for content in (painted[f"{name}.png"], style.paint(figure, "png")))
        assert ours.shape == theirs.shape
        ours, theirs = (cv2.blur(picture, (9, 9)) for picture in (ours, theirs))  # edges are smoothed differently
        assert np.abs(ours - theirs).mean() < 0.2 * np.abs(theirs - 255).mean()
    assert rasterise({}) == {}


def test_an_interval_of_few_drives_does_not_stretch_the_axis_of_driving_scores():
    (axes,) = driving.scores([("rec", "rec", 40.0, 30.0, 50.0), ("full", "full", 60.0, -22_000.0, 22_000.0)]).axes
    low, high = axes.get_xlim()
    assert -5 < low < 0
    assert 100 < high < 110
    ends = [path.vertices[:, 0].tolist() for lines in axes.collections for path in lines.get_paths()]
    assert ends == [[30, 50], [0, 100]]


def test_a_figure_is_written_atomically_in_the_format_of_its_ending(tmp_path):
    for ending, start in ((".svg", b"<?xml"), (".PNG", b"\x89PNG"), (".pdf", b"%PDF")):
        contents = []
        for name in ("one", "two"):
            style.write(differences.confusions([("rec", np.eye(3))]), tmp_path / f"{name}{ending}")
            contents.append((tmp_path / f"{name}{ending}").read_bytes())
        assert contents[0].startswith(start)
        assert contents[0] == contents[1]
    assert len(list(tmp_path.iterdir())) == 6


def test_picture_rows_place_a_picture_of_each_row_in_each_column():
    shades = np.arange(3, dtype=np.uint8)[:, None, None] * np.ones((3, 64, 64), np.uint8)
    figure = pictures.picture_rows([("input", shades), ("", shades), ("target", shades)])
    assert [axes.images[0].get_array().shape[:2] for axes in figure.axes] == [(200, 600)] * 2
    assert [text.get_text() for text in figure.texts] == ["input", "target"]


ENCODERS_GRID = HEADS_GRID.model_copy(update={"heads": ("rec", "full"), "encoder_seeds": 3, "policy_seeds": 5})


@pytest.mark.parametrize(
    ("grid", "names"),
    [
        (
            HEADS_GRID,
            {
                "test_compare_heads",
                "train_compare_heads",
                "single_head_rec",
                "multi_results",
                "latent_maps",
                "all_head_sets",
                "confusion",
                "encoder_losses",
            },
        ),
        (ENCODERS_GRID, {"by_encoder"}),
        (DATASIZE_GRID, {"datasize_compare", "datasize_convergespeed"}),
    ],
)
def test_a_sweep_gets_every_figure_of_the_paper_with_n_in_the_caption(grid, names):
    record = simulate(grid, World(epochs=12))
    report = summarise(record)
    report = report.model_copy(update={"figures": tuple(draw(record, report))})
    shown = {Path(item.file).stem: item for item in document(report) if isinstance(item, Picture)}
    assert set(shown) == set(report.figures)
    assert names <= set(shown)
    for name in names - {"encoder_losses", "single_head_rec", "multi_results", "latent_maps", "all_head_sets"}:
        assert ("n = 3 encoders" if name == "by_encoder" else "n = 15 policies") in shown[name].caption
    assert all(item.alt for item in shown.values())


def test_a_head_set_that_no_record_names_is_in_every_figure_and_table():
    """A fifth set from another machine's report, say, takes no claim and no figure away."""
    world = World(epochs=8)
    world.accuracy["rec+weather"] = 0.9
    grid = HEADS_GRID.model_copy(update={"heads": ("rec+weather", *HEADS_GRID.heads)})
    record = simulate(grid, world)
    report = summarise(record)
    assert [score.heads for score in report.scores] == [*HEAD_SETS, "rec+weather"]
    assert {claim.outcome for claim in report.claims} <= set(OUTCOMES[:4])
    drawn = draw(record, report)
    assert "rec+weather" in texts(drawn["test_compare_heads"])
    assert "rec+weather" in markdown(compare(report, report, ("a", "b")))
    assert "rec+weather" in texts(draw_sweeps(report, report, SIDES))


def test_multi_results_shows_inputs_outputs_and_targets():
    record = simulate(HEADS_GRID, World(epochs=12))
    figure = draw(record, summarise(record))["multi_results"]
    assert [text.get_text() for text in figure.texts] == [
        "input",
        "reconstruction",
        "input",
        "prediction",
        "prediction target",
        "input",
        "planning",
        "planning target",
    ]


# --- two sweeps side by side ----------------------------------------------------------------------------------------

SIDES = ("reports/first", "the $second$_one")


def report_of(grid, seed=0):
    return summarise(simulate(grid, World(epochs=8), seed=seed))


@pytest.fixture(scope="module")
def reports():
    grids = (grid.model_copy(update={"baselines": ()}) for grid in (HEADS_GRID, DATASIZE_GRID))
    return tuple(report_of(grid, seed=seed) for seed, grid in enumerate(grids))


@pytest.fixture(scope="module")
def two(reports):
    return draw_sweeps(*reports, SIDES)


def marks(axes):
    """Return place, marker and fill of every mark in a panel."""
    return {
        (round(float(line.get_xdata()[0]), 6), line.get_marker(), line.get_markerfacecolor() != "white")
        for line in axes.lines
        if line.get_marker() in ("o", "D")
    }


def test_two_sweeps_differ_by_marker_and_fill_and_share_the_head_sets_colours(two, reports):
    left, right = two.axes
    expected = {
        (round(100 * score.accuracy.mean, 6), *mark)
        for report, mark in zip(reports, (("o", True), ("D", False)), strict=True)
        for score in report.scores
    }
    assert marks(left) == expected
    gains = {
        (round(100 * report.above_reference(point).value, 6), *mark)
        for report, mark in zip(reports, (("o", True), ("D", False)), strict=True)
        for point in report.by_point
        if point[0] != "rec"
    }
    assert marks(right) == gains
    coloured = {line.get_color() for line in left.lines if line.get_marker() in ("o", "D")}
    assert coloured == {style.look(name).colour for name in HEAD_SETS}


def test_two_sweeps_have_a_row_for_each_head_set_and_fraction_and_a_bar_for_each_interval(two, reports):
    left, right = two.axes
    names = [label.get_text() for label in left.get_yticklabels()]
    assert names[:5] == ["rec at 100 %", "rec+pred at 100 %", "rec+plan at 100 %", "full at 100 %", "rec at 50 %"]
    assert len(names) == 12
    assert left.get_ylim() == right.get_ylim()
    spans = {tuple(np.round(path.vertices[:, 0], 6)) for bars in left.collections for path in bars.get_paths()}
    scores = [score.accuracy for report in reports for score in report.scores]
    assert spans == {(round(100 * own.low, 6), round(100 * own.high, 6)) for own in scores}


def test_numbers_of_two_sweeps_do_not_touch_and_stay_inside_the_picture(reports):
    other = reports[0].model_copy(update={"sweep": reports[0].sweep.model_copy(update={"name": "again"})})
    figure = draw_sweeps(reports[0], other, SIDES)
    figure.canvas.draw()
    for axes in figure.axes:
        boxes = [text.get_window_extent() for text in axes.texts]
        assert len(boxes) == 8 - 2 * (axes is figure.axes[1])
        for index, box in enumerate(boxes):
            assert box.x1 <= figure.bbox.x1
            assert not any(box.overlaps(one) for one in boxes[index + 1 :])


def test_words_beside_two_sweeps_say_n_kind_floor_and_which_is_which(two, reports):
    (shown,) = (item for item in compare(*reports, SIDES, "two.svg") if isinstance(item, Picture))
    for words in (shown.caption.replace("\\", ""), " ".join(texts(two)).replace(r"\$", "$")):
        assert "first, reports/first (n = 15 policies on one encoder)" in words
        assert "second, the $second$_one (n = 15 policies on one encoder)" in words
    assert "95 % interval (t, over policy seeds and 15 test drives" in shown.caption
    assert "difference to rec of the same sweep" in shown.caption
    floors = " and ".join(f"{100 * report.floor['acceleration_accuracy']:.1f}" for report in reports)
    assert any(f"axis cut; majority class at {floors} %" in text for text in texts(two))
    assert f"rec+pred at 100 %: {100 * reports[0].scores[1].accuracy.mean:.1f} % and none" in shown.alt


def test_one_score_without_interval_is_drawn_and_no_score_is_refused(tmp_path):
    grid = Grid(name="one", title="One", heads=("full",), policy_seeds=1, baselines=())
    one = report_of(grid)
    assert math.isnan(one.scores[0].accuracy.low)
    drawing = draw_sweeps(one, one, ("a" * 200, "b"))
    style.write(drawing, tmp_path / "one.png")
    (axes,) = drawing.axes
    assert not any(
        math.isfinite(x) for bars in axes.collections for path in bars.get_paths() for x in path.vertices[:, 0]
    )
    assert len(marks(axes)) == 2
    empty = one.model_copy(update={"scores": ()})
    with pytest.raises(BadInputError, match="no cell is finished in a or b"):
        draw_sweeps(empty, empty, ("a", "b"))
