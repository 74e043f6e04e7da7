"""One study as one self-contained page: opens offline, fetches nothing, says where every number is from."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from chargetune import __version__
from chargetune.report.markup import Cell, packed, paragraph, plotly_js, section, static, table
from chargetune.report.panels import trial_drawing
from chargetune.report.reading import StudyView, read_study
from chargetune.report.recheck import Check, recheck
from chargetune.report.rows import study_head, trial_row
from chargetune.report.sensitivity import STEP, Sensitivity, again, finite_differences, rank_correlations
from chargetune.study.store import StoreError
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["report_page", "save_report"]

# How many further trials are drawn, and with how many points: so the page of any study stays below 5 MB.
OTHERS, OTHERS_POINTS = 150, 400
WORST = 20

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def save_report(
    store_path: str | os.PathLike[str],
    name: str,
    target: str | os.PathLike[str],
    *,
    evaluate: bool = True,
    progress: Callable[[], None] = lambda: None,
) -> Path:
    """Write the page of the study ``name`` and give its path. What the arguments mean and what is raised: `report_page`, `read_study`."""
    page = report_page(read_study(store_path, name), evaluate=evaluate, progress=progress)
    path = Path(target)
    path.write_text(page, encoding="utf-8")
    return path


def report_page(view: StudyView, *, evaluate: bool = True, progress: Callable[[], None] = lambda: None) -> str:
    """The page as HTML.

    ``evaluate`` runs the best theta again, and its neighbours, on the simulated plant: 2 d + 2 episodes for d entries of theta, each
    of which calls ``progress``. It is done only where the plant is the cell's own circuit, which takes milliseconds an episode.
    """
    best, untuned = view.tuned, view.untuned
    quick = evaluate and view.problem is not None and view.problem.plant_model is None and best is not None
    moved = finite_differences(view, best, progress) if quick and best is not None else []
    shown = [
        {"label": label, "colour": colour, "dash": dash, "number": t.number, "drawing": trial_drawing(view, t)}
        for label, t, colour, dash in (
            ("untuned", untuned, "untuned", ""),
            (f"{view.tuned_label} (trial {best.number if best else ''})", best, "tuned", "dash" if best is untuned else ""),
        )
        if t is not None
    ]
    rest = [t for t in view.others if t.trace_sha256 is not None]
    some = rest[:: max(1, -(-len(rest) // OTHERS))]
    data = {
        "head": study_head(view),
        "rows": [trial_row(view, t) for t in view.trials],
        "shown": shown,
        "others": [trial_drawing(view, t, OTHERS_POINTS) for t in some],
        "sensitivity": _bars(moved),
    }
    body = (
        _opening(view)
        + _what_was_tuned(view)
        + _result(view)
        + _limits(view)
        + section("Signals over time", '<div class="legend" id="legend"></div>\n<div class="figures" id="signals"></div>\n')
        + section("What was learned, over SOC", '<div class="figures" id="profiles"></div>\n')
        + section("Convergence", '<div class="figures large" id="convergence"></div>\n')
        + _violations(view)
        + _failures(view)
        + _sensitivities(view, moved)
        + _provenance(view, best, reproduced=quick)
    )
    return _document(f"chargetune report: {view.name}", body, json.dumps(data, allow_nan=False, separators=(",", ":")))


def _document(title: str, body: str, data: str) -> str:
    from html import escape

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
{body}<footer>Written by chargetune {__version__}. The page carries everything it shows, with plotly.js (MIT licence) for its figures.</footer>
<script type="text/plain" id="plotly">{packed(plotly_js())}</script>
<script type="text/plain" id="data">{packed(data)}</script>
<script>
{static("figures.js")}</script>
<script>
{static("report.js")}</script>
</body>
</html>
"""


