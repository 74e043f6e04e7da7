"""Electrochemical plants: SPM, SPMe and DFN of PyBaMM, stepped with a constant current an interval.

The only module that imports pybamm, and only when a plant is made.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from chargetune.battery.plants.parameter_sets import OTHER_SETS, SETS
from chargetune.battery.validation import check_number
from chargetune.model.model import Signal
from chargetune.plants.plant import Measurement, PlantError, SetUpError
from chargetune.plants.sensors import Readout, Sensors

__all__ = ["CellState", "Electrochemical", "ElectrochemicalPlant"]

# Points in negative electrode, separator, positive electrode and the particles of each: a third of the states of PyBaMM's
# default and within 0.4 mV and 0.03 K of it in a fast charge.
COARSE = {"x_n": 10, "x_s": 6, "x_p": 10, "r_n": 10, "r_p": 10}
# Outside these a model without its voltage events computes nonsense; a limit of the charge lies well within.
VOLTAGE_RANGE_V = (1.0, 6.0)
TEMPERATURE_RANGE_K = (200.0, 400.0)
STOICHIOMETRY_RANGE = (0.0, 1.0)
CURRENT = "Current function [A]"
# What is read, and how a profile becomes one number.
OUTPUTS: tuple[tuple[str, Any], ...] = (
    ("Voltage [V]", ca.mmin),
    ("Volume-averaged cell temperature [K]", ca.mmin),
    ("Negative electrode surface potential difference at separator interface [V]", ca.mmin),
    ("Negative particle surface stoichiometry", ca.mmin),
    ("Negative particle surface stoichiometry", ca.mmax),
    ("Positive particle surface stoichiometry", ca.mmin),
    ("Positive particle surface stoichiometry", ca.mmax),
)


@dataclass(frozen=True)
class Electrochemical:
    """An electrochemical cell model with one lumped temperature, SEI growth and lithium plating, each where the parameter set has it.

    parameters
        Name of a PyBaMM parameter set (`SETS`), or path of a BPX file (``.json``), which has no side reactions.
    ambient_K, cooling_W_m2K
        Temperature of the surroundings and of the cell at its start; heat transfer coefficient over the cooling surface.
    capacity_scale
        Share of active material that is left in both electrodes: capacity and reaction surface shrink with it.
    resistance_scale
        The cell's ohmic resistance at half charge times this; the difference is a contact resistance.
    mesh
        "coarse" (10, 6, 10 points across, 10 in each particle) or PyBaMM's "default".

    Source: Marquis et al., J. Electrochem. Soc. 166 (2019) A3693 (models); O'Kane et al., PCCP 24 (2022) 7909 (default set).
    """

    model: Annotated[
        Literal["SPM", "SPMe", "DFN"], Field(description="Single-particle model, the same with electrolyte, or Doyle-Fuller-Newman.")
    ] = "DFN"
    parameters: Annotated[
        str, Field(description="Name of a parameter set of PyBaMM, or a BPX file (.json), relative to the study file.")
    ] = "OKane2022"
    ambient_K: Annotated[float, Field(description="Temperature of the surroundings and of the cell at its start, K; 230 to 350.")] = 298.15
    cooling_W_m2K: Annotated[float, Field(description="Heat transfer coefficient over the cooling surface, W/m2K; 0 to 1e4.")] = 10.0
    capacity_scale: Annotated[float, Field(description="Share of active material that is left, 1; 0.3 to 1.5.")] = 1.0
    resistance_scale: Annotated[float, Field(description="Factor on the ohmic resistance at half charge, 1; 1 to 10.")] = 1.0
    mesh: Annotated[
        Literal["coarse", "default"], Field(description="Points of the mesh: 10, 6, 10 and 10 in each particle, or PyBaMM's own.")
    ] = "coarse"

    def __post_init__(self) -> None:
        for name, allowed in (("model", ("SPM", "SPMe", "DFN")), ("mesh", ("coarse", "default"))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"electrochemical plant: {name} = {getattr(self, name)!r}, allowed is {' or '.join(allowed)}")
        if not isinstance(self.parameters, str) or not self.parameters:
            raise ValueError(f"electrochemical plant: parameters = {self.parameters!r}, allowed is the name of a set or a BPX file")
        for name, low, high, unit in (
            ("ambient_K", 230.0, 350.0, "K (was it given in degC?)"),
            ("cooling_W_m2K", 0.0, 1e4, "W/m2K"),
            ("capacity_scale", 0.3, 1.5, ""),
            ("resistance_scale", 1.0, 10.0, ""),
        ):
            check_number(f"electrochemical plant: {name}", getattr(self, name), low, high, unit)

    def plant(self, soc_start: float, sampling_time_s: float, sensors: Sensors) -> ElectrochemicalPlant:
        """A new plant at rest at this SOC."""
        return ElectrochemicalPlant(self, soc_start, sampling_time_s, sensors)

    @property
    def file(self) -> str:
        """Path of the BPX file; empty for a named set."""
        return self.parameters if Path(self.parameters).suffix.lower() == ".json" else ""

    def bpx(self) -> Any:
        """Content of the BPX file. Raises OSError, ValueError."""
        return json.loads(Path(self.file).read_bytes().decode("utf-8-sig"))

    @property
    def line(self) -> str:
        """What it is, in words."""
        shown = Path(self.file).name or self.parameters
        changed = [f"{name} {value:g}" for name in ("capacity_scale", "resistance_scale") if (value := getattr(self, name)) != 1.0]
        cooled = f"{self.ambient_K:g} K ambient, cooled with {self.cooling_W_m2K:g} W/m2K"
        return ", ".join([f"{self.model} of PyBaMM with the parameters {shown}", cooled, *changed])

    @property
    def capacity_Ah(self) -> float:
        """Charge between SOC 0 and 1, which the model's open-circuit voltages define, times ``capacity_scale``."""
        return _built(self, 0.5).capacity_Ah


