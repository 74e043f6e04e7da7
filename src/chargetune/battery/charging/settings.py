"""Settings of a charging problem, one class for each table of a study file: how it is controlled, estimated, measured and judged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.observers import Adaptive, OffsetFree
from chargetune.battery.validation import check_count, check_number
from chargetune.plants.sensors import Sensors

__all__ = ["FILTERS", "ControllerSettings", "EpisodeSettings", "EstimatorSettings", "Objective", "SafetySettings", "SensorSettings"]


# A sensor that errs by more measures nothing that a charge could be controlled by.
SENSOR_ERRORS = {
    ("voltage", "_V"): (0.5, "V (was it given in mV?)"),
    ("temperature", "_K"): (20.0, "K"),
    ("soc", ""): (0.5, "(was it given in %?)"),
}


@dataclass(frozen=True)
class ControllerSettings:
    """The controller and what it wrongly believes."""

    sampling_time_s: float = 10.0
    """Length of one control interval, in which the current is constant."""
    horizon: int = 5
    """Intervals that the controller looks ahead."""
    mismatch_seed: int | None = None
    """Seed by which the controller's resistances and capacitances are drawn wrong by up to a half; not given: it knows the cell."""
    penalty_per_V: float = 1e3
    """Exact penalty of the voltage limits, in cost per volt; those of the other limits follow from it."""
    current_ramp_A_s: float | None = None
    """By how much the current may rise per second, so that the first intervals show an unknown resistance before the current is large;
    not given: at once.
    """

    def __post_init__(self) -> None:
        check_number("sampling_time_s", self.sampling_time_s, 1e-3, 3600.0, "s")
        check_count("horizon", self.horizon, 1, 50)
        check_number("penalty_per_V", self.penalty_per_V, 0.0, 1e9, "", open_low=True)
        seed = self.mismatch_seed
        if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
            raise ValueError(f"mismatch_seed = {seed!r}, allowed is an integer >= 0")
        if self.current_ramp_A_s is not None:
            check_number("current_ramp_A_s", self.current_ramp_A_s, 0.0, 1e4, "A/s", open_low=True)


Kind = Literal["open_loop", "exact", "kalman", "offset_free", "adaptive"]
FILTERS = ("kalman", "offset_free", "adaptive")


@dataclass(frozen=True)
class EstimatorSettings:
    """What the controller knows of the state, and how.

    kind
        "open_loop": the SOC and, in a thermal model, the temperature are the plant's; the overpotentials follow the controller's own
        model, and the voltage is not read. That is the paper's controller. "exact": every state of the circuit is the plant's, which no
        real cell tells. "kalman": a filter on voltage and temperature estimates SOC and overpotentials (`Kalman`). "offset_free": the
        voltage's error is a disturbance that a filter follows, the SOC is counted (`OffsetFree`). "adaptive": the same with a
        common factor of the resistances (`Adaptive`). None: that whose settings are given, else open_loop.
    """

    kind: Kind | None = None
    """"open_loop": the voltage is not read; "exact": every state is known; "kalman", "offset_free", "adaptive": a filter reads the
    voltage. Not given: that whose table is given, else open_loop.
    """
    soc_start_error: float = 0.0
    """What is believed of the SOC at the start less the truth; without effect where the voltage at rest sets it."""
    kalman: Kalman | None = None
    """The filter of kind "kalman"."""
    offset_free: OffsetFree | None = None
    """The observer of kind "offset_free"."""
    adaptive: Adaptive | None = None
    """The observer of kind "adaptive"."""

    def __post_init__(self) -> None:
        check_number("soc_start_error", self.soc_start_error, -0.5, 0.5)
        named = [name for name in FILTERS if getattr(self, name) is not None]
        if self.kind is None:
            object.__setattr__(self, "kind", named[0] if named else "open_loop")
        if self.kind not in get_args(Kind):
            raise ValueError(f"estimator: kind = {self.kind!r}, allowed are {', '.join(get_args(Kind))}")
        given = [name for name in named if name != self.kind]
        if given:
            raise ValueError(f"estimator: settings of {', '.join(given)} are given with kind = {self.kind!r}, allowed are its own")

    @property
    def line(self) -> str:
        """Its kind, and what it reads, in words."""
        reads = {
            "open_loop": "the SOC is measured, the voltage is not read",
            "exact": "every state of the plant is known, which no real cell tells",
            "kalman": "a filter on the voltage estimates SOC and overpotentials",
            "offset_free": "a disturbance follows the error of the voltage",
            "adaptive": "a disturbance and a factor of the resistances follow the voltage",
        }
        return f"{self.kind}: {reads[self.kind or 'open_loop']}"

    @property
    def follows_offset(self) -> bool:
        """Whether a lasting error of the voltage is followed, so that it does not stay beyond a limit."""
        return self.kind in ("offset_free", "adaptive")

    @property
    def unread(self) -> str | None:
        """What is left unread although it is measured, and what reads it, one line; None where the voltage is read."""
        if self.settings is not None:
            return None
        return (
            f"the voltage is measured, and estimator.kind = '{self.kind}' does not read it: wrong resistances become overshoot; "
            "kind = 'offset_free' or 'adaptive' reads it"
        )

    @property
    def settings(self) -> Kalman | OffsetFree | Adaptive | None:
        """The settings of the filter; None where there is none."""
        match self.kind:
            case "kalman":
                return self.kalman or Kalman()
            case "offset_free":
                return self.offset_free or OffsetFree()
            case "adaptive":
                return self.adaptive or Adaptive()
        return None


