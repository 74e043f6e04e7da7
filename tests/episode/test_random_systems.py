"""Any small linear system: the whole episode, step by step and by IPOPT, is one and the same closed loop."""

from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import ExactState, Propagated
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import simulate
from chargetune.episode.episode import Ending
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

STEPS = 6


class Drawn(NamedTuple):
    """The sizes of a system; its numbers come from ``seed``. ``rows`` are those of all limits, each of one or two."""

    states: int
    inputs: int
    outputs: int
    horizon: int
    rows: int
    delay: int
    noisy: bool
    estimator: str
    seed: int


DRAWN = st.builds(
    Drawn,
    states=st.integers(1, 3),
    inputs=st.integers(1, 2),
    outputs=st.integers(1, 3),
    horizon=st.integers(1, 3),
    rows=st.integers(0, 3),
    delay=st.integers(0, 2),
    noisy=st.booleans(),
    estimator=st.sampled_from(["exact", "filter", "partly"]),
    seed=st.integers(0, 2**32 - 1),
)
SMALLEST = Drawn(1, 1, 1, 1, 1, 0, noisy=False, estimator="exact", seed=0)
LARGEST = Drawn(3, 2, 3, 3, 3, 2, noisy=True, estimator="filter", seed=1)
# Where no noise is, IPOPT has its say; compiled are few, because each costs seconds of the C compiler.
COMPILED = (
    SMALLEST,
    Drawn(2, 1, 1, 3, 2, 0, noisy=True, estimator="filter", seed=2),
    Drawn(2, 2, 2, 2, 3, 1, noisy=False, estimator="partly", seed=3),
    Drawn(3, 1, 3, 1, 0, 2, noisy=True, estimator="exact", seed=4),
)


def system(drawn: Drawn) -> tuple[Controller, SimulatedPlant]:
    """x+ = A x + B u, y = C x + D u, l = |x - x_d|^2 + r |u|^2 with theta in it; the plant's A differs."""
    rng = np.random.default_rng(drawn.seed)
    ny, nu = drawn.outputs, drawn.inputs
    nx = min(drawn.states, ny) if drawn.estimator == "exact" else drawn.states
    states = tuple(Signal(f"x{i}") for i in range(nx))
    inputs = tuple(Signal(f"u{i}") for i in range(nu))
    a, b = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    a *= rng.uniform(0.5, 1.1) / np.max(np.abs(np.linalg.eigvals(a)))
    c, d = rng.normal(size=(ny, nx)), 0.3 * rng.normal(size=(ny, nu)) * rng.integers(0, 2, size=(ny, 1))
    # The first outputs are states, by name, as far as the estimator reads them.
    read = {"exact": nx, "partly": min(nx, ny, 1 + int(rng.integers(0, 2))), "filter": 0}[drawn.estimator]
    c[:read], d[:read] = np.eye(ny, nx)[:read], 0.0
    outputs = (*states[:read], *(Signal(f"y{i}") for i in range(read, ny)))

    def equations(x, u, p):
        after = ca.mtimes(ca.reshape(p["a"], nx, nx), x.vector) + ca.mtimes(ca.reshape(p["b"], nx, nu), u.vector)
        seen = ca.mtimes(ca.DM(c), x.vector) + ca.mtimes(ca.DM(d), u.vector)
        return (
            {s.name: after[i] for i, s in enumerate(states)},
            {s.name: seen[i] for i, s in enumerate(outputs)},
        )

    numbers = {"a": a.ravel(order="F"), "b": b.ravel(order="F")}
    model = Model.build(
        "drawn", states=states, inputs=inputs, outputs=outputs, parameters=numbers, sampling_time_s=1.0, equations=equations
    )
    estimator = {
        "exact": ExactState(),
        "partly": Propagated(tuple(s.name for s in states[:read])),
        "filter": ExtendedKalman(tuple(s.name for s in outputs), (0.1,) * ny, (0.05,) * nx, (0.2,) * nx),
    }[drawn.estimator]
    price = rng.uniform(0.1, 1.0)
    goal = {s.name: float(v) for s, v in zip(states, rng.uniform(-2.0, 2.0, nx), strict=True)}

    def away(s):
        return ca.sumsqr(s.x.vector - s.x_d.vector)

    controller = Controller.build(
        model,
        ParameterSpace((Parameter("weight", 0.1, 10.0, 1.0, scale="log"),)),
        horizon=drawn.horizon,
        stage_cost=lambda s: s.theta["weight"] * away(s) + price * ca.sumsqr(s.u.vector),
        terminal_cost=away,
        input_lower={s.name: -1.0 for s in inputs},
        input_upper={s.name: float(rng.uniform(0.5, 1.5)) for s in inputs},
        limits=limits(drawn.rows, [s.name for s in states], [s.name for s in outputs], rng),
        fallback={s.name: 0.0 for s in inputs},
        setpoint=goal,
        estimator=estimator,
    )
    start = {s.name: float(v) for s, v in zip(states, rng.normal(0.0, 1.0, nx), strict=True)}
    noise = {s.name: 0.05 for s in outputs} if drawn.noisy else {}
    plant = SimulatedPlant(
        model.with_parameters(a=numbers["a"] * rng.uniform(0.8, 1.1, nx * nx)),
        start,
        sensors=Sensors(noise, delay_steps=drawn.delay),
        process_noise_sd={states[0].name: 0.05} if drawn.noisy else {},
    )
    return controller, plant


