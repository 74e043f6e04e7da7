"""How much the result of a study depends on each entry of theta."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from chargetune.battery.charging.problem import with_feedback
from chargetune.battery.studies.open_study import evaluation_of
from chargetune.episode.score import Score
from chargetune.report.figures.convergence import worst_excess
from chargetune.report.study_view import StudyView
from chargetune.study.evaluation import Evaluate
from chargetune.study.trial import Trial

__all__ = [
    "STEP",
    "Importance",
    "Sensitivity",
    "again",
    "evaluation_in",
    "finite_differences",
    "importance",
    "rank_correlations",
    "with_observer",
]

# Share of an entry's range (logarithmic for a log scale) by which it is moved.
STEP = 0.02
LEAST_TRIALS = 8


@dataclass(frozen=True)
class Sensitivity:
    """What moving one entry of theta by `STEP` of its range does, down and up; None where the bound is nearer or no score came.

    ``minutes``: change of the time to 95 % SOC. ``objective``: change of the objective. ``excess``: change of the worst excess over
    all limits, as `worst_excess` compares them. Each is a pair (down, up).
    """

    entry: str
    minutes: tuple[float | None, float | None]
    objective: tuple[float | None, float | None]
    excess: tuple[float | None, float | None]


@dataclass(frozen=True)
class Importance:
    """What is lost when an entry of theta, or with ``[all]`` a whole parameter, is put back to its untuned value.

    ``lost``: by how much the objective becomes smaller; ``excess``: change of the worst excess, as `worst_excess` compares them.
    Both are None where that charge has no score.
    """

    entry: str
    lost: float | None
    excess: float | None


def importance(view: StudyView, trial: Trial, progress: Callable[[], None] = lambda: None) -> list[Importance]:
    """One evaluation for each parameter of several entries and for each entry, with the seed of ``trial``, the largest loss first.

    Raises ValueError for a study that is not one of battery charging.
    """
    evaluate, space, theta = evaluation_in(view), view.space, np.array(trial.theta)
    base, _, _ = evaluate(theta, trial.seed)
    parts = [(f"{name}[all]", part) for name, part in space.slices.items() if part.stop - part.start > 1]
    parts += [(entry, slice(i, i + 1)) for i, entry in enumerate(space.entries)]
    out = []
    for name, part in parts:
        back = theta.copy()
        back[part] = space.default[part]
        score = evaluate(back, trial.seed)[0] if not np.array_equal(back, theta) else base
        if score is None or base is None:
            out.append(Importance(name, None, None))
        else:
            excess = worst_excess(view, score) - worst_excess(view, base)
            out.append(Importance(name, base.objective - score.objective, excess))
        progress()
    return sorted(out, key=lambda one: -abs(one.lost or 0.0))


def again(view: StudyView, trial: Trial) -> float | None:
    """The largest difference between the stored score and that of the same theta and seed now; None when either is missing.

    Compared are objective and excesses. A difference above rounding says that the program or the machine is another.
    Raises ValueError for a study that is not one of battery charging.
    """
    score, _, _ = evaluation_in(view)(np.array(trial.theta), trial.seed)
    if score is None or trial.score is None:
        return None
    pairs = [(score.objective, trial.score.objective), *((score.excess[n], e) for n, e in trial.score.excess.items())]
    return max(abs(a - b) for a, b in pairs)


def finite_differences(view: StudyView, trial: Trial, progress: Callable[[], None] = lambda: None) -> list[Sensitivity]:
    """Two more evaluations an entry, each what a trial is, with the seed of ``trial``: draws and noise are the same in all of them.

    Raises ValueError for a study that is not one of battery charging: its document does not say how to evaluate.
    """
    evaluate, space = evaluation_in(view), view.space
    base, _, _ = evaluate(np.array(trial.theta), trial.seed)
    centre, out = space.to_unit(np.array(trial.theta)), []
    for i, entry in enumerate(space.entries):
        changes: list[tuple[float | None, float | None, float | None]] = []
        for step in (-STEP, STEP):
            moved = centre.copy()
            moved[i] += step
            inside = -1e-12 <= moved[i] <= 1 + 1e-12
            score = evaluate(space.from_unit(moved), trial.seed)[0] if inside else None
            if score is None or base is None:
                changes.append((None, None, None))
            else:
                after, before = score.metrics.get("t95_min"), base.metrics.get("t95_min")
                minutes = None if after is None or before is None else after - before
                excess = worst_excess(view, score) - worst_excess(view, base)
                changes.append((minutes, score.objective - base.objective, excess))
        progress()
        down, up = changes
        out.append(Sensitivity(entry, (down[0], up[0]), (down[1], up[1]), (down[2], up[2])))
    return out


def with_observer(view: StudyView, trial: Trial) -> Score | None:
    """The untuned controller with the observer that reads the voltage (`with_feedback`), as a trial with the seed of ``trial``.

    None where the study's own controller has one, where it is not one of battery charging, and where the charge has no score.
    """
    problem = view.problem
    if problem is None or problem.estimator.follows_offset:
        return None
    evaluate = evaluation_of("range" if view.over_range else "default", with_feedback(problem))
    return evaluate(np.zeros(0), trial.seed)[0]


def evaluation_in(view: StudyView) -> Evaluate:
    """What a trial of the study was: one charge, or a theta on drawn plants. Raises ValueError where its document does not say."""
    if view.problem is None:
        raise ValueError(f"study {view.name!r} is not one of battery charging, it cannot be evaluated from its document")
    # Of the others only "twin" has charges in conditions of their own, where the study has a range of use.
    return evaluation_of("range" if view.over_range else "twin" if view.tuner == "twin" else "default", view.problem)


def rank_correlations(view: StudyView) -> dict[str, tuple[float, float]]:
    """Spearman's rank correlation of each entry of theta with objective and worst excess over the scored trials.

    Empty below 8 of them; an entry that was never moved is left out. A tuner does not sample evenly: near its end most trials lie
    around the best one, so this shows a tendency and no effect.
    """
    scored = [t for t in view.trials if t.score is not None]
    if len(scored) < LEAST_TRIALS:
        return {}
    from scipy.stats import spearmanr

    thetas = np.array([t.theta for t in scored])
    objective = np.array([t.score.objective for t in scored if t.score is not None])
    excess = np.array([worst_excess(view, t.score) for t in scored])
    out = {}
    for i, entry in enumerate(view.space.entries):
        if np.ptp(thetas[:, i]) and np.ptp(objective) and np.ptp(excess):
            out[entry] = (float(spearmanr(thetas[:, i], objective).statistic), float(spearmanr(thetas[:, i], excess).statistic))
    return out
