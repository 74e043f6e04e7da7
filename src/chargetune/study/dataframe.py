"""A study in a notebook: its trials as a pandas data frame, itself as HTML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from chargetune.episode.html_repr import facts, table
from chargetune.model.parameter_space import ParameterSpace
from chargetune.study.result import StudyResult
from chargetune.study.trial import Trial

__all__ = ["study_html", "trials_dataframe"]


def trials_dataframe(space: ParameterSpace, trials: Sequence[Trial]) -> Any:
    """One row a trial, by number: status, ending, feasible, objective, performance, theta, excess of each limit, metrics.

    theta has one column an entry of the space, an excess the column ``excess_NAME`` in the unit of the limit. What a trial does not
    have, such as the score of a failed one, is missing (NaN, None), never a number. Raises ImportError without pandas.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError("trials_dataframe needs pandas: pip install 'chargetune[notebook]'") from error
    rows = [_row(space, trial) for trial in trials]
    # In this order also where the first trials failed and have no score.
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return pd.DataFrame(rows, columns=columns or ["status"], index=pd.Index([t.number for t in trials], name="trial"))


def study_html(name: str, about: Mapping[str, str], space: ParameterSpace, trials: Sequence[Trial], result: StudyResult) -> str:
    """How far a study is, its result where that kept the limits, and its theta with units."""
    best, count = result.kept, Counter(t.status.value for t in trials)
    head = facts(
        f"Study {name}",
        {
            "trials": f"{len(trials)}: " + ", ".join(f"{n} {status}" for status, n in count.items()) if trials else "none",
            "broke a limit": sum(t.score is not None and not t.feasible for t in trials),
            "best trial": None if best is None else best.number,
            "why": result.sentence,
            **about,
        },
    )
    if best is None or best.score is None:
        return head
    units = [p.unit for p in space.parameters for _ in p.entries]
    theta = table(("theta", "value", "unit"), list(zip(space.entries, best.theta, units, strict=True)))
    return head + theta + best.score._repr_html_()


def _row(space: ParameterSpace, trial: Trial) -> dict[str, Any]:
    score = trial.score
    row: dict[str, Any] = {
        "status": trial.status.value,
        "ending": trial.ending,
        "feasible": None if score is None else score.feasible,
        "objective": None if score is None else score.objective,
        "performance": None if score is None else score.performance,
        "asked_at": trial.asked_at,
        "told_at": trial.told_at,
        **dict(zip(space.entries, trial.theta, strict=True)),
    }
    if score is not None:
        row |= {f"excess_{name}": value for name, value in score.excess.items()}
        row |= dict(score.metrics)
    return row