@dataclass(frozen=True)
class CellState:
    """Where a plant is: PyBaMM's solution and the charge passed (Ah). Stepping from it does not change it."""

    solution: Any
    charge_Ah: float


@dataclass
class ElectrochemicalPlant:
    """`Electrochemical` as a `Plant`: input current_A, outputs voltage, SOC by charge counting, temperature, anode potential.

    SOC = soc_start + charge / capacity; the anode potential is that against lithium in the electrolyte at the
    separator, where it is smallest: below 0 V lithium plates. Start and end of an interval are just after and just
    before a jump of the current. Raises `PlantError` where PyBaMM's solver fails and where voltage, temperature or a
    surface stoichiometry leave the range in which the model means anything.
    """

    settings: Electrochemical
    soc_start: float
    sampling_time_s: float
    sensors: Sensors = field(default_factory=Sensors)
    state: CellState = field(init=False, repr=False, compare=False, default=CellState(None, 0.0))
    _readout: Readout | None = field(init=False, repr=False, compare=False, default=None)

    def __post_init__(self) -> None:
        check_number("electrochemical plant: soc_start", self.soc_start, 0.0, 1.0)
        check_number("electrochemical plant: sampling_time_s", self.sampling_time_s, 1e-3, 3600.0, "s")
        self.sensors.vectors(self.outputs)

    @property
    def inputs(self) -> tuple[Signal, ...]:
        return (Signal("current_A", "A"),)

    @property
    def outputs(self) -> tuple[Signal, ...]:
        return (Signal("voltage_V", "V"), Signal("soc"), Signal("temperature_K", "K"), Signal("anode_potential_V", "V"))

    @property
    def start(self) -> CellState:
        """At rest before the first interval."""
        return CellState(None, 0.0)

    def reset(self, seed: int) -> Measurement:
        self.state = CellState(None, 0.0)
        self._readout = Readout(self.sensors, self.outputs, np.random.default_rng(np.random.SeedSequence(seed).spawn(2)[0]))
        at_rest, _, _ = self.ahead(self.state, 0.0)
        return self._readout.read(at_rest, at_rest)

    def step(self, u: NDArray[np.float64]) -> Measurement:
        if self._readout is None:
            raise PlantError("the plant was not reset before its first step")
        start, end, self.state = self.ahead(self.state, float(u[0]))
        return self._readout.read(start, end)

    def close(self) -> None:
        """Drop the solution; nothing else is held."""
        self.state = CellState(None, 0.0)

    def ahead(self, state: CellState, current_A: float) -> tuple[NDArray[np.float64], NDArray[np.float64], CellState]:
        """(outputs at the start, outputs at the end, state) of an interval with this current from ``state``, which stays."""
        built = _built(self.settings, self.soc_start)
        solution, first, last = built.step(state.solution, self.sampling_time_s, current_A)
        charge = state.charge_Ah + current_A * self.sampling_time_s / 3600
        out = []
        for values, passed in ((first, state.charge_Ah), (last, charge)):
            _refuse_nonsense(values)
            out.append(np.array([values[0], self.soc_start + passed / built.capacity_Ah, values[1], values[2]]))
        return out[0], out[1], CellState(solution, charge)

    def __getstate__(self) -> dict[str, Any]:
        # Data only: a solution does not cross to another process, and the model is built where it arrives.
        return {**self.__dict__, "state": CellState(None, 0.0), "_readout": None}


