"""One study as one self-contained page: opens offline, fetches nothing, says where every number is from."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from chargetune import __version__
from chargetune.report.figures.convergence import excess_unit, incumbents
from chargetune.report.page import evidence_sections as evidence
from chargetune.report.page import text_sections as sections
from chargetune.report.page.html import packed, plotly_js, section, static
from chargetune.report.page.plot_data import rounded, trial_drawing
from chargetune.report.page.trial_rows import study_head, trial_rows
from chargetune.report.safety import predicted_probabilities
from chargetune.report.sensitivity import STEP, Importance, Sensitivity, finite_differences, importance, with_observer
from chargetune.report.study_view import StudyView
from chargetune.report.words import objective_of_study

__all__ = ["evaluations", "report_page"]

# How many further trials are drawn, and with how many points: so the page of any study stays below 5 MB.
OTHERS, OTHERS_POINTS = 150, 400
# Entries of theta whose importance is drawn.
IMPORTANT = 16

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def report_page(
    view: StudyView,
    *,
    evaluate: bool = True,
    progress: Callable[[], None] = lambda: None,
    others: Sequence[StudyView] = (),
    certified: dict[str, Any] | None = None,
) -> str:
    """The page as HTML.

    ``evaluate`` runs the best theta again, its neighbours, theta with each entry put back, and the untuned controller with an observer
    on the simulated plant; ``progress`` is called after each of the `evaluations` of theta. It is done only where the plant is a circuit,
    which takes milliseconds an episode. With it a safe study's twin is asked again what it promised. ``others`` are further studies of the
    store to compare with, ``certified`` is the study's certificate (`certificate_of`).
    """
    best, start = view.tuned, view.start
    quick = evaluate and view.problem is not None and view.problem.plant_cell is not None and best is not None
    # On a thousand drawn plants an evaluation takes seconds: there each entry is put back, and not moved to its neighbours.
    moved = finite_differences(view, best, progress) if quick and best is not None and not view.over_range else []
    put_back = importance(view, best, progress) if quick and best is not None else []
    feedback = with_observer(view, best) if quick and best is not None else None
    promised = predicted_probabilities(view) if evaluate else []
    names = [(view.start_label, start, "untuned", "")]
    if best is not None:
        names.append((f"{view.tuned_label} (trial {best.number})", best, "tuned", "dash" if best is start else ""))
    drawings = {r.trial.number: trial_drawing(view, r) for r in view.readings(t for _, t, _, _ in names if t is not None)}
    shown = [
        {"label": label, "colour": colour, "dash": dash, "number": t.number, "drawing": drawings[t.number]}
        for label, t, colour, dash in names
        if t is not None
    ]
    rest = [t for t in view.others if t.trace_sha256 is not None]
    some = rest[:: max(1, -(-len(rest) // OTHERS))]
    drawn = [trial_drawing(view, r, OTHERS_POINTS) for r in view.readings(some)]
    data = {
        "head": study_head(view),
        "rows": trial_rows(view, view.trials),
        "shown": shown,
        "others": drawn,
        "sensitivity": _bars(view, moved),
        "importance": _importance(view, put_back),
        "studies": _courses(view, others),
        "result": None if best is None else best.number,
        "start": None if start is None else start.number,
        "start_label": view.start_label,
    }
    every = [*drawings.values(), *drawn]
    body = (
        sections.opening(view)
        + _figures("Signals over time", "signals", '<div class="legend" id="legend"></div>\n', there=any(d["panels"] for d in every))
        + section("Convergence", '<div class="figures large" id="convergence"></div>\n')
        + sections.result(view, feedback)
        + sections.limits(view)
        + evidence.promises(view, promised)
        + evidence.certificate(view, certified)
        + _figures("What was learned, over SOC", "profiles", _profile_legend(every), there=any(d["profiles"] for d in every))
        + evidence.theta_figures(view, put_back)
        + sections.sensitivities(view, moved)
        + evidence.trials()
        + sections.violations(view)
        + sections.failures(view)
        + evidence.other_studies(view, others)
        + sections.what_was_tuned(view)
        + sections.provenance(view, best, reproduced=quick)
        + "</main>\n"
    )
    return _document(f"chargetune report: {view.name}", body, json.dumps(data, allow_nan=False, separators=(",", ":")))


def evaluations(view: StudyView) -> int:
    """How often `report_page` calls ``progress``."""
    return (1 if view.over_range else 2) * view.space.dimension + sum(p.size > 1 for p in view.space.parameters)


def _profile_legend(every: Sequence[dict[str, Any]]) -> str:
    return '<div class="legend" id="profile-legend"></div>\n' if any(d["profiles"] for d in every) else ""


def _importance(view: StudyView, found: Sequence[Importance]) -> dict[str, Any] | None:
    """The largest ones, in what the objective is told in: of a time the time that is lost."""
    scored = [one for one in found if one.lost is not None]
    known = scored[:IMPORTANT]
    if not known:
        return None
    words = objective_of_study(view)
    factor, unit = (60.0 * words.factor, "s") if words.unit == "min" else (1.0, "objective")
    limit_unit, limit_scale = excess_unit(view)
    return {
        "names": [one.entry for one in known],
        "lost": [factor * (one.lost or 0.0) for one in known],
        "unit": unit,
        "excess": [None if one.excess is None else limit_scale * one.excess for one in known],
        "excess_unit": limit_unit,
        "left_out": len(scored) - len(known),
        "unscored": [one.entry for one in found if one.lost is None],
    }


def _courses(view: StudyView, others: Sequence[StudyView]) -> dict[str, Any] | None:
    """The best so far over the trials, of the studies whose objective is this one's and can be compared."""
    words = objective_of_study(view)
    alike = [one for one in (view, *others) if one.comparable and objective_of_study(one).axis == words.axis]
    if len(alike) < 2 or not view.comparable:
        return None
    lines = []
    for one in alike:
        best = words.factor * incumbents(one)
        lines.append({"name": one.name, "x": [t.number for t in one.trials], "y": rounded(best)})
    return {"label": words.axis, "lines": lines}


