import xml.etree.ElementTree as ET

import numpy as np
import pytest

from simulated import DATASIZE_GRID, HEADS_GRID, World, simulate
from study import figures, stats
from study.config import HEAD_SETS
from study.drawings import draw
from study.summary import numbers


@pytest.fixture(scope="module")
def bands():
    table = simulate(HEADS_GRID, World(epochs=40)).table()
    return stats.curve_bands(table, stats.STEERING), stats.curve_bands(table, stats.ACCURACY)


@pytest.fixture
def heads_figure(bands):
    return figures.compare_heads(*bands, steering_floor=0.004, accuracy_floor=0.34)


def texts(figure):
    return [text.get_text() for text in figure.findobj(lambda item: hasattr(item, "get_text")) if text.get_text()]


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return np.dot([0.2126, 0.7152, 0.0722], linear)


def test_every_head_set_has_a_colour_a_line_and_a_marker_of_its_own():
    for marks in (figures.COLOUR, figures.MARKER):
        assert set(marks) == set(HEAD_SETS)
        assert len(set(marks.values())) == len(HEAD_SETS)
    assert set(figures.LINE) == set(HEAD_SETS)


def test_head_sets_of_similar_grey_differ_in_line_style():
    for first in HEAD_SETS:
        for second in HEAD_SETS:
            similar = abs(luminance(figures.COLOUR[first]) - luminance(figures.COLOUR[second])) < 0.1
            if first < second and similar:
                assert figures.LINE[first] != figures.LINE[second]


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
    figure = figures.compare_heads(steering, accuracy, steering_floor=0.001, accuracy_floor=0.8)
    assert {"best constant ", "majority class "} <= set(texts(figure))


def test_lines_show_the_means_they_are_given(bands, heads_figure):
    _, accuracy = bands
    drawn = [line.get_ydata() for line in heads_figure.axes[1].lines if len(line.get_ydata()) == 40]
    for heads, data in zip(HEAD_SETS, drawn, strict=True):
        np.testing.assert_allclose(data, 100 * accuracy[accuracy["heads"] == heads]["mean"])


def test_labels_at_the_ends_do_not_touch(bands):
    steering, accuracy = bands
    same = accuracy.assign(mean=0.8 + 0.001 * accuracy["epoch"])
    figure = figures.compare_heads(steering, same, 0.004, 0.34)
    axes = figure.axes[1]
    heights = sorted(text.get_position()[1] for text in axes.texts if text.get_text() in HEAD_SETS)
    assert min(np.diff(heights)) > 0.05


def test_a_figure_is_the_same_bytes_each_time(bands, tmp_path):
    for folder in ("one", "two"):
        figure = figures.compare_heads(*bands, steering_floor=0.004, accuracy_floor=0.34)
        figures.save(figure, tmp_path / folder, "f")
    for kind in ("svg", "png"):
        one, two = ((tmp_path / folder / f"f.{kind}").read_bytes() for folder in ("one", "two"))
        assert one == two
    assert b"<dc:date>" not in one


def test_saved_files_are_svg_and_png_and_nothing_is_left_beside_them(heads_figure, tmp_path):
    vector, raster = figures.save(heads_figure, tmp_path, "f")
    assert ET.parse(vector).getroot().tag.endswith("svg")  # noqa: S314 - our own file
    assert raster.read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {"f.svg", "f.png"}


def test_picture_rows_place_a_picture_of_each_row_in_each_column():
    pictures = np.arange(3, dtype=np.uint8)[:, None, None] * np.ones((3, 64, 64), np.uint8)
    figure = figures.picture_rows([("input", pictures), ("", pictures), ("target", pictures)])
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
            },
        ),
        (ENCODERS_GRID, {"by_encoder"}),
        (DATASIZE_GRID, {"datasize_compare", "datasize_convergespeed"}),
    ],
)
def test_a_sweep_gets_every_figure_of_the_paper_with_n_in_the_caption(grid, names):
    record = simulate(grid, World(epochs=12))
    drawings = {drawing.name: drawing for drawing in draw(record, numbers(record))}
    assert names <= set(drawings)
    for name in names - {"single_head_rec", "multi_results", "latent_maps", "all_head_sets"}:
        wanted = "n = 3 encoders x 5 policies" if name == "by_encoder" else "n = 15 policies"
        assert wanted in drawings[name].caption
    assert all(drawing.alt for drawing in drawings.values())


def test_multi_results_shows_inputs_outputs_and_targets():
    record = simulate(HEADS_GRID, World(epochs=12))
    figure = next(d.figure for d in draw(record, numbers(record)) if d.name == "multi_results")
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
