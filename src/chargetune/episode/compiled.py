"""The whole episode of a simulated plant as one CasADi function: compiled where there is a C compiler.

The function maps run-time values only (theta, parameters, start, noise) to the trajectory, so a study of any number of
thetas, seeds and mismatches builds it once. It gives the same trajectory as `run_episode`.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.control_step import control_step, problem_of
from chargetune.control.controller import Controller
from chargetune.control.first_guess import first_memory
from chargetune.control.qp import QPSolver, daqp, daqp_warm, warm_sources
from chargetune.episode.episode import Ending, Episode, Trip, ending_at, tripped
from chargetune.episode.lookup_table import LookupTable
from chargetune.episode.stepwise import check_run, run_episode, signal_indices
from chargetune.model.given import Given, actual, checked_given, windows
from chargetune.plants.simulated import SimulatedPlant, disturbances
from chargetune.runtime.cache import cached
from chargetune.runtime.compiler import compile_library, compiler_flags, find_compiler
from chargetune.runtime.counted import counted
from chargetune.runtime.numpy_call import numpy_call
from chargetune.runtime.split import split
from chargetune.runtime.threads import parallel_map

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
    lookup_table: LookupTable | None = None

    @property
    def widths(self) -> tuple[int, ...]:
        """Columns of the recorded matrix: state, input, true and measured outputs at both ends, estimate, (status, kkt, iterations)."""
        nx, nu, ny = len(self.plant.model.states), len(self.plant.inputs), len(self.plant.outputs)
        return nx, nu, ny, ny, ny, ny, len(self.controller.model.states), 3

    def run(self, theta: ArrayLike | None = None, seed: int = 0, trips: Sequence[Trip] = (), *, given: Given | None = None) -> Episode:
        """One closed loop; the same as `run_episode` on this plant. Raises ValueError when theta, seed, trips or given do not fit."""
        fixed, unknown = self._arguments(theta, self.plant, seed, trips, self._told(given))
        (recorded,) = numpy_call(self.function, fixed, unknown)
        return self._episode(recorded, self.plant, seed, trips, unknown)

    def run_each(
        self,
        thetas: Sequence[ArrayLike | None],
        plants: Sequence[SimulatedPlant],
        seed: int | Sequence[int] = 0,
        tables: Sequence[NDArray[np.float64] | None] | None = None,
        *,
        given: Given | Sequence[Given] | None = None,
    ) -> list[Episode]:
        """An ensemble: one closed loop of each theta on the plant of the same place, on all cores of this process.

        The plants have the model of ``plant`` with other parameters, starts or sensors. The same episodes as of one after the other.
        ``seed`` and ``given`` are one for all of them, or one each.
        What each of ``tables`` (`LookupTable`) says of the true outputs is added to what is measured, and so read by the estimator.
        Raises ValueError when there are not as many of all, or one does not fit.
        """
        tables = [None] * len(plants) if tables is None else tables
        seeds = [seed] * len(plants) if isinstance(seed, int) else list(seed)
        cases = [given] * len(plants) if given is None or isinstance(given, Mapping) else list(given)
        if not len(thetas) == len(plants) == len(tables) == len(seeds) == len(cases):
            pairs = ((thetas, "theta"), (plants, "plant"), (seeds, "seed"), (tables, "table"))
            counts = ", ".join(counted(len(found), name) for found, name in pairs)
            raise ValueError(f"{counts} and {len(cases)} given, allowed are as many of each")
        for i, plant in enumerate(plants):
            if _content(plant.model.f) != _content(self.plant.model.f) or _content(plant.model.h) != _content(self.plant.model.h):
                raise ValueError(f"plants[{i}] has another model ({plant.model.name}) than these episodes ({self.plant.model.name})")
        # An ensemble has few thetas, slopes have few plants: what depends on one of them alone is computed once for each.
        of_theta: dict[tuple[bytes, int], list[NDArray[np.float64]]] = {}
        of_plant: dict[tuple[int, int, int], _OfPlant] = {}
        of_case = {id(case): self._told(case) for case in cases}
        fixed, unknown = [], []
        for theta, plant, table, own, case in zip(thetas, plants, tables, seeds, cases, strict=True):
            values, told = self.controller.theta_vector(theta), of_case[id(case)]
            key = values.tobytes(), id(case)
            if key not in of_theta:
                of_theta[key] = self._of_theta(values, told)
            drawn = id(plant), own, id(case)
            if drawn not in of_plant:
                check_run(plant, self.steps, own, ())
                of_plant[drawn] = self._of_plant(plant, own, told)
            fixed.append(self._given(of_theta[key], of_plant[drawn], table))
            unknown.append(of_plant[drawn].unknown)
        run = partial(numpy_call, self.function)
        # The loops alone go into threads, as machine code: all else waits for the interpreter.
        recorded = parallel_map(run, fixed, unknown) if self.compiled and len(plants) > 1 else list(map(run, fixed, unknown))
        return [self._episode(one, plant, own) for (one,), plant, own in zip(recorded, plants, seeds, strict=True)]

    def _arguments(
        self, theta: ArrayLike | None, plant: SimulatedPlant, seed: int, trips: Sequence[Trip], told: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What is given once an episode, shape (n,), and once an interval, shape (steps, m)."""
        check_run(plant, self.steps, seed, trips)
        of_plant = self._of_plant(plant, seed, told)
        return self._given(self._of_theta(self.controller.theta_vector(theta), told), of_plant), of_plant.unknown

    def _of_theta(self, values: NDArray[np.float64], told: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """The controller's memory at the start, and its numbers."""
        memory = first_memory(self.controller, values, told[0, : told.shape[1] - len(self.plant.given)])
        q = problem_of(self.controller).prepare(values, self.controller.setpoint, self.controller.model.nominal)
        return [memory.estimator, memory.last_input, memory.warm, np.asarray(q, dtype=float).ravel()]

    def _told(self, given: Given | None) -> NDArray[np.float64]:
        """What the controller sees of the given signals and what the plant follows, a row an interval."""
        names, read, horizon = self.controller.given_names, self.plant.given, self.controller.horizon
        values = checked_given(tuple(dict.fromkeys((*names, *read))), given, self.steps, horizon)
        seen = windows([values[name] for name in names], self.steps, horizon)
        return np.concatenate([seen, actual([values[name] for name in read], self.steps)], axis=1)

    def _of_plant(self, plant: SimulatedPlant, seed: int, told: NDArray[np.float64]) -> _OfPlant:
        errors, process = disturbances(plant, self.steps, seed)
        _, _, resolution = plant.sensors.vectors(plant.outputs)
        q = np.asarray(self.prepare_plant(plant.model.nominal), dtype=float).ravel()
        unknown = np.concatenate([errors[1:].reshape(self.steps, -1), process, told], axis=1)
        at_rest = np.concatenate([errors[0, 1], plant.rest_input, told[0, told.shape[1] - len(plant.given) :]])
        return _OfPlant(plant.start_state, np.concatenate([q, resolution]), at_rest, unknown)

    def _given(
        self, of_theta: Sequence[NDArray[np.float64]], of_plant: _OfPlant, table: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        fixed = [of_plant.start, *of_theta, of_plant.numbers]
        if self.lookup_table is not None:
            nothing = np.zeros((len(self.lookup_table.outputs), self.lookup_table.size))
            fixed.append(self.lookup_table.coefficients(nothing if table is None else table))
        elif table is not None:
            raise ValueError("a table was given, allowed is none: these episodes were built without a lookup_table")
        return np.concatenate([*fixed, of_plant.at_rest])

    def _episode(
        self,
        recorded: NDArray[np.float64],
        plant: SimulatedPlant,
        seed: int,
        trips: Sequence[Trip] = (),
        unknown: NDArray[np.float64] | None = None,
    ) -> Episode:
        controller, start_state = self.controller, plant.start_state
        state, u, true_start, true_end, start, end, estimate, facts = np.split(recorded, np.cumsum(self.widths)[:-1], axis=1)
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
            state=np.vstack([start_state, state]),
        )
        at_rest = tripped(plant, plant.following(_followed(plant, unknown)).reset(seed), trips) if trips and unknown is not None else ""
        return episode.cut(0, Ending.LIMIT, at_rest) if at_rest else _until_not_finite(episode, trips)


def _followed(plant: SimulatedPlant, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
    """The plant's own given signals, the last columns of what comes in each interval."""
    return unknown[:, unknown.shape[1] - len(plant.given) :]


class _OfPlant(NamedTuple):
    """What an episode needs of its plant.

    The state at the start, parameters and resolution, what holds at rest (sensor error, input, given signals), and what comes in each
    interval (sensor errors, noise, given signals).
    """

    start: NDArray[np.float64]
    numbers: NDArray[np.float64]
    at_rest: NDArray[np.float64]
    unknown: NDArray[np.float64]


def compiled_episode(
    controller: Controller, plant: SimulatedPlant, steps: int, *, compiled: bool | None = None, lookup_table: LookupTable | None = None
) -> CompiledEpisode:
    """The function for this controller and plant, built and compiled once a content; with ``lookup_table`` it takes tables of errors.

    ``compiled=None`` compiles when there is a C compiler, and where that fails warns and uses CasADi's virtual machine,
    which is slower and gives the same result; ``False`` uses the virtual machine; ``True`` raises RuntimeError or
    OSError when the function cannot be compiled.
    """
    check_run(plant, steps, 0, ())
    if controller.solver != "sqp":
        raise ValueError(
            f"controller: solver = {controller.solver!r}, allowed is sqp where a whole episode is one function; use run_episode"
        )
    indices = tuple(signal_indices(controller, plant))
    # A lookup_table finds the outputs by name.
    own = (
        f"{_content(plant.model.f)} {_content(plant.model.h)} {plant.model.output_names} {plant.sensors.delay_steps} {plant.given_indices}"
    )
    use = find_compiler() is not None if compiled is None else compiled
    key = f"episode {controller.structure} {own} {steps} {use and compiler_flags()} {compiled is None} {indices} {lookup_table}"

    def build() -> tuple[ca.Function, ca.Function, bool]:
        if compiled is None and not use and "CHARGETUNE_CC" not in os.environ:
            warnings.warn(
                "there is no C compiler: episodes run on the virtual machine, about 8 times slower; install gcc or clang",
                RuntimeWarning,
                stacklevel=5,
            )
        try:
            return *(_compiled if use else _built)(controller, plant, indices, steps, lookup_table), use
        except (RuntimeError, OSError) as error:
            if compiled or not use:
                raise
            warnings.warn(f"episodes run on the virtual machine, about 8 times slower: {error}", RuntimeWarning, stacklevel=5)
            return *_built(controller, plant, indices, steps, lookup_table), False

    function, prepare, used = cached(key, build)
    return CompiledEpisode(controller, plant, steps, used, function, prepare, lookup_table)


def simulate(
    controller: Controller,
    plant: SimulatedPlant,
    *,
    steps: int,
    theta: ArrayLike | None = None,
    seed: int = 0,
    trips: Sequence[Trip] = (),
    compiled: bool | None = None,
    given: Given | None = None,
) -> Episode:
    """One closed loop on a simulated plant, the quick way; ``given`` as for `run_episode`. A controller with IPOPT runs step by step."""
    if controller.solver == "ipopt":
        return run_episode(controller, plant, steps=steps, theta=theta, seed=seed, trips=trips, given=given)
    return compiled_episode(controller, plant, steps, compiled=compiled).run(theta, seed, trips, given=given)


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


def _compiled(
    controller: Controller, plant: SimulatedPlant, indices: tuple[int, ...], steps: int, lookup_table: LookupTable | None
) -> tuple[ca.Function, ca.Function]:
    """(the episode as machine code, p -> q of the plant)."""
    problem = problem_of(controller)
    episode, prepare = _built(controller, plant, indices, steps, lookup_table, daqp_warm)
    generator = ca.CodeGenerator("episode", {"with_header": False})
    generator.add(episode)
    sources, defines = warm_sources(len(controller.limits), problem.size, problem.size + len(problem.groups))
    library = compile_library("episode", (generator.dump(), *sources), defines)
    return ca.external("episode", str(library)), prepare


def _built(
    controller: Controller,
    plant: SimulatedPlant,
    indices: tuple[int, ...],
    steps: int,
    lookup_table: LookupTable | None,
    qp: QPSolver = daqp,
) -> tuple[ca.Function, ca.Function]:
    """(the episode for CasADi's virtual machine, p -> q of the plant)."""
    control = control_step(problem_of(controller), qp)
    transition, output, prepare = _plant_functions(plant)
    nx, ny, nu, delay = len(plant.model.states), len(plant.outputs), len(plant.inputs), plant.sensors.delay_steps
    told, followed = len(controller.given) * (controller.horizon + 2), len(plant.given)

    sizes = {"memory": control.size1_in(0), "u": control.size1_in(2), "warm": control.size1_in(3), "q": control.size1_in(4) - told}
    x, sent = ca.MX.sym("x", nx), ca.MX.sym("sent", ny * (delay + 1))
    memory, last, warm, q = (ca.MX.sym(n, k) for n, k in sizes.items())
    plant_q, resolution = ca.MX.sym("plant_q", prepare.size1_out(0)), ca.MX.sym("resolution", ny)
    error_start, error_end, noise = ca.MX.sym("e0", ny), ca.MX.sym("e1", ny), ca.MX.sym("w", nx)
    window, signals_now = ca.MX.sym("window", told), ca.MX.sym("given", followed)
    measure, added = _measure(ny), lookup_table.function(plant.model.output_names, plant.model.input_names) if lookup_table else None
    table = ca.MX.sym("table", added.size1_in(2) if added else 0)

    def errs(y: ca.MX, u: ca.MX, table: ca.MX) -> ca.MX:
        return added(y, u, table) if added else ca.MX.zeros(ny)

    # The oldest sample is the one that arrives.
    arriving, underway = split(sent, (ny, ny * delay))
    signals = split(arriving, [1] * ny)
    received = ca.vertcat(ca.MX(0, 1), *(signals[i] for i in indices))
    u, ahead, following, status, kkt, count, estimate = control(memory, received, last, warm, ca.vertcat(q, window) if told else q)
    after = transition(x, u, plant_q, signals_now) + noise
    before_y, after_y = output(x, u, plant_q, signals_now), output(after, u, plant_q, signals_now)
    start = measure(before_y, error_start + errs(before_y, u, table), resolution)
    end = measure(after_y, error_end + errs(after_y, u, table), resolution)
    carried, fixed = [x, memory, last, warm, sent], [q, plant_q, resolution, table]
    parts = [error_start, error_end, noise, window, signals_now]
    unknowns = ca.MX.sym("unknown", sum(part.shape[0] for part in parts))
    step = ca.Function("plain_step", [*carried, *fixed, *parts], [
        after, ahead, u, following, ca.vertcat(underway, end),
        ca.vertcat(after, u, before_y, after_y, start, end, estimate, status, kkt, count),
    ])  # fmt: skip
    of_interval = split(unknowns, [part.shape[0] for part in parts])
    step = ca.Function("step", [*carried, *fixed, unknowns], list(step(*carried, *fixed, *of_interval)))

    rest_of = [ca.MX.sym("e_rest", ny), ca.MX.sym("u_rest", nu), ca.MX.sym("given_rest", followed)]
    first = [x, memory, last, warm, q, plant_q, resolution, table, *rest_of]
    given = ca.MX.sym("given", sum(v.shape[0] for v in first))
    x0, memory0, last0, warm0, *fixed0, error, u_rest, signals_rest = split(given, [v.shape[0] for v in first])
    rest_y = output(x0, u_rest, fixed0[1], signals_rest)
    rest = measure(rest_y, error + errs(rest_y, u_rest, fixed0[3]), fixed0[2])
    unknown_matrix = ca.MX.sym("unknown", unknowns.shape[0], steps)
    *_, recorded = _repeat(step, len(carried), steps)(x0, memory0, last0, warm0, ca.repmat(rest, delay + 1, 1), *fixed0, unknown_matrix)
    return ca.Function("episode", [given, unknown_matrix], [recorded]), prepare


# A function of so many calls is still compiled in a moment.
CALLS_MAX = 20


def _repeat(step: ca.Function, carried: int, count: int) -> ca.Function:
    """``step`` count times: its first ``carried`` arguments come from its results, the last one and the last result have a column a step.

    Unlike CasADi's mapaccum this hands on what is fixed by reference, instead of a copy for each step.
    """
    if count == 1:
        return step
    block = count if count <= CALLS_MAX else max(CALLS_MAX, int(np.ceil(np.sqrt(count))))
    inner = step if block == count else _repeat(step, carried, block)
    width = 1 if block == count else block
    arguments = [ca.MX.sym("a", *step.size_in(i)) for i in range(step.n_in() - 1)]
    columns = ca.MX.sym("columns", step.size1_in(step.n_in() - 1), count)
    state, fixed, recorded = arguments[:carried], arguments[carried:], []
    edges = [*range(0, count, width), count]
    for part in ca.horzsplit(columns, edges):
        function = inner if part.shape[1] == width else _repeat(step, carried, part.shape[1])
        *state, record = function(*state, *fixed, part)
        recorded.append(record)
    return ca.Function(f"{step.name()}_{count}", [*arguments, columns], [*state, ca.horzcat(*recorded)])


def _plant_functions(plant: SimulatedPlant) -> tuple[ca.Function, ca.Function, ca.Function]:
    """((x, u, q, given) -> x+, (x, u, q, given) -> y, p -> q) with q computed once an episode."""
    model = plant.model
    x, u = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", len(model.inputs))
    p, given = ca.SX.sym("p", model.nominal.size), ca.SX.sym("given", len(plant.given))
    own = ca.SX(p)
    for i, index in enumerate(plant.given_indices):
        own[index] = given[i]
    (after, y), symbols, values = ca.extract_parametric([model.f(x, u, own), model.h(x, u, own)], p, {"extract_trivial": True})
    q = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    transition = ca.Function("transition", [x, u, q, given], [ca.cse(ca.densify(after))])
    output = ca.Function("output", [x, u, q, given], [ca.cse(ca.densify(y))])
    return transition, output, ca.Function("prepare_plant", [p], [ca.vertcat(*values) if values else ca.SX(0, 1)])


def _measure(ny: int) -> ca.Function:
    y, error, resolution = ca.SX.sym("y", ny), ca.SX.sym("e", ny), ca.SX.sym("resolution", ny)
    raw = y + error
    step = ca.if_else(resolution > 0, resolution, 1)
    return ca.Function("measure", [y, error, resolution], [ca.if_else(resolution > 0, ca.floor(raw / step + 0.5) * step, raw)])
