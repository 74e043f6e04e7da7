"""What a study writes down as JSON: configuration, parameter space, tuner, score; and how two of them differ."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace

__all__ = [
    "canonical_json",
    "describe",
    "differences",
    "score_from_json",
    "score_to_json",
    "sha256",
    "space_from_json",
    "space_to_json",
]


def canonical_json(value: object, what: str) -> str:
    """``value`` as JSON with sorted keys, equal text for equal values.

    Tuples become lists and NumPy numbers plain ones. Raises ValueError naming the place of what JSON cannot hold, NaN and inf included.
    """
    return json.dumps(_plain(value, what), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def sha256(data: str | bytes) -> str:
    """SHA-256 as 64 hexadecimal digits."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def describe(value: object) -> Any:
    """A JSON description of frozen data, such as a tuner: type and fields, functions by their name.

    It is compared when a study is resumed, so it must not contain an address in memory. Fields of a dataclass with the metadata
    ``{"identity": False}`` are left out: what they hold is in the configuration already.
    """
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: describe(getattr(value, f.name)) for f in dataclasses.fields(value) if f.metadata.get("identity", True)}
        return {"type": type(value).__qualname__, **fields}
    if isinstance(value, Mapping):
        return {str(key): describe(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return describe(value.tolist())
    if isinstance(value, (Sequence, set, frozenset)):
        return [describe(item) for item in (sorted(value) if isinstance(value, (set, frozenset)) else value)]
    named = value if hasattr(value, "__qualname__") else type(value)
    return f"{named.__module__}.{named.__qualname__}"


def differences(old: object, new: object, where: str = "") -> list[str]:
    """One line for each entry in which two JSON values differ: ``config.horizon: 5 -> 10``."""
    if isinstance(old, dict) and isinstance(new, dict):
        lines = []
        for key in sorted({*old, *new}):
            place = f"{where}.{key}" if where else str(key)
            if key not in old:
                lines.append(f"{place}: (absent) -> {_short(new[key])}")
            elif key not in new:
                lines.append(f"{place}: {_short(old[key])} -> (absent)")
            else:
                lines += differences(old[key], new[key], place)
        return lines
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [line for i, (a, b) in enumerate(zip(old, new, strict=True)) for line in differences(a, b, f"{where}[{i}]")]
    # 1 == True in Python, but a switch and a number are not the same entry of a configuration.
    return [] if old == new and isinstance(old, bool) == isinstance(new, bool) else [f"{where}: {_short(old)} -> {_short(new)}"]


def score_to_json(score: Score) -> dict[str, Any]:
    """The score as plain numbers. Raises ValueError naming the field that is not a finite number."""
    if not isinstance(score, Score):
        raise ValueError(f"score = {score!r}, allowed is a Score")
    return {
        "objective": _finite(score.objective, "score.objective"),
        "performance": _finite(score.performance, "score.performance"),
        "excess": {name: _finite(v, f"score.excess[{name}]") for name, v in score.excess.items()},
        "tolerance": {name: _finite(v, f"score.tolerance[{name}]") for name, v in score.tolerance.items()},
        "metrics": {name: None if v is None else _finite(v, f"score.metrics[{name}]") for name, v in score.metrics.items()},
        "profile": {
            name: [None if v is None else _finite(v, f"score.profile[{name}]") for v in values] for name, values in score.profile.items()
        },
    }


def score_from_json(data: Mapping[str, Any]) -> Score:
    """Inverse of `score_to_json`."""
    profile = {name: tuple(values) for name, values in data.get("profile", {}).items()}
    return Score(**{**data, "profile": profile})


def space_to_json(space: ParameterSpace) -> list[dict[str, Any]]:
    """The parameters of a space as plain data, defaults as a list of ``size`` numbers."""
    return [
        {
            "name": p.name,
            "lower": float(p.lower),
            "upper": float(p.upper),
            "default": [float(v) for v in np.atleast_1d(p.default)],
            "unit": p.unit,
            "scale": p.scale,
            "size": p.size,
        }
        for p in space.parameters
    ]


def space_from_json(data: Sequence[Mapping[str, Any]]) -> ParameterSpace:
    """Inverse of `space_to_json`."""
    return ParameterSpace(tuple(Parameter(**{**entry, "default": tuple(entry["default"])}) for entry in data))


def _plain(value: object, where: str) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where} = {value}, allowed is a finite number")
        return value
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ValueError(f"{where} has the key {key!r}, allowed are strings")
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), where)
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise ValueError(f"{where} is a {type(value).__name__}, allowed are JSON values: null, bool, number, string, list, table")


def _finite(value: object, name: str) -> float:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{name} = {value!r}, allowed is a finite number")
    return float(value)


def _short(value: object) -> str:
    text = "(not given)" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
