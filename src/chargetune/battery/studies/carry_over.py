"""Which trials of a charging study still count when its file has changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.verdict import score_episode
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.study.serialization import differences

__all__ = ["ChargingCarry"]

# What of a table judges a charge. The controller reads limits and target, too; of what it did then the trace tells.
JUDGES = {
    "limits": ("voltage_min_V", "voltage_max_V", "tolerance_V", "temperature_max_K", "tolerance_K", "anode_min_V", "tolerance_anode_V"),
    "episode": ("soc_target",),
    "cell": ("voltage_min_V", "voltage_max_V"),
}
# What neither makes a closed loop nor judges it.
NEITHER = {"cell": ("name", "remark")}
LOOP = ("cell", "plant", "controller", "estimator", "limits", "episode", "sensors", "theta")


@dataclass(frozen=True)
class ChargingCarry:
    """`Carry` of a charging study, whose problem is the one of now."""

    problem: ChargingProblem

    def other_loop(self, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
        """What of cell, plant, controller, estimator, sensors, input limits, episode or the form of theta is another one."""
        found = differences(_loop(old), _loop(new))
        # A verdict over a range of use is not in the one trace that is kept of it.
        if not found and (_over_range(old) or _over_range(new)):
            found = [f"{line}; over a range of use no verdict can be made again" for line in differences(_judges(old), _judges(new))]
        return _shortened(found)

    def other_verdict(self, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
        """What of limits, tolerances, target and objective is another one."""
        return _shortened(differences(_judges(old), _judges(new)))

    def judge(self, episode: Episode) -> Score:
        """The verdict of now on a stored charge."""
        return score_episode(self.problem, episode)


def _loop(config: Mapping[str, Any]) -> dict[str, Any]:
    tables = {name: config.get(name) for name in LOOP}
    for name, keys in (*JUDGES.items(), *NEITHER.items()):
        tables[name] = {key: value for key, value in (tables[name] or {}).items() if key not in keys}
    tables["theta"] = _without_bounds(tables["theta"] or {})
    return tables | ({"range": config.get("range"), "over a range": True} if _over_range(config) else {})


def _judges(config: Mapping[str, Any]) -> dict[str, Any]:
    tables = {name: {key: (config.get(name) or {}).get(key) for key in keys} for name, keys in JUDGES.items()}
    return tables | {"objective": config.get("objective")}


def _over_range(config: Mapping[str, Any]) -> bool:
    return bool((config.get("study") or {}).get("tuner") == "range")


def _without_bounds(table: Any) -> Any:
    if isinstance(table, Mapping):
        return {key: _without_bounds(value) for key, value in table.items() if not key.startswith(("lower", "upper"))}
    return [_without_bounds(part) for part in table] if isinstance(table, (list, tuple)) else table


def _shortened(lines: list[str]) -> str:
    return "" if not lines else lines[0] + (f" and {len(lines) - 1} more" if len(lines) > 1 else "")
