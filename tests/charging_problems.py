"""Charging problems for tests, with every entry of their tables named without its table: `charging_problem(cell, steps=60)`."""

from dataclasses import fields, replace

from chargetune.battery.charging.limits import LimitSettings
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import (
    FILTERS,
    ControllerSettings,
    EpisodeSettings,
    EstimatorSettings,
    Objective,
    SafetySettings,
    SensorSettings,
)
from chargetune.battery.charging.tunables import Tunables

TABLES = {
    "controller": ControllerSettings,
    "estimator": EstimatorSettings,
    "limits": LimitSettings,
    "episode": EpisodeSettings,
    "sensors": SensorSettings,
    "objective": Objective,
    "theta": Tunables,
    "safety": SafetySettings,
}
TABLE_OF = {part.name: table for table, settings in TABLES.items() for part in fields(settings)}


def charging_problem(cell, mismatch_seed=0, **entries):
    """A problem whose controller has the wrong model of seed 0, changed in these entries."""
    return changed(ChargingProblem(cell), mismatch_seed=mismatch_seed, **entries)


def changed(problem, **entries):
    """The problem with other entries of its tables, or other whole fields (cell, plant, sensors, ..), checked once all are changed."""
    # Settings of a filter are those of the estimator that has it.
    filters = [name for name in FILTERS if entries.get(name) is not None]
    entries = ({"kind": filters[0]} if filters else {}) | entries
    whole = {name: value for name, value in entries.items() if name not in TABLE_OF}
    for name, value in entries.items():
        if name in TABLE_OF:
            table = TABLE_OF[name]
            whole.setdefault(table, {})[name] = value
    for table, settings in TABLES.items():
        if isinstance(whole.get(table), dict):
            before = getattr(problem, table)
            whole[table] = settings(**whole[table]) if before is None else replace(before, **whole[table])
    return replace(problem, **whole)
