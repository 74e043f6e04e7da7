import numpy as np
import pytest
from matplotlib.colors import to_hex
from report_studies import CUT, TRIALS, legend, lines, segments

from chargetune.report import read_study
from chargetune.report.figures.style import BLUE, GREY, ORANGE, RED
from chargetune.report.figures.trajectories import curves, trajectories_figure


def expected(episode, panel):
    """The points of one panel, written out interval by interval."""
    step, minutes, values = episode.sampling_time_s, [], []
    for k, start in enumerate(episode.time_s):
        if panel == 0:
            soc = episode.output_names.index("soc")
            if k == 0:
                minutes.append(start / 60)
                values.append(100 * episode.output_start[0, soc])
            minutes.append((start + step) / 60)
            values.append(100 * episode.output_end[k, soc])
        else:
            voltage = episode.output_names.index("voltage_V")
            pair = [episode.input[k, 0]] * 2 if panel == 1 else [episode.output_start[k, voltage], episode.output_end[k, voltage]]
            minutes += [start / 60, (start + step) / 60]
            values += pair
    return np.array(minutes), np.array(values)


@pytest.mark.parametrize("kind", ["mixed", "violating", "ei"])
def test_panels_show_the_episodes(stores, kind):
    view = read_study(stores[kind], "charge")
    axes = trajectories_figure(view).axes
    assert [a.get_ylabel() for a in axes] == ["SOC (%)", "current (A)", "voltage (V)", "voltage near limit (V)"]
    assert [a.get_xlabel() for a in axes] == ["", "", "time (min)", "time (min)"]
    others = [episode for _, episode in view.episodes(view.others)]
    for panel, axis in enumerate(axes):
        for trial, color in ((view.untuned, BLUE), (view.tuned, ORANGE)):
            (line,) = lines(axis, color)
            minutes, values = expected(view.episode(trial), panel)
            np.testing.assert_allclose(line.get_xdata(), minutes, rtol=1e-14)
            np.testing.assert_allclose(line.get_ydata(), values, rtol=1e-14)
        grey = segments(axis)
        assert len(grey) == len(others)
        for drawn, episode in zip(grey, others, strict=True):
            np.testing.assert_allclose(drawn, np.column_stack(expected(episode, panel)), rtol=1e-14)
        assert to_hex(axis.collections[0].get_color()[0]) == GREY.lower()


def test_limits_and_frame(stores):
    axes = trajectories_figure(read_study(stores["mixed"], "charge")).axes
    for axis, limit in zip(axes, (None, 6.0, 4.2, 4.2), strict=True):
        red = lines(axis, RED)
        assert [list(line.get_ydata()) for line in red] == ([] if limit is None else [[limit, limit]])
        assert all(line.is_dashed() for line in red)
        assert axis.get_xlim() == (0.0, 25.0)
    low, high = axes[3].get_ylim()
    assert 4.1 < low < 4.2, "the limit is in view"
    assert 4.238 < high < 4.3, "the untuned overshoot is in view, the trials' may not be"


def test_legend_names_what_is_drawn(stores):
    said = {kind: legend(trajectories_figure(read_study(stores[kind], "charge"))) for kind in ("mixed", "violating")}
    number = read_study(stores["violating"], "charge").tuned.number
    assert said["mixed"] == ["trials", "untuned", "tuned (trial 8)", "limit"]
    assert said["violating"] == ["trials", "untuned", f"tuned, over a limit (trial {number})", "limit"]


def test_untuned_run_shows_through_when_it_is_the_tuned_one_too(stores):
    figure = trajectories_figure(read_study(stores["mixed"], "charge", trials=1))
    assert legend(figure) == ["untuned", "tuned, over a limit (trial 0)", "limit"]
    for axis in figure.axes:
        assert [lines(axis, color)[0].get_linestyle() for color in (BLUE, ORANGE)] == ["-", "--"]


def test_failed_trials_are_shown_as_far_as_they_came(stores):
    view = read_study(stores["mixed"], "charge")
    lengths = [len(s) for s in segments(trajectories_figure(view).axes[1])]
    assert lengths.count(2 * CUT) == 1
    assert len(lengths) == TRIALS - 3, "all but the untuned, the tuned and the one that left no trace"


def test_without_any_trace_there_is_only_the_frame(stores):
    view = read_study(stores["failed"], "charge")
    figure = trajectories_figure(view)
    assert legend(figure) == ["tuned: none", "limit"]
    assert not lines(figure.axes[0], BLUE)


def test_remark_on_the_cell_is_shown(stores):
    note = trajectories_figure(read_study(stores["mixed"], "charge")).get_supxlabel()
    assert "stand-in" in note
    assert "INR18650-20S" in note


def test_missing_measurements_leave_a_gap(stores):
    episode = read_study(stores["mixed"], "charge").episode(read_study(stores["mixed"], "charge").trials[0])
    episode.output_end[4] = np.nan
    assert np.flatnonzero(np.isnan(curves(episode)["voltage_V"][1])).tolist() == [9]
    assert np.flatnonzero(np.isnan(curves(episode)["soc"][1])).tolist() == [5]