def _opening(view: StudyView) -> str:
    from html import escape

    done = [t for t in view.trials if t.score is not None]
    broke = sum(not t.feasible for t in done)
    failed = sum(t.status is TrialStatus.FAILED for t in view.trials)
    running = sum(t.status is TrialStatus.RUNNING for t in view.trials)
    counts = f"{len(view.trials)} trials: {len(done) - broke} within the limits, {broke} beyond one, {failed} failed"
    more = f", {running} not told yet" if running else ""
    best = view.tuned
    if best is None:
        verdict = paragraph("No trial has a score: there is no result.", "bad")
    elif not best.feasible:
        verdict = paragraph(f"No trial kept the limits. Shown as tuned is the one that came closest, trial {best.number}.", "bad")
    else:
        verdict = paragraph(f"Result: trial {best.number}, which kept every limit. {_minutes(view)}", "good")
    note = '<p id="drawing">The figures are being drawn.</p>\n<noscript><p class="bad">The figures need JavaScript.</p></noscript>\n'
    return f"<header>\n<h1>{escape(view.name)}</h1>\n{paragraph(counts + more + '.', 'faint')}{verdict}{note}</header>\n<main>\n"


def _minutes(view: StudyView) -> str:
    def t95(trial: Trial | None) -> float | None:
        return None if trial is None or trial.score is None else trial.score.metrics.get("t95_min")

    tuned, untuned = t95(view.tuned), t95(view.untuned)
    if tuned is None:
        return ""
    kept = "kept the limits" if view.untuned is not None and view.untuned.feasible else "broke a limit"
    before = "" if untuned is None else f" Untuned it took {untuned:.2f} min and {kept}."
    return f"95 % state of charge after {tuned:.2f} min.{before}"


def _what_was_tuned(view: StudyView) -> str:
    problem, head = view.problem, study_head(view)
    parts = []
    if problem is not None:
        plant = "its own circuit, simulated" if problem.plant_model is None else repr(problem.plant_model)
        belief = "the plant's own" if problem.mismatch_seed is None else f"wrong by the factors of mismatch seed {problem.mismatch_seed}"
        facts: list[tuple[Cell, ...]] = [
            ("cell", problem.plant_cell.name),
            ("capacity", f"{problem.plant_cell.capacity_Ah:g} Ah"),
            ("plant", plant),
            ("controller's parameters", belief),
            ("sampling time, horizon", f"{problem.sampling_time_s:g} s, {problem.horizon} intervals"),
            ("charge", f"SOC {problem.soc_start:g} to {problem.soc_target:g}, at most {problem.steps * problem.sampling_time_s / 60:g} min"),
            ("tuner", view.tuner),
        ]
        parts.append(table(("", ""), facts))
        if problem.plant_cell.remark:
            parts.append(paragraph(f"{problem.plant_cell.name}: {problem.plant_cell.remark}", "faint"))
        rows = [(x["name"], float(x["bound"]), x["unit"], float(x["tolerance"]), x["kind"]) for x in head["limits"]]
        parts.append(table(("limit", "bound", "unit", "tolerance", "in the controller"), rows))
    else:
        parts.append(paragraph("The study is not one of battery charging. What an evaluation does is in its configuration, under Provenance."))
    return section("What was tuned", *parts)


def _result(view: StudyView) -> str:
    best, untuned = view.tuned, view.untuned
    if best is None:
        return ""
    rows: list[tuple[Cell, ...]] = []
    for x, value in zip(study_head(view)["theta"], best.theta, strict=True):
        span = x["upper"] - x["lower"]
        at = "at its bound" if min(value - x["lower"], x["upper"] - value) <= 1e-6 * span else ""
        rows.append((x["entry"], value, x["untuned"], "" if x["unit"] == "1" else x["unit"], x["lower"], x["upper"], at))
    headings = ("theta", f"trial {best.number}", "untuned", "unit", "lower bound", "upper bound", "")
    names = dict.fromkeys(name for t in (untuned, best) if t is not None and t.score is not None for name in t.score.metrics)
    figures = [
        (name, *(t.score.metrics.get(name) if t is not None and t.score is not None else None for t in (untuned, best))) for name in names
    ]
    what = "Best theta within the limits" if best.feasible else "theta that came closest to the limits"
    return section(what, table(headings, rows), table(("figure of merit", "untuned", f"trial {best.number}"), figures))


