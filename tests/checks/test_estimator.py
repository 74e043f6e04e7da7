"""A Kalman filter whose measurements do not tell apart what it estimates is found, and one whose measurements do is not."""

import casadi as ca
import numpy as np
import pytest

from chargetune.checks.estimator import check_detectability
from chargetune.checks.nominal_loop import check_formulation, perfect_plant
from chargetune.control.controller import Controller
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import simulate
from chargetune.model.detectability import undetectable
from chargetune.model.disturbances import with_disturbances
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import ParameterSpace

pytestmark = pytest.mark.usefixtures("virtual_machine")

STEPS = 40


def tank(decay=0.8):
    return Model.build(
        "tank", states=(Signal("level", "m"),), inputs=(Signal("pump", "m"),), outputs=(Signal("gauge", "m"),),
        parameters={"gain": 1.0, "inflow": 0.0}, sampling_time_s=60.0,
        equations=lambda x, u, p: ({"level": decay * x["level"] + p["gain"] * u["pump"] + p["inflow"]}, {"gauge": x["level"]}),
    )  # fmt: skip


def found(model, *, process, measurement=0.01, told=None, **changes):
    estimator = ExtendedKalman.of(model, measurement_sd={"gauge": measurement}, process_sd=process, start_sd=dict.fromkeys(process, 0.05))
    own = Controller.build(
        model, ParameterSpace(()), horizon=5, stage_cost=lambda s: (s.x["level"] - 1.0) ** 2 + 0.1 * s.u["pump"] ** 2,
        input_lower={"pump": -1.0}, input_upper={"pump": 1.0}, estimator=estimator, **changes,
    )  # fmt: skip
    return own, [f for f in check_formulation(own, steps=STEPS, quick=True, given=told) if f.code == "observer-undetectable"]


OFFSETS = {"gauge_offset": 0.01, "pump_offset": 0.01}


def test_two_disturbances_on_one_output_are_named_with_time_and_place():
    _, (finding,) = found(with_disturbances(tank(), outputs=("gauge",), inputs=("pump",)), process={"level": 0.01, **OFFSETS})
    assert finding.severity == "warning"
    for word in ("level, gauge_offset, pump_offset cannot be told apart from gauge", "39 min", "nor in steady state at its end"):
        assert word in finding.message
    assert finding.numbers["seen_sd"] < 1e-6
    assert all(np.isfinite(value) for value in finding.numbers.values())
    (line,) = finding.evidence.lines.values()
    assert np.all(line[1] < 1e-6)


@pytest.mark.parametrize("kind", [{"outputs": ("gauge",)}, {"inputs": ("pump",)}])
def test_one_disturbance_is_fine(kind):
    model = with_disturbances(tank(), **kind)
    assert found(model, process=dict.fromkeys(model.state_names, 0.01))[1] == []


def test_what_the_filter_does_not_doubt_is_known():
    model = with_disturbances(tank(), outputs=("gauge",), inputs=("pump",))
    assert found(model, process={"level": 0.01, "gauge_offset": 0.01})[1] == []


def test_a_measurement_that_is_far_too_coarse_sees_nothing():
    own, fine = found(tank(1.0), process={"level": 1e-4}, measurement=0.1)
    assert fine == []
    _, (finding,) = found(tank(1.0), process={"level": 1e-4}, measurement=10.0)
    assert "level cannot be seen from gauge" in finding.message
    # Independently: an error e of an integrating level is in each sample as it is, so sqrt(K) e / sd.
    assert finding.numbers["seen_sd"] == pytest.approx(np.sqrt(STEPS) * finding.numbers["unknown_level"] / 10.0, rel=1e-6)
    run = simulate(own, perfect_plant(own), steps=STEPS)
    assert check_detectability(own, run) == []


def test_what_grows_for_ever_does_not_hide_what_does_not():
    """With a(x) = 1.6 x an error has grown by 1e40 in 200 intervals; offset and level are told apart by the first two samples."""
    model = with_disturbances(tank(1.6), outputs=("gauge",))
    at = np.zeros((200, 2)), np.zeros((200, 1))
    assert undetectable(model, ("gauge",), *at) == []
    both = with_disturbances(tank(1.6), outputs=("gauge",), inputs=("pump",))
    assert len(undetectable(both, ("gauge",), np.zeros((200, 3)), np.zeros((200, 1)))) == 1


def test_a_given_signal_that_moves_a_parameter_makes_it_seen():
    """A factor of the inflow is seen only where there is one, which the given signal says."""
    model = with_disturbances(tank(), parameters=("inflow",))
    changes = {"given": (Signal("rain", "m"),), "parameters": lambda s: {"inflow": s.given["rain"]}}
    process = {"level": 0.01, "inflow_log_factor": 0.01}
    assert found(model, process=process, told={"rain": 0.1}, **changes)[1] == []
    _, (finding,) = found(model, process=process, told={"rain": 0.0}, **changes)
    assert "inflow_log_factor cannot be seen" in finding.message


def test_derivatives_that_are_not_finite_are_refused_by_name():
    root = Model.build(
        "root", states=(Signal("T"),), inputs=(Signal("u"),), outputs=(Signal("T"),), parameters={"gain": 1.0}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"T": ca.sqrt(x["T"] + p["gain"] * u["u"])}, {"T": x["T"]}),
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"detectability of root: the derivatives at states .* are not finite"):
        undetectable(root, ("T",), np.zeros(1), np.zeros(1))
