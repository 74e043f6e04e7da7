"""What the numbers of a charge are called, and in which unit people read them."""

from __future__ import annotations

from dataclasses import dataclass

from chargetune.battery.charging.limits import Limit
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.verdict import judgement

__all__ = ["METRIC_WORDS", "LimitWords", "ObjectiveWords", "limit_words", "metric_words", "objective_words", "two_decimals"]

WHAT = {"voltage": "voltage", "temperature": "temperature", "anode": "anode potential"}

# Figures of merit: label and unit.
METRIC_WORDS = {
    "t80_min": ("time to 80 % SOC", "min"),
    "t90_min": ("time to 90 % SOC", "min"),
    "t95_min": ("time to 95 % SOC", "min"),
    "t99_min": ("time to 99 % SOC", "min"),
    "switch_min": ("end of constant current", "min"),
    "soc_end": ("SOC at the end", ""),
    "overshoot_mV": ("voltage over its limit, largest sample", "mV"),
    "overshoot_mVs": ("voltage over its limit, integral", "mV s"),
    "violation_mVs": ("voltage beyond tolerance, integral", "mV s"),
    "current_max_excess_A": ("current over its limit", "A"),
    "temperature_max_excess_K": ("temperature over its limit, largest sample", "K"),
    "temperature_max_excess_Ks": ("temperature over its limit, integral", "K s"),
    "anode_min_excess_mV": ("anode potential under its limit, largest sample", "mV"),
    "anode_min_excess_mVs": ("anode potential under its limit, integral", "mV s"),
    "solver_failures": ("control steps not solved to tolerance", ""),
    "unsolved_percent": ("share of control steps not solved", "%"),
    "objective_worst": ("objective on the worst drawn plant", ""),
    "plants": ("drawn plants", ""),
    "violating_plants": ("drawn plants over a limit", ""),
}
# Endings of a metric's name that are its unit, each as it is printed.
UNITS = {
    "min": "min", "s": "s", "h": "h", "ms": "ms", "mV": "mV", "V": "V", "mVs": "mV s", "Vs": "V s", "K": "K", "Ks": "K s", "A": "A",
    "Ah": "Ah", "Wh": "Wh", "W": "W", "m": "m", "mm": "mm", "rad": "rad", "mrad": "mrad", "deg": "deg", "N": "N", "Nm": "N m", "kg": "kg",
    "Pa": "Pa", "bar": "bar", "Hz": "Hz", "percent": "%",
}  # fmt: skip


@dataclass(frozen=True)
class LimitWords:
    """How the excess of a limit is told: ``factor`` times the stored excess is in ``unit``; ``tolerance`` is in it too.

    ``short`` heads a column. ``tolerance`` is None where the trials do not agree on it. ``samples`` > 1: a moving mean of so many
    intervals is judged; ``largest`` is then the metric with the largest single sample, empty where there is none.
    """

    name: str
    label: str
    short: str
    unit: str
    factor: float
    tolerance: float | None
    samples: int = 1
    largest: str = ""

    @property
    def judged(self) -> str:
        """On what the verdict is made."""
        return f"as judged (moving mean of {self.samples})" if self.samples > 1 else "largest sample"


@dataclass(frozen=True)
class ObjectiveWords:
    """How the loss of a study is told: ``factor`` times it is in ``unit``; below 0, what is told is to be large.

    What is told and beyond ``most`` is no time: it was not reached.
    """

    label: str
    short: str
    unit: str = ""
    factor: float = 1.0
    most: float | None = None

    @property
    def axis(self) -> str:
        """The label with its unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    def text(self, loss: float) -> str:
        """A loss, as a number of the unit: what a table has."""
        value = self.factor * loss
        if self.most is not None and value > self.most * (1 + 1e-12):
            return f"> {self.most:g}"
        return two_decimals(value) if self.unit else f"{value:.4g}"


def two_decimals(value: float) -> str:
    """Two decimals, of which mV, K and min need no more; four significant digits where these would be lost."""
    return f"{value:.2f}" if value == 0 or abs(value) >= 0.1 else f"{value:.4g}"


def limit_words(problem: ChargingProblem, limit: Limit) -> LimitWords:
    """A limit of a charge in the words of its own bound: "voltage over 4.2 V", in mV."""
    factor, unit = (1e3, "mV") if limit.unit == "V" else (1.0, limit.unit)
    samples, tolerance = judgement(problem, limit)
    side, name = "over" if limit.upper else "under", limit.name
    largest = {"voltage_max_V": "overshoot_mV", "voltage_min_V": ""}.get(name, f"{name.rpartition('_')[0]}_excess_{unit}")
    what = WHAT[limit.of]
    label = f"{what} {side} {limit.bound:g} {limit.unit}"
    return LimitWords(name, label, f"{what.partition(' ')[0]}\n{side}\n({unit})", unit, factor, factor * tolerance, samples, largest)


def objective_words(problem: ChargingProblem, tuner: str = "") -> ObjectiveWords:
    """What the loss of a charging study is: minutes to a SOC, the mean squared deficit, or with the tuner "ei" -G."""
    if tuner == "ei":
        return ObjectiveWords("-G", "-G")
    mark, of = problem.objective.charge_time_to_soc, ""
    quantile = problem.range.objective_quantile if problem.range and tuner == "range" else None
    if quantile is not None:
        of = ", slowest plant" if quantile == 1 else f", {100 * quantile:.3g} % quantile of the plants"
    if mark is None:
        return ObjectiveWords(f"mean of (z_d - z)^2{of}", "mean (z_d - z)^2")
    minutes = problem.episode.steps * problem.controller.sampling_time_s / 60
    return ObjectiveWords(f"time to {100 * mark:.3g} % SOC{of}", f"t{100 * mark:.3g}", "min", minutes, minutes)


def metric_words(name: str) -> tuple[str, str]:
    """(label, unit) of a figure of merit; of one that is not known here the unit is taken from the end of its name."""
    if name in METRIC_WORDS:
        return METRIC_WORDS[name]
    stem, _, last = name.rpartition("_")
    return (stem.replace("_", " "), UNITS[last]) if stem and last in UNITS else (name.replace("_", " "), "")