def _refuse_nonsense(values: NDArray[np.float64]) -> None:
    for name, value, (low, high), unit in (
        ("voltage", values[0], VOLTAGE_RANGE_V, " V"),
        ("temperature", values[1], TEMPERATURE_RANGE_K, " K"),
        ("surface stoichiometry of the negative electrode", values[3], STOICHIOMETRY_RANGE, ""),
        ("surface stoichiometry of the negative electrode", values[4], STOICHIOMETRY_RANGE, ""),
        ("surface stoichiometry of the positive electrode", values[5], STOICHIOMETRY_RANGE, ""),
        ("surface stoichiometry of the positive electrode", values[6], STOICHIOMETRY_RANGE, ""),
    ):
        if not low <= value <= high:
            raise PlantError(f"the cell model left its range: {name} = {value:.4g}{unit}, allowed is [{low:g}, {high:g}]{unit}")


@dataclass(frozen=True)
class _Built:
    """A discretised model, its solver, and what is read of a state."""

    model: Any
    solver: Any
    read: ca.Function
    capacity_Ah: float

    def step(self, before: Any, seconds: float, current_A: float) -> tuple[Any, NDArray[np.float64], NDArray[np.float64]]:
        import pybamm

        # PyBaMM counts a discharge as positive.
        inputs = {CURRENT: -current_A}
        try:
            # Saving every step would make an hour quadratic in the number of intervals.
            with _signals_after():
                solution = self.solver.step(before, self.model, seconds, inputs=inputs, save=False)
                states = solution.all_ys[-1]
                ends = np.array(self.read(states[:, [0, -1]], -current_A))
        except pybamm.SolverError as error:
            raise PlantError(f"PyBaMM's solver failed at {current_A:.4g} A: {str(error).splitlines()[0]}") from error
        return solution, ends[:, 0], ends[:, 1]


