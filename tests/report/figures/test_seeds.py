import numpy as np
import pytest
from report_studies import legend, lines

from chargetune.report import seeds_figure
from chargetune.report.figures.seeds import draw_seeds
from chargetune.report.figures.style import BLUE, ORANGE


def row(seed, untuned, tuned, **more):
    def run(pair):
        return None if pair is None else {"overshoot_mV": pair[0], "t95_min": pair[1], "t80_min": 1.0}

    return {"seed": seed, "untuned": run(untuned), "tuned": run(tuned), **more}


ROWS = [
    row(3, (38.0, 39.0), (0.2, 36.4), attainable_t95_min=36.0),
    row(5, (62.0, 35.0), (0.4, 36.8), attainable_t95_min=None),
    row(9, (45.0, None), (-0.3, None)),
    row(11, (113.0, 37.0), None),
]


def markers(axis, color):
    return [line for line in lines(axis, color) if line.get_linestyle() == "None" and line.get_marker() != "x"]


def medians(axis, color):
    return [line.get_ydata()[0] for line in lines(axis, color) if line.get_linestyle() == ":"]


def test_dots_are_the_rows():
    figure = draw_seeds(ROWS)
    upper, lower = figure.axes
    nan = np.nan
    for axis, color, values in (
        (upper, BLUE, [38, 62, 45, 113]), (upper, ORANGE, [0.2, 0.4, -0.3, nan]),
        (lower, BLUE, [39, 35, nan, 37]), (lower, ORANGE, [36.4, 36.8, nan, nan]),
    ):  # fmt: skip
        (dots,) = markers(axis, color)
        assert list(dots.get_xdata()) == [0, 1, 2, 3]
        np.testing.assert_array_equal(dots.get_ydata(), values)
    figure.canvas.draw()
    assert [t.get_text() for t in lower.get_xticklabels()] == ["3", "5", "9", "11"]
    assert upper.get_ylabel() == "overshoot (mV)"
    assert lower.get_ylabel().replace("\n", " ") == "time to 95 % SOC (min)"
    assert lower.get_xlabel() == "mismatch seed"
    assert legend(figure) == ["untuned", "tuned", "median", "limit", "no value", "attainable"]


def test_pairs_are_joined_where_both_are_known():
    for axis, joined in zip(draw_seeds(ROWS).axes, ([[38, 0.2], [62, 0.4], [45, -0.3]], [[39, 36.4], [35, 36.8]]), strict=True):
        np.testing.assert_array_equal([s[:, 1] for s in axis.collections[0].get_segments()], joined)


def test_medians_count_a_charge_that_never_arrives_as_the_slowest():
    upper, lower = draw_seeds(ROWS).axes
    assert medians(upper, BLUE) == [53.5]
    assert medians(upper, ORANGE) == [0.2]
    assert medians(lower, BLUE) == [38.0], "of 35, 37, 39 and never"
    assert medians(lower, ORANGE) == [36.8], "of 36.4, 36.8 and never"
    slow = [row(0, (1.0, None), None), row(1, (2.0, 30.0), None)]
    assert medians(draw_seeds(slow).axes[1], BLUE) == [], "half of them never arrive"


def test_missing_values_are_marked():
    upper, lower = draw_seeds(ROWS).axes
    crosses = [
        [(line.get_label(), np.round(line.get_xdata()).tolist()) for line in axis.lines if line.get_marker() == "x"]
        for axis in (upper, lower)
    ]
    assert crosses[0] == [("tuned: no value", [3])]
    assert crosses[1] == [("untuned: no value", [2]), ("tuned: no value", [2, 3])]
    assert "no value" not in legend(draw_seeds(ROWS[:2]))


def test_attainable_values():
    (marks,) = [line for line in draw_seeds(ROWS).axes[1].lines if line.get_label() == "attainable"]
    np.testing.assert_array_equal(marks.get_ydata(), [36.0, np.nan, np.nan, np.nan])
    assert "attainable" not in legend(draw_seeds(ROWS[1:]))


@pytest.mark.parametrize(("count", "width"), [(1, 3.5), (12, 3.5), (13, 7.0), (100, 7.0)])
def test_width_follows_the_number_of_seeds(tmp_path, count, width):
    rows = [row(s, (50.0 + s, 38.0), (0.1, 37.0)) for s in range(count)]
    assert draw_seeds(rows).get_figwidth() == width
    assert seeds_figure(rows, tmp_path / "s.pdf").read_bytes().startswith(b"%PDF")


def test_nothing_to_draw_and_unknown_format(tmp_path):
    with pytest.raises(ValueError, match="rows: empty"):
        seeds_figure([], tmp_path / "s.png")
    with pytest.raises(ValueError, match="format 'bmp', allowed are png, pdf, svg"):
        seeds_figure(ROWS, tmp_path / "s.bmp")
    assert not list(tmp_path.iterdir())
