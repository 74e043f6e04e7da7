"""What a tuner sees of a plant, and what it is judged by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import chargetune as ct
from chargetune.episode.compiled import compiled_episode

__all__ = ["SuitePlant", "drawn", "factors", "simulated_plant"]


@dataclass(frozen=True)
class SuitePlant:
    """A plant with its own numbers, a controller that believes others, and the verdict.

    source
        Where its equations and numbers are from.
    evaluate
        (theta, seed) -> `chargetune.Evaluation`, a trial as measured, with noise.
    judge
        theta -> `chargetune.Score` of the same loop without noise, None where it has none; what counts.
    safe_theta
        What somebody who knows the range of these plants would begin with: it keeps every limit on each of them, and is slow.
    twin, windows
        The loop of `chargetune.TwinTuner`, of `chargetune.Composite`; None: these have nothing to go by.
    """

    name: str
    source: str
    space: ct.ParameterSpace
    evaluate: Callable[[NDArray[np.float64], int], ct.Evaluation]
    judge: Callable[[NDArray[np.float64]], ct.Score | None]
    safe_theta: tuple[float, ...]
    twin: Any = None
    windows: Any = None


def simulated_plant(
    name: str,
    source: str,
    *,
    controller: ct.Controller,
    truth: ct.Model,
    start: Mapping[str, float],
    noise_sd: Mapping[str, float],
    limits: Sequence[ct.ScoredLimit],
    objective: Callable[[ct.Episode], float],
    steps: int,
    safe_theta: Sequence[float],
    unknowns: Sequence[ct.Uncertain] = (),
    twin_model: ct.Model | None = None,
    twin_start: Mapping[str, float] | None = None,
    given: Mapping[str, NDArray[np.float64]] | None = None,
    plant_given: Sequence[str] = (),
    input_before: Mapping[str, float] | None = None,
    **more: Any,
) -> SuitePlant:
    """A plant of equations: ``truth`` with its own numbers, ``start`` and sensors; the episode is one compiled function.

    With ``unknowns`` there is a twin: ``twin_model`` (by default the model of the controller) from ``twin_start``, ``more`` as for
    `chargetune.SimulatedTwin.build`.
    """
    told, before = dict(given or {}), dict(input_before or {})

    def score(episode: ct.Episode) -> ct.Evaluation:
        return ct.score_limits(episode, limits, objective=objective)

    @cache
    def loop(*, noisy: bool) -> Any:
        sensors = ct.Sensors(noise_sd=dict(noise_sd) if noisy else {})
        plant = ct.SimulatedPlant(truth, dict(start), sensors, given=tuple(plant_given), input_before=before)
        return compiled_episode(controller, plant, steps)

    twin = None
    if unknowns:
        twin = ct.SimulatedTwin.build(
            controller, twin_model or controller.model, unknowns, noise_sd=noise_sd, steps=steps, limits=limits, objective=objective,
            start=dict(twin_start or start), given=told or None, plant_given=plant_given, **more,
        )  # fmt: skip
    return SuitePlant(
        name=name,
        source=source,
        space=controller.theta,
        evaluate=lambda theta, seed: score(loop(noisy=True).run(theta, seed, given=told or None)),
        judge=lambda theta: score(loop(noisy=False).run(theta, given=told or None)).score,
        safe_theta=tuple(float(v) for v in safe_theta),
        twin=twin,
    )


def drawn(name: str, seed: int, **spread: float) -> dict[str, float]:
    """Factors exp(s u), u uniform on [-1, 1], by parameter: the plant of this seed out of its range."""
    rng = np.random.default_rng([seed, *name.encode()])
    return {key: float(np.exp(s * rng.uniform(-1.0, 1.0))) for key, s in spread.items()}


def factors(*names: str, most: float = 2.0) -> tuple[ct.Parameter, ...]:
    """Entries of theta that are factors on the controller's parameters: 1 is what it believes."""
    return tuple(ct.Parameter(f"{name}_factor", 1 / most, most, default=1.0, scale="log") for name in names)


def believed(model: ct.Model, *names: str) -> Callable[[Any], dict[str, Any]]:
    """The controller's parameters with these factors (`factors`)."""
    return partial(_believed, dict(model.parameters), names)


def _believed(nominal: Mapping[str, Sequence[float]], names: Sequence[str], stage: Any) -> dict[str, Any]:
    return {name: float(np.ravel(nominal[name])[0]) * stage.theta[f"{name}_factor"] for name in names}
