"""The whole episode of a simulated plant as one CasADi function: compiled where there is a C compiler.

The function maps run-time values only (theta, parameters, start, noise) to the trajectory, so a study of any number of
thetas, seeds and mismatches builds it once. It gives the same trajectory as `run_episode`.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from chargetune.control.compiler import compile_library, find_compiler
from chargetune.control.controller import Controller
from chargetune.control.mpc import begin, cached, control_step, problem_of
from chargetune.control.qp import QPSolver, daqp, daqp_warm, warm_sources
from chargetune.episode.episode import Ending, Episode, Trip, ending_at, tripped
from chargetune.episode.stepwise import check_run, signal_indices
from chargetune.plants.simulated import SimulatedPlant, disturbances

__all__ = ["CompiledEpisode", "compiled_episode", "simulate"]


@dataclass(frozen=True)
class CompiledEpisode:
    """Episodes of ``steps`` intervals of one controller and one simulated plant."""

    controller: Controller
    plant: SimulatedPlant
    steps: int
    compiled: bool
    function: ca.Function
    prepare_plant: ca.Function

    def run(self, theta: ArrayLike | None = None, seed: int = 0, trips: Sequence[Trip] = ()) -> Episode:
        """One closed loop; the same as `run_episode` on this plant. Raises ValueError when theta, seed or trips do not fit."""
        controller, plant = self.controller, self.plant
        values = controller.theta_vector(theta)
        check_run(plant, self.steps, seed, trips)
        errors, process = disturbances(plant, self.steps, seed)
        _, _, resolution = plant.sensors.vectors(plant.outputs)
        memory = begin(controller)
        q = problem_of(controller).prepare(values, ca.DM(controller.setpoint), controller.model.nominal)
        out = self.function(
            plant.start_state, memory.estimator, memory.last_input, memory.warm, q, self.prepare_plant(plant.model.nominal), resolution,
            errors[0, 1], errors[1:, 0].T, errors[1:, 1].T, process.T,
        )  # fmt: skip
        state, u, true_start, true_end, start, end, estimate, facts = (np.asarray(o.full() if hasattr(o, "full") else o).T for o in out)
        episode = Episode(
            sampling_time_s=plant.sampling_time_s,
            input_names=plant.model.input_names,
            output_names=plant.model.output_names,
            input_units=tuple(s.unit for s in plant.inputs),
            output_units=tuple(s.unit for s in plant.outputs),
            estimate_names=controller.model.state_names,
            time_s=np.arange(self.steps, dtype=np.float64) * plant.sampling_time_s,
            input=u,
            output_start=start,
            output_end=end,
            estimate=estimate,
            status=facts[:, 0].astype(np.int64),
            kkt=facts[:, 1],
            iterations=facts[:, 2].astype(np.int64),
            ending=Ending.DONE,
            true_start=true_start,
            true_end=true_end,
            state=np.vstack([plant.start_state, state]),
        )
        at_rest = tripped(plant, replace(plant).reset(seed), trips) if trips else ""
        return episode.cut(0, Ending.LIMIT, at_rest) if at_rest else _until_not_finite(episode, trips)


def compiled_episode(controller: Controller, plant: SimulatedPlant, steps: int, *, compiled: bool | None = None) -> CompiledEpisode:
    """The function for this controller and plant, built and compiled once a content.

    ``compiled=None`` compiles when there is a C compiler, and where that fails warns and uses CasADi's virtual machine,
    which is slower and gives the same result; ``False`` uses the virtual machine; ``True`` raises RuntimeError or
    OSError when the function cannot be compiled.
    """
    check_run(plant, steps, 0, ())
    indices = tuple(signal_indices(controller, plant))
    own = f"{_content(plant.model.f)} {_content(plant.model.h)} {plant.sensors.delay_steps}"
    use = find_compiler() is not None if compiled is None else compiled
    key = f"episode {controller.structure} {own} {steps} {use} {compiled is None} {indices}"

    def build() -> tuple[ca.Function, ca.Function, bool]:
        try:
            return *(_compiled if use else _built)(controller, plant, indices, steps), use
        except (RuntimeError, OSError) as error:
            if compiled or not use:
                raise
            warnings.warn(f"episodes run on the virtual machine, about 8 times slower: {error}", RuntimeWarning, stacklevel=4)
            return *_built(controller, plant, indices, steps), False

    function, prepare, used = cached(key, build)
    return CompiledEpisode(controller, plant, steps, used, function, prepare)


def simulate(
    controller: Controller,
    plant: SimulatedPlant,
    *,
    steps: int,
    theta: ArrayLike | None = None,
    seed: int = 0,
    trips: Sequence[Trip] = (),
    compiled: bool | None = None,
) -> Episode:
    """One closed loop on a simulated plant, the quick way."""
    return compiled_episode(controller, plant, steps, compiled=compiled).run(theta, seed, trips)


def _until_not_finite(episode: Episode, trips: Sequence[Trip]) -> Episode:
    state = episode.arrays()["state"]
    lost = ~np.all(np.isfinite(state[1:]), axis=1)
    if lost.any():
        # Step by step the plant refuses this interval, so it is not part of the episode.
        at = int(np.argmax(lost))
        message = f"the plant's state is not finite after step {at}: {state[at + 1].tolist()}"
        before = ending_at(episode.cut(at, Ending.DONE, ""), trips)
        return before if before.ending is not Ending.DONE else episode.cut(at, Ending.PLANT, message)
    return ending_at(episode, trips)


@lru_cache(maxsize=64)
def _content(function: ca.Function) -> str:
    # Serialising takes a quarter of the time of an episode, and a study has one and the same model all along.
    return hashlib.sha256(function.serialize().encode()).hexdigest()


def _compiled(controller: Controller, plant: SimulatedPlant, indices: tuple[int, ...], steps: int) -> tuple[ca.Function, ca.Function]:
    """(the episode as machine code, p -> q of the plant)."""
    problem = problem_of(controller)
    episode, prepare = _built(controller, plant, indices, steps, daqp_warm)
    generator = ca.CodeGenerator("episode", {"with_header": False})
    generator.add(episode)
    sources, defines = warm_sources(problem.variables, len(problem.groups))
    library = compile_library("episode", (generator.dump(), *sources), defines)
    return ca.external("episode", str(library)), prepare


def _built(
    controller: Controller, plant: SimulatedPlant, indices: tuple[int, ...], steps: int, qp: QPSolver = daqp
) -> tuple[ca.Function, ca.Function]:
    """(the episode for CasADi's virtual machine, p -> q of the plant)."""
    control = control_step(problem_of(controller), qp)
    transition, output, prepare = _plant_functions(plant)
    nx, ny, delay = len(plant.model.states), len(plant.outputs), plant.sensors.delay_steps

    sizes = {"memory": control.size1_in(0), "u": control.size1_in(2), "warm": control.size1_in(3), "q": control.size1_in(4)}
    x, sent = ca.MX.sym("x", nx), ca.MX.sym("sent", ny * (delay + 1))
    memory, last, warm, q = (ca.MX.sym(n, k) for n, k in sizes.items())
    plant_q, resolution = ca.MX.sym("plant_q", prepare.size1_out(0)), ca.MX.sym("resolution", ny)
    error_start, error_end, noise = ca.MX.sym("e0", ny), ca.MX.sym("e1", ny), ca.MX.sym("w", nx)
    measure = _measure(ny)

    received = sent[:ny]
    u, ahead, following, status, kkt, count, estimate = control(memory, received[list(indices)] if indices else ca.MX(0, 1), last, warm, q)
    after = transition(x, u, plant_q) + noise
    before_y, after_y = output(x, u, plant_q), output(after, u, plant_q)
    start, end = measure(before_y, error_start, resolution), measure(after_y, error_end, resolution)
    step = ca.Function(
        "step",
        [x, memory, last, warm, sent, q, plant_q, resolution, error_start, error_end, noise],
        [after, ahead, u, following, ca.vertcat(sent[ny:], end), before_y, after_y, start, end, estimate, ca.vertcat(status, kkt, count)],
    )
    loop = step.mapaccum("loop", steps, 5)
    x0, y_error = ca.MX.sym("x0", nx), ca.MX.sym("e_rest", ny)
    errors = [ca.MX.sym(n, k, steps) for n, k in (("E0", ny), ("E1", ny), ("W", nx))]
    rest = measure(output(x0, ca.DM.zeros(len(plant.inputs)), plant_q), y_error, resolution)
    fixed = [ca.repmat(v, 1, steps) for v in (q, plant_q, resolution)]
    states, _, inputs, _, _, *recorded = loop(x0, memory, last, warm, ca.repmat(rest, delay + 1, 1), *fixed, *errors)
    episode = ca.Function(
        "episode", [x0, memory, last, warm, q, plant_q, resolution, y_error, *errors], [states, inputs, *recorded], {"cse": True}
    )
    return episode, prepare


def _plant_functions(plant: SimulatedPlant) -> tuple[ca.Function, ca.Function, ca.Function]:
    """((x, u, q) -> x+, (x, u, q) -> y, p -> q) with q computed once an episode."""
    model = plant.model
    x, u = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", len(model.inputs))
    p = ca.SX.sym("p", model.nominal.size)
    (after, y), symbols, values = ca.extract_parametric([model.f(x, u, p), model.h(x, u, p)], p, {"extract_trivial": True})
    q = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    transition = ca.Function("transition", [x, u, q], [ca.cse(ca.densify(after))])
    output = ca.Function("output", [x, u, q], [ca.cse(ca.densify(y))])
    return transition, output, ca.Function("prepare_plant", [p], [ca.vertcat(*values) if values else ca.SX(0, 1)])


def _measure(ny: int) -> ca.Function:
    y, error, resolution = ca.SX.sym("y", ny), ca.SX.sym("e", ny), ca.SX.sym("resolution", ny)
    raw = y + error
    step = ca.if_else(resolution > 0, resolution, 1)
    return ca.Function("measure", [y, error, resolution], [ca.if_else(resolution > 0, ca.floor(raw / step + 0.5) * step, raw)])