def limits(rows: int, states: list[str], outputs: list[str], rng: np.random.Generator) -> list[SoftLimit]:
    """Limits of so many rows at any place of an interval; most closed loops meet one, and some cannot keep it."""
    out: list[SoftLimit] = []
    while rows:
        sides = int(rng.integers(1, min(rows, 2) + 1))
        at = str(rng.choice(["start", "end", "both", "terminal"]))
        name = str(rng.choice(states if at == "terminal" else [*states, *outputs]))
        upper = float(rng.uniform(-0.3, 0.4))
        lower = upper - float(rng.uniform(0.3, 0.8))
        bounds = {"lower": lower, "upper": upper} if sides == 2 else [{"lower": lower}, {"upper": upper}][int(rng.integers(2))]
        out.append(SoftLimit(name, **bounds, at=at, penalty=100.0, scale=0.1))
        rows -= sides
    return out


def closed_loops(drawn: Drawn, *, compiled: bool):
    """(whole, step by step, by IPOPT or None)."""
    controller, plant = system(drawn)
    theta = [2.0]
    whole = simulate(controller, plant, steps=STEPS, theta=theta, seed=drawn.seed, compiled=compiled)
    single = run_episode(controller, plant, steps=STEPS, theta=theta, seed=drawn.seed)
    by_ipopt = None if drawn.noisy else run_episode(controller, plant, steps=STEPS, theta=theta, seed=drawn.seed, control=ipopt_act)
    assert (whole.ending, whole.failures, len(whole)) == (Ending.DONE, 0, STEPS)
    return whole, single, by_ipopt


@given(drawn=DRAWN)
@example(drawn=SMALLEST)
@example(drawn=LARGEST)
@settings(max_examples=30)
def test_virtual_machine(drawn, same):
    """The same functions called one by one: only the plant's sums are taken in another order."""
    whole, single, by_ipopt = closed_loops(drawn, compiled=False)
    same(whole, single, 1e-9)
    if by_ipopt is not None:
        same(whole, by_ipopt, 1e-5)


@pytest.mark.compiled_code
@pytest.mark.parametrize("drawn", COMPILED)
def test_compiled(drawn, same):
    """Another start of the QP solver and fused multiplications: each within the solver's tolerance of 1e-9, which the loop adds up."""
    whole, single, by_ipopt = closed_loops(drawn, compiled=True)
    same(whole, single, 1e-7)
    if by_ipopt is not None:
        same(whole, by_ipopt, 1e-5)
