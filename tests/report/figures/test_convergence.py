from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex
from report_studies import legend, lines

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.report import read_study
from chargetune.report.figures.convergence import convergence_figure, excess_unit, incumbents, worst_excess
from chargetune.report.figures.style import BLUE, GREEN, ORANGE, RED
from chargetune.report.page.trial_rows import study_head, trial_rows
from chargetune.report.study_view import StudyView
from chargetune.study.result import measured_result
from chargetune.study.trial import Trial, TrialStatus

pytestmark = pytest.mark.usefixtures("virtual_machine")

DONE, FAILED, RUNNING = TrialStatus.DONE, TrialStatus.FAILED, TrialStatus.RUNNING


def view_of(outcomes, tuner="default"):
    """Trials of (objective, performance, excess), "failed" or "running"; a study that is not about a battery."""
    trials = [
        Trial(n, (0.1 * n,), TrialStatus(o))
        if isinstance(o, str)
        else Trial(n, (0.1 * n,), DONE, Score(o[0], o[1], {"speed": o[2]}, {"speed": 0.5}))
        for n, o in enumerate(outcomes)
    ]
    result = measured_result(trials, by_performance=tuner == "ei")
    return StudyView("nowhere", "toy", tuner, ParameterSpace((Parameter("x", 0.0, 1.0, 0.0),)), tuple(trials), None, result)


def test_excesses_of_different_units_are_compared_in_tolerances():
    """0.5 V over with 1 K to spare is far worse than 1.5 mV over and 0.6 K over, which as plain numbers are more."""
    tolerance = {"voltage_max_V": 0.001, "temperature_max_K": 0.5}
    excesses = [(0.5, -1.0), (0.0025, 0.6), (-0.01, -2.0)]
    scores = [Score(-1.0, -1.0, dict(zip(tolerance, pair, strict=True)), tolerance) for pair in excesses]
    trials = tuple(Trial(n, (0.1 * n,), DONE, score) for n, score in enumerate(scores))
    view = replace(view_of([]), trials=trials, result=measured_result(trials[:2]))
    assert view.tuned.number == 1
    assert [worst_excess(view, score) for score in scores] == pytest.approx([499.0, 1.5, -5.0])
    assert excess_unit(view)[1] == 1.0
    # In the figure each limit has an axis of its own, in its own unit.
    upper, *lowers = convergence_figure(view).axes
    assert [len(axis.lines[0].get_ydata()) + len(axis.lines[1].get_ydata()) for axis in (upper, *lowers)] == [3, 3, 3]
    assert [list(row["excesses"].values()) for row in trial_rows(view, trials)] == [list(pair) for pair in excesses]
    head = study_head(view)["excesses"]
    assert [(one["name"], one["tolerance"]) for one in head] == list(tolerance.items())
    # Voltages of one tolerance are compared as they are, and told in mV.
    volts = tuple(
        replace(
            t,
            score=replace(
                t.score, excess={"voltage_max_V": 0.002, "voltage_min_V": -0.1}, tolerance={"voltage_max_V": 0.001, "voltage_min_V": 0.001}
            ),
        )
        for t in trials
    )
    alike = replace(view, trials=volts)
    assert excess_unit(alike) == ("mV", 1e3)
    assert worst_excess(alike, volts[0].score) == 0.002


TABLE = [(-1.0, -9.0, 5.0), (-4.0, -4.0, 0.4), "failed", (-3.0, -5.0, 0.6), (-2.0, -6.0, 0.0), (-2.5, -2.5, -1.0), "running"]
NAN = np.nan


@pytest.mark.parametrize(
    ("tuner", "best"),
    [
        ("default", [NAN, 4.0, 4.0, 4.0, 2.0, 2.0, 2.0]),
        ("sobol", [NAN, 4.0, 4.0, 4.0, 2.0, 2.0, 2.0]),
        ("ei", [9.0, 4.0, 4.0, 4.0, 4.0, 2.5, 2.5]),
    ],
)
def test_incumbents(tuner, best):
    view = view_of(TABLE, tuner)
    np.testing.assert_array_equal(incumbents(view), best)
    # An objective of a program's own is shown as it is: larger is better.
    best = best if tuner == "ei" else [-value for value in best]
    (line,) = [x for x in lines(convergence_figure(view).axes[0], ORANGE) if x.get_drawstyle() == "steps-post"]
    np.testing.assert_array_equal(line.get_xdata(), range(7))
    np.testing.assert_array_equal(line.get_ydata(), best)