@contextmanager
def _signals_after() -> Iterator[None]:
    """Signals that Python code handles wait for the end: compiled code loses what a handler raises inside of it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[tuple[int, Any]] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    own = {number: handler for number, handler in handlers.items() if callable(handler)}
    try:
        for number in own:
            signal.signal(number, lambda number, frame: waiting.append((number, frame)))
        yield
    finally:
        for number, handler in own.items():
            signal.signal(number, handler)
        for came, frame in waiting[:1]:
            own[signal.Signals(came)](came, frame)


# A search over a range of use returns to some twenty plants; each has 15 MB.
@lru_cache(maxsize=24)
def _built(settings: Electrochemical, soc_start: float) -> _Built:
    """The discretised model at rest at ``soc_start``; a second, after 2 s for the import of pybamm."""
    # PyBaMM would ask on the terminal whether it may report usage.
    os.environ.setdefault("PYBAMM_DISABLE_TELEMETRY", "true")
    try:
        import pybamm
    except ImportError as error:
        raise SetUpError(
            f"an electrochemical plant needs PyBaMM, which cannot be imported ({error}): pip install 'chargetune[pybamm]'"
        ) from error

    # Warnings that inputs are missing where only the initial state is computed.
    pybamm.set_logging_level("ERROR")
    try:
        return _discretised(settings, soc_start, _parameters(settings))
    except KeyError as error:
        lacking = str(error.args[0]).splitlines()[0] if error.args else ""
        raise SetUpError(f"electrochemical plant: parameters = {settings.parameters!r} lacks what this model needs: {lacking}") from error


def _discretised(settings: Electrochemical, soc_start: float, values: Any) -> _Built:
    import pybamm

    if settings.resistance_scale > 1.0:
        one_ampere = ElectrochemicalPlant(_without(settings), 0.5, 1.0)
        rest, _, _ = one_ampere.ahead(CellState(None, 0.0), 0.0)
        charged, _, _ = one_ampere.ahead(CellState(None, 0.0), 1.0)
        contact = (settings.resistance_scale - 1.0) * float(charged[0] - rest[0])
    else:
        contact = 0.0
    # Without the data of a lumped temperature (Prada2013, Ramadass2004) the cell stays at its ambient one.
    options = {"thermal": "lumped" if all(key in values for key in THERMAL) else "isothermal", "contact resistance": "true"}
    # Side reactions change a charge by microvolts and the life of a cell by years: they are there where the set knows them.
    options |= {name: kind for name, (kind, key) in SIDE_REACTIONS.items() if key in values}
    area = "Total heat transfer coefficient [W.m-2.K-1]"
    values.update(
        {
            CURRENT: "[input]",
            "Ambient temperature [K]": settings.ambient_K,
            "Initial temperature [K]": settings.ambient_K,
            area: settings.cooling_W_m2K,
            "Contact resistance [Ohm]": contact,
            **{key: settings.capacity_scale * values[key] for key in _ACTIVE},
        },
        check_already_exists=False,
    )
    model = {"SPM": pybamm.lithium_ion.SPM, "SPMe": pybamm.lithium_ion.SPMe, "DFN": pybamm.lithium_ion.DFN}[settings.model](options)
    # With its voltage events the model stays at the limit for ever and says nothing.
    model.events = [event for event in model.events if "voltage" not in event.name.lower()]
    simulation = pybamm.Simulation(
        model,
        parameter_values=values,
        solver=pybamm.IDAKLUSolver(rtol=1e-4, atol=1e-6),
        var_pts=COARSE if settings.mesh == "coarse" else None,
    )
    simulation.build(initial_soc=soc_start, inputs={CURRENT: 0.0})
    built = simulation.built_model
    empty, full, *_ = pybamm.lithium_ion.get_min_max_stoichiometries(values)
    inventory = values.evaluate(pybamm.LithiumIonParameters().n.Q_init)
    return _Built(built, simulation.solver, _reader(built), float(inventory * (full - empty)))


# Option of PyBaMM, its kind, and the parameter without which that kind cannot be.
SIDE_REACTIONS = {
    "SEI": ("solvent-diffusion limited", "SEI solvent diffusivity [m2.s-1]"),
    "lithium plating": ("partially reversible", "Exchange-current density for stripping [A.m-2]"),
}
THERMAL = ("Negative current collector thickness [m]", "Cell volume [m3]", "Cell cooling surface area [m2]")
_ACTIVE = tuple(f"{side} electrode active material volume fraction" for side in ("Negative", "Positive"))


def _without(settings: Electrochemical) -> Electrochemical:
    return replace(settings, resistance_scale=1.0)


def _parameters(settings: Electrochemical) -> Any:
    """A fresh set of parameter values. Raises SetUpError for an unknown name, and for a file that is missing or is none."""
    import pybamm

    if settings.file:
        try:
            content = settings.bpx()
        except FileNotFoundError as error:
            raise SetUpError(f"electrochemical plant: parameters = {settings.parameters!r}: there is no such file") from error
        except (OSError, ValueError) as error:
            raise SetUpError(f"electrochemical plant: {settings.parameters} is no BPX file: {error}") from error
        try:
            with warnings.catch_warnings():
                # That the file's cut-off voltages stand for the OCV at SOC 0 and 1 where it has none of these, as docs/cells.md says.
                warnings.filterwarnings("ignore", message=".*not found in BPX file", category=UserWarning)
                return pybamm.ParameterValues.create_from_bpx_obj(content)
        except Exception as error:
            # Its parser raises what pydantic, json and pybamm raise.
            raise SetUpError(f"electrochemical plant: {Path(settings.parameters).name} is no BPX file: {error}") from error
    name = settings.parameters
    why = f" ({OTHER_SETS[name]})" if name in OTHER_SETS else ""
    # A set that PyBaMM got later may run too; its absence from the list is no reason to refuse it.
    if why or name not in list(pybamm.parameter_sets):
        near = next((known for known in SETS if known.lower() == name.lower()), next(iter(get_close_matches(name, SETS, 1)), None))
        why = why or (f" (did you mean {near!r}?)" if near else "")
        raise SetUpError(f"electrochemical plant: parameters = {name!r}{why}, allowed are a BPX file (.json) and {', '.join(SETS)}")
    return pybamm.ParameterValues(name)


def _reader(built: Any) -> ca.Function:
    """(states (n, 2), current) -> `OUTPUTS` (7, 2), as one CasADi function: many times quicker than reading them one by one."""
    time, state, current = ca.MX.sym("t"), ca.MX.sym("y", built.len_rhs_and_alg), ca.MX.sym("I")
    values = [reduce(built.get_processed_variable(name).to_casadi(time, state, inputs={CURRENT: current})) for name, reduce in OUTPUTS]
    one = ca.Function("read", [state, current], [ca.vertcat(*values)])
    return one.map(2)
