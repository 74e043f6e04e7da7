"""Settings of the Kalman filter that estimates SOC and overpotentials from voltage, current and temperature."""

from __future__ import annotations

from dataclasses import dataclass, fields

from chargetune.battery.validation import check_number
from chargetune.control.kalman import ExtendedKalman
from chargetune.model.model import Model

__all__ = ["Kalman"]


@dataclass(frozen=True)
class Kalman:
    """Standard deviations: of what is measured, of the start, and of what each interval adds to a state.

    ``voltage_sd_V`` is to hold the error of the model as well as the sensor's: in fast charging the model's is tens of
    millivolts, and a filter that trusts the voltage to 1 mV turns it into 10 to 15 % of SOC.
    """

    voltage_sd_V: float = 0.05
    """Standard deviation of the voltage's error, the model's as well as the sensor's."""
    temperature_sd_K: float = 0.3
    """Standard deviation of the temperature's error."""
    soc_start_sd: float = 0.02
    """Standard deviation of the SOC at the start."""
    soc_process_sd: float = 1e-5
    """What an interval adds to the SOC, standard deviation."""
    overpotential_process_sd_V: float = 1e-4
    """What an interval adds to each overpotential, standard deviation."""
    temperature_process_sd_K: float = 0.05
    """What an interval adds to the temperature, standard deviation."""

    def __post_init__(self) -> None:
        for part in fields(self):
            measured = part.name in ("voltage_sd_V", "temperature_sd_K")
            check_number(f"kalman: {part.name}", getattr(self, part.name), 0.0, 100.0, open_low=measured)

    def estimator(self, model: Model, overpotentials: tuple[str, ...], *, thermal: bool, tuned: bool = False) -> ExtendedKalman:
        """The filter for SOC, overpotentials and, ``thermal``, temperature; ``tuned``: theta sets the voltage's spread."""
        measurement: dict[str, float | str] = {"voltage_V": "voltage_sd_V" if tuned else self.voltage_sd_V}
        process = {"soc": self.soc_process_sd, **dict.fromkeys(overpotentials, self.overpotential_process_sd_V)}
        start = {"soc": self.soc_start_sd}
        if thermal:
            measurement["temperature_K"] = start["temperature_K"] = self.temperature_sd_K
            process["temperature_K"] = self.temperature_process_sd_K
        return ExtendedKalman.of(model, measurement_sd=measurement, process_sd=process, start_sd=start)
