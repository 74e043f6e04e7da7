"""Further sections of a report: what safe mode promised, the certificate, what theta matters, and the store's other studies."""

from __future__ import annotations

import base64
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from chargetune.report.page.html import Cell, paragraph, section, table
from chargetune.report.page.trial_rows import objective_text
from chargetune.report.safety import Promise
from chargetune.report.sensitivity import Importance
from chargetune.report.study_view import StudyView
from chargetune.runtime.counted import counted
from chargetune.study.trial import TrialStatus

__all__ = ["certificate", "certificate_of", "other_studies", "promises", "theta_figures", "trials"]


def trials() -> str:
    """The place of the table of trials, which the page fills."""
    return section(
        "Trials",
        '<div id="tools" class="tools"></div>\n<div class="wide trials-table" id="table"><table id="trials">'
        '<thead><tr id="headings"></tr></thead><tbody id="rows"></tbody></table></div>\n',
    )


def theta_figures(view: StudyView, found: Sequence[Importance]) -> str:
    """Importance of the entries of theta, all trials as parallel coordinates, and slices."""
    parts = []
    if found and view.start_label == "untuned":
        said = (
            "Objective lost when one entry of theta, or a whole parameter, is put back to its untuned value; the others stay as they are."
        )
        parts.append(paragraph(said + " Where it is negative, the untuned value has the better objective, and is often over a limit."))
        parts.append('<div class="figures" id="importance"></div>\n')
    elif found:
        said = "Objective lost when one entry of theta, or a whole parameter, is put back to the value of the untuned controller"
        parts.append(paragraph(f"{said}, which this study did not try; the others stay as they are."))
        parts.append('<div class="figures" id="importance"></div>\n')
    parts.append('<div class="figures large" id="parallel"></div>\n<div id="choice" class="tools"></div>\n')
    parts.append('<div class="figures large" id="slices"></div>\n')
    return section("theta", *parts)


def promises(view: StudyView, promised: Sequence[Promise]) -> str:
    """What safe mode said of each trial before it was tried, and what was spent of the budget."""
    problem = view.problem
    if problem is None or problem.safety is None:
        return ""
    budget = problem.safety.budget_mVs
    total = promised[-1].total if promised else 0.0
    bound = "no budget was set" if budget is None else f"of a budget of {budget:g} mV s"
    parts = [
        paragraph(
            f"A theta was tried where it was predicted to keep every limit with a probability of at least {problem.safety.probability:g}. "
            f"Spent beyond limit and tolerance of the voltage: {total:.3g} mV s, {bound}."
        )
    ]
    rows: list[tuple[Cell, ...]] = []
    for one in promised:
        score = one.trial.score
        verdict = ("no score", "") if score is None else ("kept", "good") if score.feasible else ("broken", "bad")
        chance = "declared" if one.probability is None else f"{one.probability:.2f}"
        rows.append((f"trial {one.trial.number}", chance, verdict, f"{one.spent:.3g}", f"{one.total:.3g}"))
    headings = ("", "predicted probability", "measured", "spent (mV s)", "in all (mV s)")
    return section("Safe mode", *parts, table(headings, rows) if rows else "")


def certificate_of(view: StudyView, path: Path) -> dict[str, Any] | None:
    """The certificate in a file where it is of this study, with ``path``; None where it is another's, or there is none."""
    try:
        stated: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        own = view.record is not None and stated["origin"]["study_sha256"] == view.record.identity_sha256
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return {**stated, "path": path} if own else None


def certificate(view: StudyView, stated: dict[str, Any] | None) -> str:
    """Figures and picture of the certificate; of a study without one how it is made."""
    if view.problem is None:
        return ""
    if stated is None:
        how = "The command chargetune certify STORE makes one: the tuned controller on fresh episodes of its range of use"
        said = f"No certificate of this study was found beside its store. {how}, and a bound on the probability of a violation."
        return section("Certificate", paragraph(said))
    found, trial = stated["figures"], stated["origin"]["trial"]
    bound = f"{100 * found['violation_probability_upper']:.2f} % (confidence {100 * stated['confidence']:g} %)"
    said = f"Trial {trial} on {counted(found['episodes'], 'fresh episode')} of its range of use: {found['violations']} broke a limit; "
    parts = [paragraph(f"{said}probability of a violation at most {bound}.", "good" if not found["violations"] else "")]
    if view.tuned is not None and trial != view.tuned.number:
        parts.append(paragraph(f"It is of trial {trial}; the result of the study is trial {view.tuned.number}.", "bad"))
    rows: list[tuple[Cell, ...]] = []
    for limit in stated["limits"]:
        name = limit["name"]
        factor, unit = (1e3, "mV") if name.endswith("_V") else (1.0, name.rpartition("_")[2])
        worst = found[f"{name}.worst_excess"]
        told = None if worst is None else f"{factor * worst:.4g} {unit}"
        rows.append((name, found[f"{name}.violations"], told, f"{factor * limit['tolerance']:g} {unit}"))
    parts.append(table(("limit", "violations", "worst excess", "tolerance"), rows))
    picture = _picture(stated["path"])
    if picture:
        parts.append(f'<img class="picture" alt="excess and charging times of every episode" src="data:image/png;base64,{picture}">\n')
    return section("Certificate", *parts)


def _picture(path: str | os.PathLike[str]) -> str:
    from chargetune.report.figures.certificate import certificate_figure
    from chargetune.report.figures.style import journal_style

    try:
        figure = certificate_figure(path)
    except (OSError, ValueError, KeyError):
        return ""
    content = io.BytesIO()
    with journal_style():
        figure.savefig(content, format="png", dpi=150)
    return base64.b64encode(content.getvalue()).decode()


def other_studies(view: StudyView, others: Sequence[StudyView]) -> str:
    """The studies of the store side by side, this one first; nothing where it is the only one."""
    if not others:
        return ""
    rows: list[tuple[Cell, ...]] = []
    for one in (view, *others):
        scored = [t for t in one.trials if t.score is not None]
        failed = sum(t.status is TrialStatus.FAILED for t in one.trials)
        best = one.result.kept
        worth = objective_text(one, best) or None
        over = sum(not t.feasible for t in scored)
        rows.append((one.name, (one.tuner or "-", "text"), len(scored), over, failed, None if best is None else best.number, worth))
    headings = ("study", ("tuner", "text"), "scored", "over a limit", "failed", "best trial", "its objective")
    figure = '<div class="figures large" id="studies"></div>\n'
    return section("All studies of this store", table(headings, rows), figure)