def _checked(view: StudyView, trials: Sequence[Trial]) -> tuple[dict[int, list[Check]], list[str]]:
    """The limits judged again, by trial, and the traces that cannot be read."""
    checks, damaged = {}, []
    for trial in trials:
        try:
            episode = view.episode(trial)
        except StoreError as error:
            damaged.append(str(error))
            continue
        if view.problem is not None and episode is not None:
            checks[trial.number] = recheck(view.problem, episode, trial.score)
    return checks, damaged


def _limits(view: StudyView) -> str:
    title = "Limits, checked again from the stored traces"
    if view.problem is None:
        stored = [(name, e, t) for name, e, t in _stored(view.tuned)]
        text = "What the limits mean is not in the study's document, so they cannot be judged again. The stored excess of the result:"
        return section(title, paragraph(text), table(("limit", "excess", "tolerance"), stored))
    checks, damaged = _checked(view, [t for t in view.trials if t.status is not TrialStatus.RUNNING])
    parts = []
    for label, trial in (("untuned", view.untuned), (view.tuned_label, view.tuned)):
        if trial is not None and trial.number in checks:
            parts.append(_check_table(f"{label}, trial {trial.number}", checks[trial.number]))
    wrong = [number for number, found in checks.items() if not all(c.agrees for c in found)]
    text = f"{len(checks)} trials with a trace were judged again; "
    if wrong:
        parts.append(paragraph(f"{text}in trials {', '.join(map(str, wrong))} the stored score says something else.", "bad"))
    else:
        parts.append(paragraph(f"{text}every stored excess is what its trace says."))
    parts += [paragraph(line, "bad") for line in damaged]
    return section(title, *parts)


def _stored(trial: Trial | None) -> list[tuple[str, float, float]]:
    score = None if trial is None else trial.score
    return [] if score is None else [(name, value, score.tolerance.get(name, 0.0)) for name, value in score.excess.items()]


def _check_table(caption: str, checks: Sequence[Check]) -> str:
    rows: list[tuple[Cell, ...]] = [
        (
            c.name, c.bound, c.reached, c.at_s / 60, c.excess, c.tolerance, c.judged, c.true_excess,
            ("kept", "good") if c.kept else ("broken", "bad"),
        )
        for c in checks
    ]  # fmt: skip
    headings = ("limit", "bound", "reached", "at min", "excess", "tolerance", "judged on", "excess without noise", "")
    return table(headings, rows, caption)


def _violations(view: StudyView) -> str:
    broke = [t for t in view.trials if t.score is not None and not t.feasible]
    title = "Violations during tuning"
    if not broke:
        return section(title, paragraph("No trial went beyond a limit by more than its tolerance."))
    names = list(dict.fromkeys(n for t in broke if t.score is not None for n in t.score.excess))
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        over = [(t.score.excess[name], t.number) for t in broke if t.score is not None and _over(t, name)]
        if over:
            rows.append((name, len(over), *max(over), min(n for _, n in over), max(n for _, n in over)))
    return section(
        title,
        paragraph(f"{len(broke)} of {len(view.trials)} trials went beyond a limit by more than its tolerance."),
        table(("limit", "trials", "worst excess", "in trial", "first", "last"), rows),
    )


def _over(trial: Trial, name: str) -> bool:
    return trial.score is not None and trial.score.excess.get(name, 0.0) > trial.score.tolerance.get(name, 0.0)


