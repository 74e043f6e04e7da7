from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from report_studies import legend, lines, segments

from chargetune.battery.cell.equivalent_circuit import ecm_model
from chargetune.battery.charging.tunables import Tunables
from chargetune.model.splines import natural_spline
from chargetune.report import read_study
from chargetune.report.figures.style import BLUE, GREEN, ORANGE
from chargetune.report.figures.tuned_curves import SOC, backoff_figure, backoff_values, resistance_figure, resistance_values, violated_soc
from charging_problems import changed


def model_resistances(cell, soc):
    """R0 and R1 of the circuit by what it does: the jump of V for 1 A, and U1 after a step that outlasts R1 C1."""
    model = ecm_model(cell, 1e6)
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.DM(model.nominal)
    step = ca.Function("step", [x, u], [model.f(x, u, p), model.h(x, u, p)])
    after = [[step([z, 0.0], current) for current in (0.0, 1.0)] for z in soc]
    r0 = [float(one[1][0] - none[1][0]) for none, one in after]
    r1 = [float(one[0][1]) for _, one in after]
    return np.array(r0), np.array(r1)


@pytest.mark.parametrize("seed", [0, 3])
def test_resistance_is_what_the_circuit_model_uses(stores, seed):
    problem = changed(read_study(stores["mixed"], "charge").problem, mismatch_seed=seed)
    cell, soc = problem.controller_cell, np.linspace(0.0, 1.0, 41)
    ratio = np.random.default_rng(seed).uniform(0.1, 6.0, 9)
    tuned = replace(cell, R0_ohm=ratio * cell.R0_ohm, R1_ohm=ratio[::-1] * cell.R1_ohm)
    r0, r1 = model_resistances(tuned, soc)
    np.testing.assert_allclose(resistance_values(cell.soc, tuned.R0_ohm, soc), r0, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(resistance_values(cell.soc, tuned.R1_ohm, soc), r1, rtol=1e-9, atol=1e-13)


def test_backoff_is_what_the_controller_uses(stores):
    backoff = read_study(stores["mixed"], "charge").problem.theta.backoff
    nodes = np.array([0.02, 0.0, 0.15, -0.2, 0.05])
    spline = [float(ca.DM(ca.evalf(natural_spline(ca.SX(z), backoff.grid, nodes)))) for z in SOC]
    np.testing.assert_allclose(backoff_values(backoff, nodes), spline, atol=1e-12)


def test_violated_soc_covers_exactly_the_violating_intervals(stores):
    view = read_study(stores["violating"], "charge")
    episode = view.episode(view.untuned)
    spans = violated_soc(view)
    soc_start, soc_end = episode.signal("soc")
    highest = np.maximum(*episode.signal("voltage_V"))
    inside = np.array([any(low <= a and b <= high for low, high in spans) for a, b in zip(soc_start, soc_end, strict=True)])
    assert spans
    assert np.array_equal(inside, highest > 4.2005)
    for figure in (backoff_figure(view), resistance_figure(view, "R1")):
        drawn = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in figure.axes[0].patches]
        np.testing.assert_allclose(drawn, 100 * np.array(spans))
    assert violated_soc(read_study(stores["failed"], "charge")) == []


def test_backoff_figure(stores):
    view = read_study(stores["mixed"], "charge")
    figure = backoff_figure(view)
    axis, beside = figure.axes
    assert (axis.get_xlabel(), axis.get_ylabel(), beside.get_ylabel()) == ("SOC (%)", "backoff $b$ (mV)", "OCV (V)")
    for trial, color in ((view.untuned, BLUE), (view.tuned, ORANGE)):
        curve, nodes = lines(axis, color)
        np.testing.assert_allclose(nodes.get_xdata(), [0, 25, 50, 75, 100])
        np.testing.assert_allclose(nodes.get_ydata(), 1e3 * np.array(trial.theta[:5]))
        np.testing.assert_allclose(np.interp(nodes.get_xdata(), *curve.get_data()), nodes.get_ydata(), atol=1e-9)
        assert nodes.get_marker() == "o"
    grey = segments(axis)
    assert len(grey) == len(view.others)
    for drawn, trial in zip(grey, view.others, strict=True):
        np.testing.assert_allclose(drawn[::50, 1], 1e3 * np.array(trial.theta[:5]), atol=1e-9)
    (ocv,) = beside.lines
    cell = view.problem.cell
    np.testing.assert_allclose(np.interp(100 * np.array(cell.ocv_soc), *ocv.get_data()), cell.ocv_V, atol=0.03)
    assert ocv.get_ydata()[0] == cell.ocv_V[0]
    assert ocv.get_ydata()[-1] == cell.ocv_V[-1]
    assert legend(figure) == ["trials", "untuned", "tuned", "OCV", "untuned over limit"]
    assert "stand-in" in figure.get_supxlabel()


