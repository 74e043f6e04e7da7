"""The fit of a circuit to one set of pulses: R0, one or two R-C pairs and the level before them, with uncertainties."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from chargetune.battery.cell.cell import RESISTANCE_MAX_V
from chargetune.battery.identification.pulses import PulseSet, rest_level
from chargetune.battery.identification.record import JUMP_SHARE, Record
from chargetune.battery.identification.spikes import spikes

__all__ = ["PulseFit", "fit_set"]

# Time constants that pulses of some ten seconds can tell, s: the first pair, and both where there are two.
TIME_CONSTANTS_S = {1: ((0.5, 400.0),), 2: ((0.5, 30.0), (15.0, 1000.0))}
# Least and largest voltage of a resistance at 1C.
RESISTANCES_V = (1e-6, RESISTANCE_MAX_V)
# A standard deviation of more than this share says that the data do not hold the parameter.
SPREAD_MAX = 1.0
GRID = 12
# A level that is off the rest by more than this, mV, or this share of the largest overpotential, is none.
OFFSET_MAX_MV, OFFSET_MAX_SHARE = 20.0, 0.5
# Nearer to a bound than this, in logarithm, the bound and not the data gave the value.
AT_BOUND = 0.01
# A level off the rest by more than so many sd of its noise, and by more than this, mV, is not that of the OCV.
LEVEL_SD, LEVEL_TOLD_MV = 5.0, 2.0
# A sample is a spike if it is off by so many sd of the noise, and at least so many mV.
SPIKE_SD, SPIKE_MIN_MV = 10.0, 5.0
# One sample that makes more than this share of the sum of squares is no misfit of the circuit; of one set at most so many.
LEFT_OUT_SHARE, LEFT_OUT_MAX = 0.1, 3


@dataclass(frozen=True)
class PulseFit:
    """One set of pulses: SOC in its middle, OCV before it (V), parameters and their standard deviations by name, rms (V).

    The standard deviations come from the Jacobian at the solution, s^2 (J'J)^-1 with s^2 the sum of squared residuals over
    the degrees of freedom: they hold for independent noise, so they are too small where the circuit itself does not fit.
    ``sd`` also has that of ``ocv_V``. ``number`` counts the sets in the order of the file. ``left_out`` are the samples that
    the fit does without; ``level_off_V`` is by how much the circuit's level differs from the rest, where that is more than noise (else 0).
    """

    soc: float
    ocv_V: float
    values: dict[str, float]
    sd: dict[str, float]
    rms_V: float
    time_s: NDArray[np.float64]
    measured_V: NDArray[np.float64]
    fitted_V: NDArray[np.float64]
    number: int = 0
    left_out: tuple[int, ...] = ()
    level_off_V: float = 0.0

    @property
    def place(self) -> str:
        """Its number and SOC, as remarks name it."""
        return f"set {self.number} at SOC {self.soc:.2f}"


def fit_set(record: Record, part: PulseSet, number: int, soc: NDArray[np.float64], curve: Any, rc: int, capacity_Ah: float) -> PulseFit:
    """Fit set ``number`` of a record by least squares, without single samples that are far off.

    ``soc`` is that of each sample of the record, ``curve`` the OCV (V) over it. Raises ValueError that names the parameter that the
    data do not hold, SOC and what would help.
    """
    pulses = part.of(record)
    t, current, z = pulses.time_s - pulses.time_s[0], pulses.current_A, soc[part.first : part.last]
    level, noise_mV = rest_level(record, part.first)
    noise_mV = max(noise_mV, _noise_mV(pulses.voltage_V, current))
    # What the OCV itself moves during the pulses is known; its level is measured just before them.
    overpotential = pulses.voltage_V - level - (curve(z) - curve(z[0]))
    fit = _Circuit(f"set {number} of {record.source} at SOC {z[0]:.2f}", t, current, rc, capacity_Ah)
    used = ~spikes(pulses.voltage_V, current, 1e-3 * max(SPIKE_SD * noise_mV, SPIKE_MIN_MV))
    used[0] = abs(1e3 * overpotential[0]) <= max(SPIKE_SD * noise_mV, SPIKE_MIN_MV)
    x, covariance, residuals = fit.solve(overpotential, used)
    for _ in range(LEFT_OUT_MAX):
        worst = int(np.argmax(np.abs(residuals) * used))
        if 1e3 * abs(residuals[worst]) < max(SPIKE_SD * noise_mV, SPIKE_MIN_MV):
            break
        # Beside a jump of the current only the fit without it shows that a sample is off.
        without = used & (np.arange(t.size) != worst)
        again = fit.solve(overpotential, without)
        if np.sum(again[2][without] ** 2) > LEFT_OUT_SHARE * np.sum(residuals[used] ** 2):
            break
        used, (x, covariance, residuals) = without, again
    fit.refuse(x, covariance)
    spread = np.sqrt(np.diag(covariance))
    values = dict(zip(fit.names, np.exp(x[:-1]).tolist(), strict=True))
    sd = {label: values[label] * float(s) for label, s in zip(fit.names, spread, strict=False)}
    # What a circuit cannot follow moves its level; the rest that was measured is the OCV then.
    off = 1e-3 * float(x[-1]) if abs(x[-1]) > max(LEVEL_SD * noise_mV, LEVEL_TOLD_MV) else 0.0
    sd["ocv_V"] = 1e-3 * (noise_mV if off else float(spread[-1]))
    for k in range(1, rc + 1):
        r, tau = fit.names.index(f"R{k}_ohm"), fit.names.index(f"tau{k}_s")
        values[f"C{k}_F"] = values[f"tau{k}_s"] / values[f"R{k}_ohm"]
        sd[f"C{k}_F"] = values[f"C{k}_F"] * float(np.sqrt(covariance[r, r] + covariance[tau, tau] - 2 * covariance[r, tau]))
    return PulseFit(
        soc=float(np.clip(np.mean(z), 0.0, 1.0)),
        ocv_V=float(level if off else level + 1e-3 * x[-1]),
        values=values,
        sd=sd,
        rms_V=float(np.sqrt(np.mean(residuals[used] ** 2))),
        time_s=t,
        measured_V=pulses.voltage_V,
        fitted_V=pulses.voltage_V + residuals,
        number=number,
        left_out=tuple(np.flatnonzero(~used).tolist()),
        level_off_V=off,
    )


@dataclass(frozen=True)
class _Circuit:
    """R0 and R-C pairs at given times and currents; unknowns are logarithms, and the offset of the level in mV (all of one size)."""

    place: str
    t: NDArray[np.float64]
    current: NDArray[np.float64]
    rc: int
    capacity_Ah: float

    @property
    def names(self) -> list[str]:
        return ["R0_ohm", *(name for k in range(1, self.rc + 1) for name in (f"R{k}_ohm", f"tau{k}_s"))]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        resistance = (RESISTANCES_V[0] / self.capacity_Ah, RESISTANCES_V[1] / self.capacity_Ah)
        return [resistance, *(pair for taus in TIME_CONSTANTS_S[self.rc] for pair in (resistance, taus))]

    def voltage(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        r0, *pairs = np.exp(x[:-1])
        slow = sum(r * _response(self.t, self.current, tau) for r, tau in zip(pairs[::2], pairs[1::2], strict=True))
        return np.asarray(1e-3 * x[-1] + r0 * self.current + slow, dtype=np.float64)

    def solve(
        self, overpotential: NDArray[np.float64], used: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(unknowns with the offset last, their covariance, residuals of all samples)."""
        start = np.append(_start(self.t, self.current, overpotential, used, TIME_CONSTANTS_S[self.rc]), 0.0)
        offset = max(OFFSET_MAX_MV, 1e3 * OFFSET_MAX_SHARE * float(np.max(np.abs(overpotential[used]))))
        lower, upper = (np.append(np.log([pair[end] for pair in self.bounds]), offset * (2 * end - 1)) for end in (0, 1))
        found = least_squares(
            lambda x: (self.voltage(x) - overpotential)[used],
            np.clip(start, lower + 1e-6, upper - 1e-6),
            bounds=(lower, upper),
            x_scale=1.0,
        )
        if offset - abs(found.x[-1]) < 1e-3 * offset:
            raise ValueError(
                f"{self.place}: the data do not hold the level before the pulses; its fit ends {found.x[-1]:.3g} mV off the rest, allowed "
                f"are {offset:.3g} mV; a longer rest{' or --rc 2' if self.rc == 1 else ''} would"
            )
        return found.x, _covariance(found.jac, found.fun), self.voltage(found.x) - overpotential

    def refuse(self, x: NDArray[np.float64], covariance: NDArray[np.float64]) -> None:
        """Raise ValueError where the data do not hold a parameter."""
        spread = np.sqrt(np.diag(covariance))
        for i, (label, (least, most)) in enumerate(zip(self.names, self.bounds, strict=True)):
            fewer = " or --rc 1" if self.rc == 2 else ""
            low, high = x[i] - np.log(least) < AT_BOUND, np.log(most) - x[i] < AT_BOUND
            if low or high:
                # A resistance without bound is an OCV that is not what the rests say, as beside a knee.
                help_ = "an OCV from a slow charge and discharge (--ocv)" if label[0] == "R" else "longer pulses"
                unit = label.rpartition("_")[2]
                raise ValueError(
                    f"{self.place}: the data do not hold {label}; its fit ends at {np.exp(x[i]):.3g} {unit}, allowed is "
                    f"{least:.3g} to {most:.3g} {unit}; {'faster sampling' if low else help_}{fewer} would"
                )
            if not spread[i] <= SPREAD_MAX:
                raise ValueError(
                    f"{self.place}: the data do not hold {label} (standard deviation {100 * spread[i]:.0f} % of it); "
                    f"longer pulses, faster sampling or {'--rc 1' if self.rc == 2 else 'larger currents'} would"
                )


def _noise_mV(voltage: NDArray[np.float64], current: NDArray[np.float64]) -> float:
    """Robust sd of the noise under a steady current, from second differences: of white noise they have six times its variance."""
    steady = np.abs(np.diff(current)) <= JUMP_SHARE * np.max(np.abs(current))
    second = np.diff(voltage, 2)[steady[1:] & steady[:-1]]
    return 1e3 * 1.4826 * float(np.median(np.abs(second))) / 6**0.5 if second.size else 0.0


def _response(t: NDArray[np.float64], current: NDArray[np.float64], tau: float) -> NDArray[np.float64]:
    """Voltage of an R-C pair with R = 1 ohm, from rest; each sample's current flowed since the sample before. Shape (n,)."""
    out = np.zeros(t.size)
    decay = np.exp(-np.diff(t) / tau)
    for k in range(1, t.size):
        out[k] = out[k - 1] * decay[k - 1] + (1 - decay[k - 1]) * current[k]
    return out


def _covariance(jacobian: NDArray[np.float64], residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """s^2 (J'J)^-1, very large (not infinite) along what the data do not hold. Shape (p, p)."""
    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=False)
    scaled = directions / np.maximum(sizes, 1e-12)[:, None]
    freedom = max(residuals.size - jacobian.shape[1], 1)
    return np.asarray(scaled.T @ scaled * (np.sum(residuals**2) / freedom), dtype=np.float64)


def _start(
    t: NDArray[np.float64],
    current: NDArray[np.float64],
    overpotential: NDArray[np.float64],
    used: NDArray[np.bool_],
    ranges: tuple[tuple[float, float], ...],
) -> NDArray[np.float64]:
    """Logarithms of R0, R1, tau1, ..: the best of a grid of time constants, resistances by non-negative least squares."""
    grids = [np.geomspace(low * 1.05, high / 1.05, GRID) for low, high in ranges]
    best, error = np.zeros(0), np.inf
    responses = [[_response(t, current, tau) for tau in grid] for grid in grids]
    for choice in np.ndindex(*(GRID,) * len(grids)):
        columns = np.column_stack([current, *(responses[k][i] for k, i in enumerate(choice))])
        resistances, residual = nnls(columns[used], overpotential[used])
        if residual < error:
            error = residual
            pairs = [value for k, i in enumerate(choice) for value in (max(resistances[k + 1], 1e-6), grids[k][i])]
            best = np.log([max(resistances[0], 1e-6), *pairs])
    return best