def test_marks_say_what_became_of_each_trial():
    figure = convergence_figure(view_of(TABLE))
    upper, lower = figure.axes
    shown = {line.get_label(): line for line in upper.lines}
    for label, marker, color, numbers, values in (
        ("within limits", "o", GREEN, [1, 4, 5], [-4.0, -2.0, -2.5]),
        ("over a limit", "^", RED, [0, 3], [-1.0, -3.0]),
        ("untuned", "s", BLUE, [0], [-1.0]),
        ("tuned", "o", ORANGE, [4], [-2.0]),
    ):
        assert shown[label].get_marker() == marker
        assert shown[label].get_color() == color
        assert list(shown[label].get_xdata()) == numbers
        assert list(shown[label].get_ydata()) == values
    below = {line.get_label(): line for line in lower.lines}
    assert list(below["within limits"].get_ydata()) == [0.4, 0.0, -1.0]
    assert list(below["over a limit"].get_ydata()) == [5.0, 0.6]
    assert list(below["limit"].get_ydata()) == [0.0, 0.0]
    assert list(below["tolerance"].get_ydata()) == [0.5, 0.5]
    assert list(shown["failed"].get_xdata()) == [2]
    assert shown["failed"].get_marker() == "x"
    assert legend(figure) == ["within limits", "over a limit", "untuned", "tuned", "failed", "best so far", "limit", "tolerance"]
    labels = [axis.get_ylabel().replace("\n", " ") for axis in (upper, lower)]
    assert [*labels, lower.get_xlabel()] == ["objective (larger is better)", "speed beyond its limit", "trial"]
    # The first and the last trial stand within the axis.
    assert upper.get_xlim()[0] < 0
    assert upper.get_xlim()[1] > 6
    assert all(axis.xaxis.get_tick_params()["labelbottom"] for axis in figure.axes)


@pytest.mark.parametrize(
    ("losses", "scale"), [([1.0, 2.0, 9.0], "linear"), ([1.0, 20.0, 3.0], "log"), ([0.0, 20.0], "linear"), ([-1.0, 20.0], "linear")]
)
def test_axis_is_logarithmic_where_that_helps(losses, scale):
    figure = convergence_figure(view_of([(-v, -v, 0.0) for v in losses], "ei"))
    assert figure.axes[0].get_yscale() == scale
    figure.canvas.draw()


def test_only_failures():
    figure = convergence_figure(view_of(["failed", "failed", "running"]))
    figure.canvas.draw()
    assert legend(figure) == ["failed", "limit"]
    assert not list(figure.axes[0].get_yticks()), "there is nothing to read off"
    assert list(figure.axes[0].lines[-1].get_xdata()) == [0, 1]


def test_failures_do_not_change_the_unit(stores):
    assert convergence_figure(read_study(stores["failed"], "charge")).axes[1].get_ylabel().replace("\n", " ") == "voltage over 4.2 V (mV)"


def test_charging_study_in_its_units(stores):
    view = read_study(stores["mixed"], "charge")
    upper, lower = convergence_figure(view).axes
    assert upper.get_ylabel() == "mean of $(z_d - z)^2$"
    assert lower.get_ylabel().replace("\n", " ") == "voltage over 4.2 V (mV)"
    (possible,) = [line for line in upper.lines if line.get_label() == "best possible"]
    assert 0 < possible.get_ydata()[0] < np.nanmin(incumbents(view))
    ring = next(line for line in lower.lines if line.get_label() == "tuned")
    (worst,) = ring.get_ydata()
    assert worst == pytest.approx(view.trials[8].score.metrics["overshoot_mV"], rel=1e-12)
    assert to_hex(ring.get_color()) == ORANGE.lower()
    (tolerance,) = [line for line in lower.lines if line.get_label() == "tolerance"]
    assert tolerance.get_ydata()[0] == pytest.approx(35.0)


def test_performance_of_the_paper(stores):
    view = read_study(stores["ei"], "charge")
    upper = convergence_figure(view).axes[0]
    assert upper.get_ylabel() == "$-G$"
    ring = next(line for line in upper.lines if line.get_label().startswith("tuned"))
    assert list(ring.get_ydata()) == [min(-t.score.performance for t in view.trials)]


def test_no_feasible_trial_leaves_no_incumbent(stores):
    view = read_study(stores["violating"], "charge")
    figure = convergence_figure(view)
    assert np.isnan(incumbents(view)).all()
    assert legend(figure) == ["over a limit", "untuned", "tuned, over a limit", "best possible", "limit", "tolerance"]


def test_tolerances_that_differ_have_no_common_line():
    view = view_of(TABLE)
    score = replace(view.trials[0].score, tolerance={"speed": 0.1})
    figure = convergence_figure(replace(view, trials=(replace(view.trials[0], score=score), *view.trials[1:])))
    assert "tolerance" not in legend(figure)


def test_where_each_trial_has_a_condition_of_its_own_none_is_the_best_so_far(stores):
    """A charge that began fuller took less time, whatever theta was."""
    mixed = read_study(stores["mixed"], "charge")
    assert np.isfinite(incumbents(mixed)).any()
    other = replace(mixed, record=replace(mixed.record, identity={**mixed.record.identity, "tuner": {"type": "RangeTwinTuner"}}))
    assert not other.comparable
    assert np.isnan(incumbents(other)).all()
    assert not [line for line in convergence_figure(other).axes[0].lines if line.get_label() == "best so far"]
    assert [line for line in convergence_figure(mixed).axes[0].lines if line.get_label() == "best so far"]
    assert study_head(other)["objective"]["comparable"] is False