@dataclass(frozen=True)
class EpisodeSettings:
    """One charge: its largest number of intervals, and the SOC that it begins at and is to reach."""

    steps: int = 360
    """Intervals of one charge at most."""
    soc_start: float = 0.05
    """SOC at the start."""
    soc_target: float = 1.0
    """SOC to be reached, more than soc_start."""

    def __post_init__(self) -> None:
        check_count("steps", self.steps, 1, 1_000_000)
        start = check_number("soc_start", self.soc_start, 0.0, 1.0, "")
        target = check_number("soc_target", self.soc_target, 0.0, 1.0, "")
        if target <= start:
            raise ValueError(f"soc_target = {target:g} must be more than soc_start = {start:g}")


@dataclass(frozen=True)
class SensorSettings:
    """Imperfect measurement of the plant."""

    voltage_noise_sd_V: float = 0.0
    """Standard deviation of the noise on the voltage."""
    voltage_bias_V: float = 0.0
    """Constant error of the voltage."""
    voltage_resolution_V: float = 0.0
    """Step to which the voltage is rounded; 0: not rounded."""
    temperature_noise_sd_K: float = 0.0
    """Standard deviation of the noise on the temperature."""
    temperature_bias_K: float = 0.0
    """Constant error of the temperature."""
    soc_noise_sd: float = 0.0
    """Standard deviation of the noise on the SOC."""
    soc_bias: float = 0.0
    """Constant error of the SOC."""
    delay_steps: int = 0
    """Intervals by which every measurement is late."""

    def __post_init__(self) -> None:
        for quantity, (most, unit) in SENSOR_ERRORS.items():
            for name in (f"{quantity[0]}_noise_sd{quantity[1]}", f"{quantity[0]}_bias{quantity[1]}"):
                check_number(name, getattr(self, name), -most if "bias" in name else 0.0, most, unit)
        check_number("voltage_resolution_V", self.voltage_resolution_V, 0.0, 0.5, "V (was it given in mV?)")
        check_count("delay_steps", self.delay_steps, 0, 100)

    @property
    def noise_sd(self) -> dict[str, float]:
        """The standard deviations that are not zero, by signal; a plant need not have the others."""
        return _given(voltage_V=self.voltage_noise_sd_V, temperature_K=self.temperature_noise_sd_K, soc=self.soc_noise_sd)

    def sensors(self) -> Sensors:
        """The same by signal, as a plant takes it."""
        bias = _given(voltage_V=self.voltage_bias_V, temperature_K=self.temperature_bias_K, soc=self.soc_bias)
        return Sensors(self.noise_sd, bias, {"voltage_V": self.voltage_resolution_V}, self.delay_steps)


def _given(**values: float) -> dict[str, float]:
    return {signal: value for signal, value in values.items() if value}


@dataclass(frozen=True)
class Objective:
    """What a charge is worth, and how closely its limits are looked at."""

    c1: float = 1e-5
    """Weight c1 of the published scalar performance G, which the tuner "ei" maximises."""
    charge_time_to_soc: float | None = None
    """SOC to which the time of charge is minimised; not given: the mean squared lack of charge is minimised."""
    soc_windows: int = 5
    """Equal parts of the SOC in each of which the tuner is told the worst excess of a limit."""
    verdict_samples: int = 1
    """Intervals of the moving mean by which a noisy signal is judged; 1: each sample by itself."""

    def __post_init__(self) -> None:
        check_number("c1", self.c1, 0.0, 1.0, "", open_low=True)
        if self.charge_time_to_soc is not None:
            check_number("charge_time_to_soc", self.charge_time_to_soc, 0.0, 1.0, "", open_low=True)
        check_count("soc_windows", self.soc_windows, 1, 50)
        check_count("verdict_samples", self.verdict_samples, 1, 1000)


@dataclass(frozen=True)
class SafetySettings:
    """Safe learning by the twin: what must be likely, where to begin, what may be spent, when an episode is ended.

    A plant whose episode is ended is closed: its current is 0, the trial failed and its trace is kept.
    """

    probability: float = 0.95
    """Probability with which every limit must be predicted to be kept before a theta is tried."""
    start: Mapping[str, float | list[float]] | None = field(default=None, hash=False)
    """A theta that is known to be safe, values by name; not given: the most cautious corner of its bounds."""
    budget_mVs: float | None = None
    """Excess over the voltage limit, integrated over time, that may be spent in all; not given: no budget."""
    abort_margin_V: float | None = 0.02
    """An episode ends as soon as a measured voltage is so far over its limit."""
    abort_margin_K: float | None = 2.0
    """An episode ends as soon as a measured temperature is so far over its limit."""

    def __post_init__(self) -> None:
        p = self.probability
        if isinstance(p, bool) or not isinstance(p, (int, float)) or not 0.5 <= p < 1.0:
            raise ValueError(f"probability = {p!r}, allowed is [0.5, 1)")
        if self.budget_mVs is not None:
            check_number("budget_mVs", self.budget_mVs, 0.0, math.inf, "mV s")
        if self.abort_margin_V is not None:
            check_number("abort_margin_V", self.abort_margin_V, 0.0, 1.0, "V", open_low=True)
        if self.abort_margin_K is not None:
            check_number("abort_margin_K", self.abort_margin_K, 0.0, 50.0, "K", open_low=True)
