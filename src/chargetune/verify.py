"""Recompute every figure of a certificate from its stored traces. No other code of this package, NumPy only.

Whoever doubts the scoring need not trust it: this file reads two files and does the arithmetic a second time, another way.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Difference", "upper_bound", "verify"]

FORMATS = ("chargetune certificate 1", "chargetune certificate 2")
MARKS = {"t80_min": 0.80, "t90_min": 0.90, "t95_min": 0.95, "t99_min": 0.99}
SHARES = {"q05": 5, "q50": 50, "q95": 95, "worst": 100}
# Two ways of adding the same numbers differ in the last digits.
RELATIVE, ABSOLUTE = 1e-9, 1e-12
# How far a trace may start from what was drawn: an electrochemical model is read just after its first jump of the current.
START = {"soc_start": 1e-9, "ambient_K": 1e-3}


@dataclass(frozen=True)
class Difference:
    """A figure that is not what the traces give; ``recomputed`` says in words what else is wrong."""

    name: str
    stated: Any
    recomputed: Any


def verify(path: str | Path) -> list[Difference]:
    """All differences between a certificate and its traces, none when it is true.

    Raises ValueError for a file that is no certificate, OSError for one that cannot be read.
    """
    file = Path(path)
    try:
        stated = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error
    if not isinstance(stated, dict) or stated.get("format") not in FORMATS:
        found = stated.get("format") if isinstance(stated, dict) else stated
        raise ValueError(f"{file}: format = {found!r}, allowed are {' and '.join(map(repr, FORMATS))}")
    try:
        return _differences(file, stated)
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{file}: the certificate is damaged ({type(error).__name__}: {error})") from error


def upper_bound(violations: int, episodes: int, confidence: float) -> float:
    """The p with P(X <= violations) = 1 - confidence for X binomial(episodes, p), by bisection; 1 when all violate."""
    if violations >= episodes:
        return 1.0
    low, high = 0.0, 1.0
    while True:
        middle = (low + high) / 2
        if middle in (low, high):
            return middle
        low, high = (middle, high) if _at_most(violations, episodes, middle) > 1 - confidence else (low, middle)


def _differences(file: Path, stated: Mapping[str, Any]) -> list[Difference]:
    out = []
    content = json.dumps({k: v for k, v in stated.items() if k != "sha256"}, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(content.encode()).hexdigest()
    if digest != stated["sha256"]:
        out.append(Difference("sha256", stated["sha256"], digest))
    # The name alone: a certificate has no say in which other files are read.
    traces = file.parent / Path(stated["traces"]["file"]).name
    digest = hashlib.sha256(traces.read_bytes()).hexdigest()
    if digest != stated["traces"]["sha256"]:
        out.append(Difference("traces.sha256", stated["traces"]["sha256"], digest))
    try:
        with np.load(traces, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{traces}: no NumPy archive ({error})") from error
    again = _figures(stated, arrays)
    given = stated["figures"]
    for name in sorted(set(given) | set(again)):
        if name not in again:
            out.append(Difference(name, given[name], "no such figure"))
        elif name not in given:
            out.append(Difference(name, "missing", again[name]))
        elif not _same(given[name], again[name]):
            out.append(Difference(name, given[name], again[name]))
    return out + _draws(stated, arrays)


def _figures(stated: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    length = arrays["length"].astype(int)
    edges = [0]
    for count in length:
        edges.append(edges[-1] + int(count))
    n, step = len(length), float(stated["sampling_time_s"])
    kept = arrays["completed"].astype(bool) & (length == int(stated["steps"]))
    out: dict[str, Any] = {"episodes": n, "not_completed": int(n - kept.sum())}
    broken = ~kept
    for limit in stated["limits"]:
        sign = 1.0 if limit["upper"] else -1.0
        beyond = np.full(n, -math.inf)
        for end in ("start", "end"):
            values = sign * (arrays[f"{end}.{limit['signal']}"] - float(limit["bound"]))
            if len(values) != edges[-1]:
                raise ValueError(f"traces: {end}.{limit['signal']} has length {len(values)}, expected {edges[-1]}")
            for i in range(n):
                if length[i]:
                    beyond[i] = max(beyond[i], float(values[edges[i] : edges[i + 1]].max()))
        over = kept & (beyond > float(limit["tolerance"]))
        broken |= over
        out[f"{limit['name']}.violations"] = int(over.sum())
        out[f"{limit['name']}.worst_excess"] = float(beyond[kept].max()) if kept.any() else None
    count = int(broken.sum())
    out["violations"], out["violation_share"] = count, count / n
    out["violation_probability_upper"] = upper_bound(count, n, float(stated["confidence"]))
    for name, mark in MARKS.items():
        ends, starts = arrays["end.soc"], arrays["soc_start"]
        times = [_minutes(float(starts[i]), ends[edges[i] : edges[i + 1]], mark, step) if kept[i] else math.inf for i in range(n)]
        for share, percent in SHARES.items():
            # The smallest time within which at least this share of all episodes got there.
            enough = [t for t in times if sum(other <= t for other in times) * 100 >= percent * n]
            value = min(enough)
            out[f"{name}.{share}"] = None if math.isinf(value) else value
    return out


def _minutes(first: float, soc: NDArray[np.float64], mark: float, step: float) -> float:
    if first >= mark:
        return 0.0
    before = first
    for k, after in enumerate(soc):
        if after >= mark:
            return (k + (mark - before) / (float(after) - before)) * step / 60
        before = float(after)
    return math.inf


def _draws(stated: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[Difference]:
    """Draws that are outside what is declared, or not independent."""
    out = _of_spread(stated, arrays) if stated["format"] == FORMATS[0] else _of_range(stated, arrays)
    if len(np.unique(arrays["seed"])) < len(arrays["seed"]):
        out.append(Difference("episodes", len(arrays["seed"]), "some noise seeds are the same: not independent"))
    return out


def _of_range(stated: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[Difference]:
    """Draws that the stated range does not allow, and starts of traces that are not what was drawn."""
    declared, out = dict(stated["range"]), []
    count = len(arrays["length"])
    pairs = {"soc_start": declared.pop("soc_start") or [stated["soc_start"]] * 2, "ambient_K": declared.pop("ambient_K")}
    aging = [declared.pop("fade"), declared.pop("growth")]
    declared.pop("node_correlation", None)
    # Of cells of one make each number is Student's t of its own.
    pairs["cells"] = [-math.inf, math.inf] if declared.pop("cells", None) else None
    allowed = {name: (-width, width) for name, width in declared.items() if width}
    allowed |= {name: tuple(pair) for name, pair in pairs.items() if pair} | ({"age": (0.0, 1.0)} if any(aging) else {})
    drawn = {name.removeprefix("drawn."): values for name, values in arrays.items() if name.startswith("drawn.")}
    for name in sorted(set(allowed) | set(drawn)):
        if name not in allowed or name not in drawn:
            out.append(Difference(f"range.{name}", allowed.get(name), "drawn" if name in drawn else "not drawn"))
            continue
        (low, high), values = allowed[name], drawn[name]
        if len(values) != count or not (values.min() >= low - RELATIVE and values.max() <= high + RELATIVE):
            out.append(Difference(f"range.{name}", [low, high], f"{len(values)} drawn, {values.min():g} to {values.max():g}"))
    begun = arrays["length"].astype(int) > 0
    first = np.concatenate([[0], np.cumsum(arrays["length"].astype(int))])[:-1][begun]
    for name, signal in (("soc_start", "soc"), ("ambient_K", "temperature_K")):
        if name in drawn and f"start.{signal}" in arrays:
            off = np.abs(arrays[f"start.{signal}"][first] - drawn[name].reshape(count)[begun])
            if off.size and off.max() > START[name]:
                out.append(Difference(f"drawn.{name}", "the start of each trace", f"up to {off.max():g} off"))
    if not np.array_equal(arrays["soc_start"], drawn["soc_start"].reshape(count)):
        out.append(Difference("soc_start", "as drawn", "another"))
    return out


def _of_spread(stated: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[Difference]:
    """Draws of a certificate of format 1 that its spread does not allow."""
    spread, out = stated["spread"], []
    lowest, highest = float(stated["soc_start"]) - spread["soc_start"], float(stated["soc_start"]) + spread["soc_start"]
    start = arrays["soc_start"]
    if start.min() < min(lowest, float(stated["soc_target"])) - RELATIVE or start.max() > highest + RELATIVE:
        out.append(Difference("spread.soc_start", spread["soc_start"], f"drawn {start.min():g} to {start.max():g}"))
    for name, factors in arrays.items():
        if not name.startswith("factor."):
            continue
        table = name.removeprefix("factor.")
        what = "capacity" if table == "capacity_Ah" else "capacitance" if table.startswith("C") else "resistance"
        low, high = 1.0 - spread[what], 1.0 + spread[what]
        if what == "capacity":
            low *= 1.0 - spread["fade"]
        if what == "resistance":
            high *= 1.0 + spread["growth"]
        if factors.min() < low - RELATIVE or factors.max() > high + RELATIVE:
            out.append(Difference(f"spread.{what}", spread[what], f"{table} drawn {factors.min():g} to {factors.max():g}"))
    return out


def _same(one: Any, two: Any) -> bool:
    numbers = [isinstance(v, (int, float)) and not isinstance(v, bool) for v in (one, two)]
    return math.isclose(one, two, rel_tol=RELATIVE, abs_tol=ABSOLUTE) if all(numbers) else bool(one is None and two is None)


def _at_most(k: int, n: int, p: float) -> float:
    """P(X <= k) of a binomial X."""
    if p <= 0.0:
        return 1.0
    if p >= 1.0:
        return 0.0
    logs = [
        math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1) + i * math.log(p) + (n - i) * math.log1p(-p) for i in range(k + 1)
    ]
    top = max(logs)
    return math.exp(top) * math.fsum(math.exp(value - top) for value in logs)
