"""Certificate: the tuned controller on fresh episodes, its violations counted, and a bound on their probability.

Two files: the figures as JSON, which names the other, and beside it the traces of every episode as a compressed NumPy archive, from which
`chargetune.verify` recomputes each figure without any code of this package.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.certification.clopper_pearson import violation_bound
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.metrics import SOC_MARKS
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.range_settings import MEANING, NOT_ELECTROCHEMICAL
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.plants.range_of_use import DrawnPlant
from chargetune.runtime.counted import counted
from chargetune.study.files import write_whole
from chargetune.study.provenance import utc_now, versions

__all__ = ["FORMAT", "Charge", "charge_seed", "figures", "run_charges", "write_certificate"]

FORMAT = "chargetune certificate 2"
DRAWN = (
    "All values v are uniform and independent of each other, and each episode's of all others. The controller is told none of them: "
    "it reads its sensors. Sensor noise is from a fresh seed."
)
DRAWN_ELECTROCHEMICAL = (
    f"The plant is electrochemical: the resistance is its ohmic one at half charge, not below that of its parameter set; "
    f"not varied: {', '.join(NOT_ELECTROCHEMICAL)}."
)
# Episodes that a worker runs at a time: the controller is built once for each.
CHUNK = 25
# Per cent, as integers: 0.95 x 20 must not round up.
QUANTILES = (5, 50, 95)


@dataclass(frozen=True)
class Charge:
    """One fresh episode: what was drawn, what happened, the verdict on it (None: it did not come to its end)."""

    index: int
    seed: int
    values: Mapping[str, tuple[float, ...]]
    episode: Episode
    score: Score | None


def charge_seed(seed: int, index: int) -> int:
    """The seed of draw ``index``, of which it is the first: independent of all others and of every seed of a study.

    Each charge has a sequence of its own, since the points of one Sobol sequence are not independent, and the bound wants that they are.
    """
    # A study's trials have spawn keys of one number.
    state = np.random.SeedSequence(seed, spawn_key=(index, 1)).generate_state(1, np.uint64)
    return int(state[0]) >> 11


def run_charges(
    problem: ChargingProblem,
    theta: Sequence[float],
    *,
    seed: int,
    episodes: int,
    executor: Executor | None = None,
) -> Iterator[list[Charge]]:
    """The fresh episodes on the problem's range of use in portions, as they are done; their draws depend on seed and index alone.

    Raises ValueError without a range, and when nothing is drawn that could differ, so that the episodes were all the same.
    """
    ChargingRange(problem)
    if problem.range is not None and not problem.range.names and not any(problem.sensors.noise_sd.values()):
        raise ValueError(
            "range: nothing differs and the sensors have no noise, so all episodes are the same; allowed is that something does"
        )
    parts = [range(first, min(first + CHUNK, episodes)) for first in range(0, episodes, CHUNK)]
    if executor is None:
        for part in parts:
            yield _portion(problem, tuple(theta), seed, part)
        return
    futures = [executor.submit(_portion, problem, tuple(theta), seed, part) for part in parts]
    for future in as_completed(futures):
        yield future.result()


def figures(charges: Sequence[Charge], tolerances: Mapping[str, float], confidence: float) -> dict[str, Any]:
    """Every figure of the certificate, by name.

    An episode violates when a limit is broken by more than its tolerance, or when it does not come to its end. A quantile
    of a time is the smallest one that such a share of all episodes needed at most; None when fewer ever got there.
    """
    scores = [charge.score for charge in charges]
    broken = sum(score is None or not score.feasible for score in scores)
    count = len(charges)
    out: dict[str, Any] = {
        "episodes": count,
        "not_completed": sum(score is None for score in scores),
        "violations": broken,
        "violation_share": broken / count,
        "violation_probability_upper": violation_bound(broken, count, confidence),
    }
    for name, tolerance in tolerances.items():
        values = [score.excess[name] for score in scores if score is not None]
        out[f"{name}.violations"] = sum(value > tolerance for value in values)
        out[f"{name}.worst_excess"] = max(values, default=None)
    for mark in SOC_MARKS:
        name = f"t{round(100 * mark)}_min"
        times = sorted(math.inf if score is None or score.metrics[name] is None else float(score.metrics[name] or 0.0) for score in scores)
        for share in QUANTILES:
            value = times[-(-share * count // 100) - 1]
            out[f"{name}.q{share:02d}"] = None if math.isinf(value) else value
        out[f"{name}.worst"] = None if math.isinf(times[-1]) else times[-1]
    return out


def write_certificate(
    path: Path,
    problem: ChargingProblem,
    charges: Sequence[Charge],
    *,
    theta: Mapping[str, float],
    origin: Mapping[str, Any],
    seed: int,
    confidence: float,
) -> dict[str, Any]:
    """Write both files and give the certificate. ``origin`` says which study and trial theta is from, and where the range is from.

    The traces' name holds their hash, ``NAME-0123456789ab.npz``, so that the certificate there was before keeps its own until the
    new one takes its place: a crash at any moment leaves the old one whole or the new one. Then the old traces are deleted. A
    figure beside it (``NAME.png``) is deleted first, it would be another certificate's.
    """
    ordered = sorted(charges, key=lambda charge: charge.index)
    archive = io.BytesIO()
    np.savez_compressed(archive, allow_pickle=False, **_arrays(ordered))
    digest, entries = hashlib.sha256(archive.getvalue()).hexdigest(), problem.range.entries if problem.range else {}
    traces = write_whole(path.with_name(f"{path.stem}-{digest[:12]}.npz"), archive.getvalue())
    certificate: dict[str, Any] = {
        "format": FORMAT,
        "made_at": utc_now(),
        "versions": versions(),
        "origin": dict(origin),
        "theta": dict(theta),
        "cell": {"name": problem.cell.title, "remark": problem.cell.remark},
        "plant": problem.plant_line,
        "sampling_time_s": problem.controller.sampling_time_s,
        "steps": problem.episode.steps,
        "soc_start": problem.episode.soc_start,
        "soc_target": problem.episode.soc_target,
        "seed": seed,
        "confidence": confidence,
        "range": entries,
        "meaning": {name: MEANING[name] for name in entries},
        "drawn": drawn_text(problem),
        "judged": "true outputs, without sensor noise, at both ends of every interval",
        "limits": [
            {"name": limit.name, "signal": limit.signal, "upper": limit.upper, "bound": limit.bound, "tolerance": limit.tolerance}
            for limit in problem.limits_by_name.values()
        ],
        "figures": figures(ordered, {limit.name: limit.tolerance for limit in problem.limits_by_name.values()}, confidence),
        "traces": {"file": traces.name, "sha256": digest},
    }
    content = json.dumps(certificate, sort_keys=True, separators=(",", ":"), allow_nan=False)
    certificate["sha256"] = hashlib.sha256(content.encode()).hexdigest()
    old = _traces_of(path)
    path.with_suffix(".png").unlink(missing_ok=True)
    write_whole(path, json.dumps(certificate, indent=1, allow_nan=False) + "\n")
    if old is not None and old != traces:
        old.unlink(missing_ok=True)
    return certificate


def drawn_text(problem: ChargingProblem) -> str:
    """How the values were drawn, and what of them the controller was told."""
    schedule = problem.theta.schedule
    told = ", ".join(axis.name for axis in schedule.schedule.axes) if schedule else ""
    parts = [DRAWN.replace("told none of them: it reads", f"told only {told}, which choose its theta: else it reads") if told else DRAWN]
    if not problem.plant_cell:
        parts.append(DRAWN_ELECTROCHEMICAL)
    if problem.range is not None and problem.range.node_correlation:
        parts.append("Only those of the nodes of one table are correlated.")
    if problem.range_cells:
        names, cells = ", ".join(one.name for one in problem.range_cells), counted(len(problem.range_cells), "cell")
        parts.append(
            f"Before that, R, C and capacity are drawn as another cell of the make of {cells}: {names}; "
            "predictive distribution of their logarithms, Student's t."
        )
    cell = problem.range.cell if problem.range else None
    if cell is not None:
        parts.append(f"The plant is one cell of the range, number {cell}: what is of a cell is the same in each episode.")
    return " ".join(parts)


def _traces_of(path: Path) -> Path | None:
    """The traces of the certificate that is there, None when there is none; never a file of another name than `write_certificate` gives."""
    try:
        name = str(json.loads(path.read_text(encoding="utf-8"))["traces"]["file"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    own = name == f"{path.stem}.npz" or re.fullmatch(re.escape(path.stem) + r"-[0-9a-f]{12}\.npz", name)
    return path.with_name(name) if own else None


def _portion(problem: ChargingProblem, theta: tuple[float, ...], seed: int, part: Sequence[int]) -> list[Charge]:
    use = ChargingRange(problem)
    drawn = [use.draw(1, charge_seed(seed, index))[0] for index in part]
    episodes = use.run([np.array(theta)] * len(drawn), drawn)
    return [_charge(use, index, one, episode) for index, one, episode in zip(part, drawn, episodes, strict=True)]


def _charge(use: ChargingRange, index: int, drawn: DrawnPlant, episode: Episode) -> Charge:
    score = use.score(episode.noise_free()) if episode.ending is Ending.DONE else None
    return Charge(index, drawn.seed, use.values(drawn), episode, score)


def _arrays(charges: Sequence[Charge]) -> dict[str, NDArray[Any]]:
    """The traces one after the other, ``length`` intervals each, and what was drawn, a row an episode."""
    episodes = [charge.episode for charge in charges]
    names = episodes[0].output_names
    true = [episode.noise_free() for episode in episodes]
    out: dict[str, NDArray[Any]] = {
        "length": np.array([len(episode) for episode in episodes]),
        "completed": np.array([charge.score is not None for charge in charges]),
        "ending": np.array([f"{episode.ending.value} {episode.message}".strip() for episode in episodes]),
        "soc_start": np.array([charge.values["soc_start"][0] for charge in charges]),
        "seed": np.array([charge.seed for charge in charges]),
        **{f"drawn.{name}": np.array([charge.values[name] for charge in charges]) for name in charges[0].values},
        "status": np.concatenate([episode.status for episode in episodes]),
    }
    for i, name in enumerate(episodes[0].input_names):
        out[f"input.{name}"] = np.concatenate([episode.input[:, i] for episode in episodes])
    for end, values, exact in (
        ("start", [e.output_start for e in episodes], [e.output_start for e in true]),
        ("end", [e.output_end for e in episodes], [e.output_end for e in true]),
    ):
        for i, name in enumerate(names):
            out[f"{end}.{name}"] = np.concatenate([value[:, i] for value in exact])
            measured = np.concatenate([value[:, i] for value in values])
            if not np.array_equal(measured, out[f"{end}.{name}"], equal_nan=True):
                out[f"measured_{end}.{name}"] = measured
    return out
