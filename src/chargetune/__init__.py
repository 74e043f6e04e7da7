"""Tuning of model predictive charging controllers in closed loop.

cell -> model -> controller(theta) -> plant -> episode -> score -> tuner -> trial -> study -> report, web

Signs and units everywhere: current is positive when it charges; volts, amperes, seconds, ohm, farad, kelvin; state of
charge from 0 to 1; capacity in ampere-hours. Where a person types a number its name carries the unit (``voltage_max_V``).
"""

__all__ = ["__version__"]

# A literal, not importlib.metadata: reading the metadata costs a tenth of the time that ``chargetune --help`` may take.
__version__ = "0.1.0"