def _failures(view: StudyView) -> str:
    failed = [t for t in view.trials if t.status is TrialStatus.FAILED]
    if not failed:
        return section("Failures", paragraph("No trial failed."))
    kinds = Counter((t.ending or "unknown").partition(":")[0] for t in failed)
    by_kind: list[tuple[Cell, ...]] = []
    for kind, count in kinds.most_common():
        last = next(t for t in reversed(failed) if (t.ending or "unknown").partition(":")[0] == kind)
        by_kind.append((kind, count, last.number, (last.ending or "", "long text")))
    return section("Failures", table(("kind", "trials", "last", "what the last one says"), by_kind))


def _bars(moved: Sequence[Sensitivity]) -> list[dict[str, Any]]:
    step, out = f"{100 * STEP:g} % of its range", []
    for field, caption, unit, scale in (
        ("minutes", "time to 95 % SOC when one entry of theta is moved", "s", 60.0),
        ("objective", "objective when one entry of theta is moved (larger is better)", "objective", 1.0),
        ("excess", "worst excess over all limits when one entry of theta is moved", "unit of the limit", 1.0),
    ):
        pairs = [getattr(m, field) for m in moved]
        sides = [[None if p[i] is None else scale * p[i] for p in pairs] for i in (0, 1)]
        if any(v is not None for v in (*sides[0], *sides[1])):
            names = [m.entry for m in moved]
            out.append({"caption": caption, "unit": unit, "step": step, "names": names, "down": sides[0], "up": sides[1]})
    return out


def _sensitivities(view: StudyView, moved: Sequence[Sensitivity]) -> str:
    parts = []
    if moved:
        text = (
            f"Finite differences on the simulated plant at the result, with the seed of its trial: each entry of theta alone is moved by "
            f"{100 * STEP:g} % of its range, down and up. Where a bar is missing, the bound is nearer or the time is not reached."
        )
        parts.append(paragraph(text))
        parts.append('<div class="figures" id="sensitivity"></div>\n')
    ranks = rank_correlations(view)
    if ranks:
        text = (
            "Spearman's rank correlation over all scored trials. A tuner does not sample evenly, so this shows a tendency, not an effect."
        )
        rows: list[tuple[Cell, ...]] = [(entry, f"{a:+.2f}", f"{b:+.2f}") for entry, (a, b) in ranks.items()]
        parts += [paragraph(text), table(("theta", "with the objective", "with the worst excess"), rows)]
    return section("Sensitivity of the result", *(parts or [paragraph("Too few trials with a score.")]))


def _provenance(view: StudyView, best: Trial | None, *, reproduced: bool) -> str:
    record = view.record
    rows: list[tuple[Cell, ...]] = [("store", view.path.name)]
    if record is not None:
        rows += [("study begun", record.created_at), ("configuration (SHA-256)", record.identity_sha256)]
        rows += [(f"seed of the {what}", str(record.identity.get(key))) for what, key in (("study", "seed"),)]
        rows.append(("trials proposed at a time", str(record.identity.get("batch"))))
    if best is not None:
        rows += [(f"trial {best.number}: told", best.told_at or ""), ("its seed", str(best.seed)), ("its trace (SHA-256)", best.trace_sha256)]
        rows += [(f"made with {name}", str(v)) for name, v in best.provenance.get("versions", {}).items()]
        if reproduced and view.problem is not None:
            off = again(view.problem, best)
            rows.append(("evaluated again now, largest difference", "no score" if off is None else f"{off:.1e}"))
    others = {json.dumps(t.provenance.get("versions"), sort_keys=True) for t in view.trials}
    if len(others) > 1:
        rows.append(("further versions", f"the trials were made with {len(others)} different sets of programs"))
    parts = [table(("", ""), [(a, (str(b), "long text")) for a, b in rows])]
    if record is not None:
        from html import escape

        text = escape(json.dumps(record.identity, indent=1, ensure_ascii=False))
        parts.append(f"<details>\n<summary>The whole configuration</summary>\n<pre>{text}</pre>\n</details>\n")
    return section("Provenance", *parts) + "</main>\n"