def _figures(title: str, name: str, before: str = "", *, there: bool) -> str:
    return section(title, f'{before}<div class="figures" id="{name}"></div>\n') if there else ""


def _document(title: str, body: str, data: str) -> str:
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{escape(title)}</title>
<style>
{static("look.css")}</style>
</head>
<body>
{body}<footer>Written by chargetune {__version__}. The page carries all it shows, and plotly.js (MIT licence) to draw it.</footer>
<script type="text/plain" id="plotly">{packed(plotly_js())}</script>
<script type="text/plain" id="data">{packed(data)}</script>
<script>
{static("figures.js")}</script>
<script>
{static("trials.js")}</script>
<script>
{static("report.js")}</script>
</body>
</html>
"""


def _bars(view: StudyView, moved: Sequence[Sensitivity]) -> list[dict[str, Any]]:
    step, out = f"{100 * STEP:g} % of its range", []
    limit_unit, limit_scale = excess_unit(view)
    words = objective_of_study(view)
    # Where the objective is a time, that says it all.
    fields = [("objective", f"{words.label} when one entry of theta is moved", "s", -60.0 * words.factor)]
    if words.unit != "min":
        fields = [
            ("minutes", "time to 95 % SOC when one entry of theta is moved", "s", 60.0),
            ("objective", "objective when one entry of theta is moved (larger is better)", "objective", 1.0),
        ]
    fields.append(("excess", "worst excess over all limits when one entry of theta is moved", limit_unit, limit_scale))
    for field, caption, unit, scale in fields:
        pairs = [getattr(m, field) for m in moved]
        sides = [[None if p[i] is None else scale * p[i] for p in pairs] for i in (0, 1)]
        if any(v is not None for v in (*sides[0], *sides[1])):
            names = [m.entry for m in moved]
            out.append({"caption": caption, "unit": unit, "step": step, "names": names, "down": sides[0], "up": sides[1]})
    return out