@pytest.mark.parametrize(("of", "first"), [("R0", 5), ("R1", 14)])
def test_resistance_figure(stores, of, first):
    view = read_study(stores["mixed"], "charge")
    figure = resistance_figure(view, of)
    (axis,) = figure.axes
    own = 1e3 * np.array(getattr(view.problem.controller_cell, f"{of}_ohm"))
    true = 1e3 * np.array(getattr(view.problem.cell, f"{of}_ohm"))
    assert axis.get_ylabel() == f"$R_{of[1]}$ (mΩ)"
    for color, values in ((GREEN, true), (BLUE, own), (ORANGE, own * view.tuned.theta[first : first + 9])):
        curve, nodes = lines(axis, color)
        np.testing.assert_allclose(nodes.get_xdata(), np.arange(10, 100, 10))
        np.testing.assert_allclose(nodes.get_ydata(), values)
        np.testing.assert_allclose(np.interp(nodes.get_xdata(), *curve.get_data()), values, rtol=1e-3)
    assert len(segments(axis)) == len(view.others)
    assert legend(figure) == ["trials", "plant", "untuned", "tuned", "untuned over limit"]


def test_untuned_controller_needs_no_trial(stores):
    view = read_study(stores["failed"], "charge")
    for figure in (backoff_figure(view), resistance_figure(view, "R1")):
        axis = figure.axes[0]
        assert len(lines(axis, BLUE)) == 2
        assert not lines(axis, ORANGE)
        assert "tuned: none" in legend(figure)
    assert backoff_figure(view).axes[0].get_ylim() == (-260.0, 260.0), "the box of the backoff"


def test_untuned_run_shows_through_when_it_is_the_tuned_one_too(stores):
    view = read_study(stores["mixed"], "charge", trials=1)
    for figure in (backoff_figure(view), resistance_figure(view, "R0")):
        assert lines(figure.axes[0], BLUE)[0].get_linestyle() == "-"
        assert lines(figure.axes[0], ORANGE)[0].get_linestyle() == "--"
    assert backoff_figure(view).axes[0].get_ylim() == (-260.0, 260.0)


def test_a_violating_result_is_called_so(stores):
    view = read_study(stores["violating"], "charge")
    assert "tuned, over a limit" in legend(backoff_figure(view))
    assert "tuned, over a limit" in legend(resistance_figure(view, "R0"))


def test_what_is_not_tuned_is_refused(stores):
    view = read_study(stores["mixed"], "charge")
    without = replace(view, problem=replace(view.problem, theta=Tunables()))
    with pytest.raises(ValueError, match="does not tune a backoff"):
        backoff_figure(without)
    with pytest.raises(ValueError, match="does not tune R1"):
        resistance_figure(without, "R1")


def test_a_remark_is_text_and_no_formula(stores):
    view = read_study(stores["mixed"], "charge")
    cell = replace(view.problem.cell, remark=r"costs $\frac{$")
    figure = backoff_figure(replace(view, problem=changed(view.problem, cell=cell)))
    figure.canvas.draw()
    assert r"costs $\frac{$" in figure.get_supxlabel()
    silent = replace(cell, remark="")
    assert not backoff_figure(replace(view, problem=changed(view.problem, cell=silent))).get_supxlabel()
