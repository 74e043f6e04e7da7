"""Steps that are not solved and costs that are not convex are told; and a controller with given signals is checked under them."""

import casadi as ca
import numpy as np
import pytest

from chargetune.checks.nominal_loop import check_formulation, check_limits, perfect_plant
from chargetune.checks.solves import check_costs, check_solves
from chargetune.control.controller import Controller, SoftLimit
from chargetune.episode.compiled import simulate
from chargetune.episode.score_limits import ScoredLimit, score_limits
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace

pytestmark = pytest.mark.usefixtures("virtual_machine")

SPACE = ParameterSpace((Parameter("weight", 0.01, 1.0, 0.1),))
STEPS = 12
TOLD = {"ambient": 5.0 + 3.0 * np.cos(0.5 * np.arange(STEPS)), "least": np.where(np.arange(STEPS) < 6, 18.0, 20.0)}


@pytest.fixture(scope="module")
def room():
    return Model.build(
        "room",
        states=(Signal("T", "degC"),),
        inputs=(Signal("heat", "K"),),
        outputs=(Signal("T", "degC"),),
        parameters={"ambient": 0.0},
        sampling_time_s=3600.0,
        equations=lambda x, u, p: ({"T": x["T"] + (p["ambient"] - x["T"]) / 20 + u["heat"]}, {"T": x["T"]}),
    )


@pytest.fixture(scope="module")
def heating(room):
    def build(**changes):
        settings = {
            "horizon": 6,
            "stage_cost": lambda s: s.theta["weight"] * s.u["heat"] ** 2,
            "input_lower": {"heat": 0.0},
            "input_upper": {"heat": 2.0},
            "limits": [SoftLimit("T", lower=lambda s: s.given["least"], at="end", penalty=50.0, scale=0.1)],
            "parameters": lambda s: {"ambient": s.given["ambient"]},
            "start": {"T": 18.5},
            "given": (Signal("ambient", "degC"), Signal("least", "degC")),
            **changes,
        }
        return Controller.build(room, SPACE, **settings)

    return build


def test_steps_not_solved_are_counted_and_told(heating):
    # One iteration of a problem with a limit that becomes active is not enough everywhere.
    one = heating(
        iterations_max=1, stage_cost=lambda s: s.theta["weight"] * s.u["heat"] ** 4 + (s.x["T"] - 19) ** 4 + 0.01 * s.u["heat"] ** 2
    )
    run = simulate(one, perfect_plant(one), steps=STEPS, given=TOLD, compiled=False)
    assert run.failures > 0
    assert run.unsolved_share == run.failures / STEPS
    (found,) = check_solves(run)
    assert (found.code, found.numbers["share"]) == ("steps-not-solved", run.unsolved_share)
    assert f"({run.failures} of {STEPS})" in found.message
    assert "steps-not-solved" in [f.code for f in check_formulation(one, steps=STEPS, given=TOLD, quick=True)]
    score = score_limits(run, [ScoredLimit("T", upper=30.0)], objective=lambda e: 0.0).score
    assert score.metrics["unsolved_percent"] == pytest.approx(100 * run.failures / STEPS)


def test_nothing_is_told_where_every_step_is_solved(heating):
    run = simulate(heating(), perfect_plant(heating()), steps=STEPS, given=TOLD, compiled=False)
    assert check_solves(run) == []
    assert run.unsolved_share == 0.0
    assert check_costs(heating()) == []


def test_perfect_plant_follows_the_signals(heating):
    own = heating()
    run = simulate(own, perfect_plant(own), steps=STEPS, given=TOLD, compiled=False)
    np.testing.assert_allclose(run.estimate[:, 0], run.state[:-1, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        run.state[1:, 0], run.state[:-1, 0] + (TOLD["ambient"] - run.state[:-1, 0]) / 20 + run.input[:, 0], rtol=0, atol=1e-9
    )
    assert check_limits(own, run, given=TOLD) == []
    # Under another signal than that of the run it is another limit, which the run breaks.
    assert [f.code for f in check_limits(own, run, given={**TOLD, "least": TOLD["least"] + 0.5})]


def test_formulation_with_given_signals_is_checked_under_them(heating):
    # The room's time constant is 20 h, and it is heated against the cold of 6 h.
    assert [f.code for f in check_formulation(heating(), steps=STEPS, given=TOLD, quick=True)] == ["short-horizon", "no-influence"]
    # The forecast is one of a column an interval; what is checked is the formulation.
    forecast = np.repeat(TOLD["ambient"][:, None], 7, axis=1)
    found = check_formulation(heating(), steps=STEPS, given={**TOLD, "ambient": forecast}, quick=True)
    assert [f.code for f in found] == ["short-horizon", "no-influence"]
    cold = check_formulation(heating(), steps=STEPS, given={**TOLD, "least": 25.0}, quick=True)
    assert [f.code for f in cold] == ["unsafe-start"]
    with pytest.raises(ValueError, match="given: missing"):
        check_formulation(heating(), steps=STEPS)


def test_a_cost_that_is_bent_downwards_is_told_by_name(heating):
    bent = heating(stage_cost=lambda s: -((s.x["T"] - 19) ** 2) + s.u["heat"] ** 2)
    (found,) = check_costs(bent)
    assert (found.code, found.severity) == ("non-convex", "warning")
    assert "stage_cost has curvature -2 along T" in found.message
    assert found.numbers["curvature_least"] == pytest.approx(-2.0)


def test_a_limit_that_is_no_number_is_not_kept(heating):
    """Its bound is a root of what becomes negative after half of the episode."""
    controller = heating(limits=[SoftLimit("T", lower=lambda s: ca.sqrt(s.given["least"]), at="end", penalty=50.0, scale=0.1)])
    falling = TOLD | {"least": np.linspace(1.0, -1.0, STEPS)}
    # Along a run without this limit: with it no step is solved.
    run = simulate(heating(), perfect_plant(heating()), steps=STEPS, given=TOLD)
    found = check_limits(controller, run, given=falling)
    assert [f.code for f in found] == ["limit-not-kept"]
    assert "is no number in" in found[0].message
    (first, *_) = check_formulation(controller, steps=STEPS, given=TOLD | {"least": -1.0})
    assert (first.code, "no finite number at the start" in first.message) == ("unsafe-start", True)
