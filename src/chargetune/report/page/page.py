"""One study as one self-contained page: opens offline, fetches nothing, says where every number is from."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from chargetune import __version__
from chargetune.report.figures.convergence import excess_unit
from chargetune.report.page import text_sections as sections
from chargetune.report.page.html import packed, plotly_js, section, static
from chargetune.report.page.plot_data import trial_drawing
from chargetune.report.page.trial_rows import study_head, trial_rows
from chargetune.report.sensitivity import STEP, Sensitivity, finite_differences
from chargetune.report.study_view import StudyView

__all__ = ["report_page"]

# How many further trials are drawn, and with how many points: so the page of any study stays below 5 MB.
OTHERS, OTHERS_POINTS = 150, 400

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def report_page(view: StudyView, *, evaluate: bool = True, progress: Callable[[], None] = lambda: None) -> str:
    """The page as HTML.

    ``evaluate`` runs the best theta again, and its neighbours, on the simulated plant; ``progress`` is called after each entry of
    theta. It is done only where the plant is a circuit, which takes milliseconds an episode.
    """
    best, untuned = view.tuned, view.untuned
    quick = evaluate and view.problem is not None and view.problem.plant_cell is not None and best is not None
    moved = finite_differences(view, best, progress) if quick and best is not None else []
    names = [("untuned", untuned, "untuned", "")]
    if best is not None:
        names.append((f"{view.tuned_label} (trial {best.number})", best, "tuned", "dash" if best is untuned else ""))
    drawings = {r.trial.number: trial_drawing(view, r) for r in view.readings(t for _, t, _, _ in names if t is not None)}
    shown = [
        {"label": label, "colour": colour, "dash": dash, "number": t.number, "drawing": drawings[t.number]}
        for label, t, colour, dash in names
        if t is not None
    ]
    rest = [t for t in view.others if t.trace_sha256 is not None]
    some = rest[:: max(1, -(-len(rest) // OTHERS))]
    others = [trial_drawing(view, r, OTHERS_POINTS) for r in view.readings(some)]
    data = {
        "head": study_head(view),
        "rows": trial_rows(view, view.trials),
        "shown": shown,
        "others": others,
        "sensitivity": _bars(view, moved),
    }
    every = [*drawings.values(), *others]
    body = (
        sections.opening(view)
        + sections.what_was_tuned(view)
        + sections.result(view)
        + sections.limits(view)
        + _figures("Signals over time", "signals", '<div class="legend" id="legend"></div>\n', there=any(d["panels"] for d in every))
        + _figures("What was learned, over SOC", "profiles", there=any(d["profiles"] for d in every))
        + section("Convergence", '<div class="figures large" id="convergence"></div>\n')
        + sections.violations(view)
        + sections.failures(view)
        + sections.sensitivities(view, moved)
        + sections.provenance(view, best, reproduced=quick)
    )
    return _document(f"chargetune report: {view.name}", body, json.dumps(data, allow_nan=False, separators=(",", ":")))


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
{static("report.js")}</script>
</body>
</html>
"""


def _bars(view: StudyView, moved: Sequence[Sensitivity]) -> list[dict[str, Any]]:
    step, out = f"{100 * STEP:g} % of its range", []
    limit_unit, limit_scale = excess_unit(view)
    for field, caption, unit, scale in (
        ("minutes", "time to 95 % SOC when one entry of theta is moved", "s", 60.0),
        ("objective", "objective when one entry of theta is moved (larger is better)", "objective", 1.0),
        ("excess", "worst excess over all limits when one entry of theta is moved", limit_unit, limit_scale),
    ):
        pairs = [getattr(m, field) for m in moved]
        sides = [[None if p[i] is None else scale * p[i] for p in pairs] for i in (0, 1)]
        if any(v is not None for v in (*sides[0], *sides[1])):
            names = [m.entry for m in moved]
            out.append({"caption": caption, "unit": unit, "step": step, "names": names, "down": sides[0], "up": sides[1]})
    return out
