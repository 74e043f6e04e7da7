"""The sections of a report that are text and tables."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from html import escape

import numpy as np

from chargetune.episode.score import Score
from chargetune.report.figures.convergence import loss
from chargetune.report.limit_recheck import LimitCheck, recheck
from chargetune.report.page.html import Cell, beside, paragraph, section, table
from chargetune.report.page.trial_rows import study_head
from chargetune.report.sensitivity import STEP, Sensitivity, again, rank_correlations
from chargetune.report.study_view import StudyView
from chargetune.report.words import limits_of_study, metrics_of_study, objective_of_study
from chargetune.runtime.counted import counted
from chargetune.study.store.database import store_name
from chargetune.study.store.store import StoreError
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["failures", "limits", "opening", "provenance", "result", "sensitivities", "violations", "what_was_tuned"]


def opening(view: StudyView) -> str:
    done = [t for t in view.trials if t.score is not None]
    over = _plants_over(view.tuned)
    broke = sum(not t.feasible for t in done)
    failed = sum(t.status is TrialStatus.FAILED for t in view.trials)
    running = sum(t.status is TrialStatus.RUNNING for t in view.trials)
    counts = f"{counted(len(view.trials), 'trial')}: {len(done) - broke} within the limits, {broke} beyond one, {failed} failed"
    apart = sum(t.status is TrialStatus.APART for t in view.trials)
    more = (f", {apart} set apart" if apart else "") + (f", {running} not told yet" if running else "")
    best = view.tuned
    if best is None:
        verdict = paragraph(f"There is no result: {view.result.sentence}.", "bad")
    elif not best.feasible:
        verdict = paragraph(f"The result, trial {best.number}, did not keep the limits{over}: {view.result.sentence}.", "bad")
    else:
        why = f"Why this one: {view.result.sentence}."
        verdict = paragraph(f"Result: trial {best.number}, which kept every limit{over}. {_headline(view)} {why}", "good")
    note = '<p id="drawing">The figures are being drawn.</p>\n<noscript><p class="bad">The figures need JavaScript.</p></noscript>\n'
    return f"<header>\n<h1>{escape(view.name)}</h1>\n{paragraph(counts + more + '.', 'faint')}{verdict}{note}</header>\n<main>\n"


def _plants_over(trial: Trial | None) -> str:
    """Of a range of use: on how many of the drawn plants a limit was broken."""
    drawn = {} if trial is None or trial.score is None else trial.score.metrics
    over, plants = drawn.get("violating_plants"), drawn.get("plants")
    return "" if over is None or plants is None else f" ({over:.0f} of {counted(int(plants), 'drawn plant')} over a limit)"


def _headline(view: StudyView) -> str:
    """What the result is worth in the study's own words, beside the start; of a charge without a time as objective also t95."""
    best, start, words = view.tuned, view.start, objective_of_study(view)
    if best is None or best.score is None:
        return ""
    mean = ", the mean of its plants" if view.over_range else ""
    said = f"{_first_upper(words.label)}: {words.text(loss(view, best))} {words.unit}".rstrip() + mean
    if start is not None and start.score is not None and start is not best:
        kept = "kept the limits" if start.feasible else "broke a limit"
        said += f"; {view.start_label}: {words.text(loss(view, start))} {words.unit}".rstrip() + f", which {kept}"
    t95 = best.score.metrics.get("t95_min")
    if not words.unit and t95 is not None:
        before = None if start is None or start.score is None else start.score.metrics.get("t95_min")
        aside = "" if before is None or start is best else f" ({view.start_label}: {before:.2f} min)"
        said += f". 95 % state of charge after {t95:.2f} min{aside}"
    return said + "."


def _first_upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def what_was_tuned(view: StudyView) -> str:
    problem, head = view.problem, study_head(view)
    parts = []
    if problem is not None:
        control, charge = problem.controller, problem.episode
        seed = control.mismatch_seed
        own = "the plant's own" if problem.plant is None else "those of the cell file's circuit, which is another model than the plant"
        belief = own if seed is None else f"those of the cell file, wrong by the factors of mismatch seed {seed}"
        start = "of the range of use" if view.over_range and problem.range and problem.range.soc_start else f"{charge.soc_start:g}"
        facts = [
            ("cell", problem.cell.title),
            ("capacity", f"{problem.cell.capacity_Ah:g} Ah"),
            ("plant", problem.plant_line),
            ("controller's parameters", belief),
            ("estimator", problem.estimator.line),
            ("sampling time, horizon", f"{control.sampling_time_s:g} s, {counted(control.horizon, 'interval')}"),
            (
                "charge",
                f"SOC {start} to {charge.soc_target:g}, at most {charge.steps * control.sampling_time_s / 60:g} min",
            ),
            ("tuner", view.tuner),
        ]
        if problem.cell.pack_line:
            facts.insert(1, ("pack", problem.cell.pack_line))
        if problem.range is not None:
            facts.insert(-1, ("range of use", problem.range.line))
        parts.append(table(("", ""), [(what, (str(value), "long text")) for what, value in facts], kind="facts"))
        if view.remark:
            parts.append(paragraph(f"{problem.cell.title}: {view.remark}", "faint"))
        rows = [(x["name"], f"{x['bound']:g} {x['unit']}", _amount(x["name"], x["tolerance"]), x["kind"]) for x in head["limits"]]
        parts.append(table(("limit", "bound", "tolerance", "in the controller"), rows))
    else:
        parts.append(
            paragraph("The study is not one of battery charging. What an evaluation does is in its configuration, under Provenance.")
        )
        allowed = [(x["label"], _told(x["tolerance"], x["unit"])) for x in head["excesses"]]
        parts += [table(("limit", "tolerance"), allowed)] if allowed else []
    return section("What was tuned", *parts)


def _amount(name: str, value: float, digits: str = ".3g") -> str:
    """A difference of a limit's signal: volts in mV, the others in the unit that the limit's name ends with."""
    factor, unit = (1e3, "mV") if name.endswith("_V") else (1.0, name.rpartition("_")[2])
    if abs(value) <= 1e-9:
        value = 0.0  # the rounding of a held input
    return f"{factor * value:{digits}} {unit}"


def _told(value: float | None, unit: str) -> str:
    return "differs by trial" if value is None else f"{value:.4g} {unit}".rstrip()


def result(view: StudyView, feedback: Score | None = None) -> str:
    """theta and figures of merit of the result beside the start, and the ``feedback`` of an observer that needed no trial."""
    best, start = view.tuned, view.start
    if best is None:
        return ""
    rows: list[tuple[Cell, ...]] = []
    for x, value in zip(study_head(view)["theta"], best.theta, strict=True):
        span = x["upper"] - x["lower"]
        at = "at its bound" if min(value - x["lower"], x["upper"] - value) <= 1e-6 * span else ""
        rows.append((x["entry"], value, x["untuned"], x["unit"], x["lower"], x["upper"], at))
    headings = ("theta", f"trial {best.number}", "untuned", "unit", "lower", "upper", "")
    scores = [start.score if start is not None else None, *([feedback] if feedback is not None else []), best.score]
    figures: list[tuple[Cell, ...]] = []
    for name, words in metrics_of_study(view).items():
        values = [None if score is None else score.metrics.get(name) for score in scores]
        if any(value is not None for value in values):
            figures.append((words.label, *(None if v is None else words.factor * v for v in values), (words.unit, "text")))
    what = "Best theta within the limits" if best.feasible else "theta of the result, which broke a limit"
    other = ["untuned, offset_free"] if feedback is not None else []
    merit = table(("figure of merit", view.start_label, *other, f"trial {best.number}", ("unit", "text")), figures)
    aside = (
        "untuned, offset_free: the controller with an observer that reads the voltage (estimator.kind), with its defaults and no theta, "
        f"run for this page with the seed of trial {best.number}. What it already does is no merit of learning."
    )
    return section(what, beside(table(headings, rows), merit), paragraph(aside, "faint") if other else "", _by_plant(view, best))


def _by_plant(view: StudyView, best: Trial) -> str:
    """The objective and each excess over the drawn plants of the result, the best plant first."""
    try:
        trace = view.range_trace(best)
    except StoreError:
        # The limits, checked again from the traces, say that it is damaged.
        return ""
    if trace is None:
        return ""
    told = objective_of_study(view)
    columns = [(told.label, told.unit, -told.factor, "objective")]
    columns += [(one.label, one.unit, one.factor, f"excess of {one.name}") for one in limits_of_study(view)]
    rows: list[tuple[Cell, ...]] = []
    for label, unit, factor, name in columns:
        values = factor * trace.plants.get(name, np.zeros(0))
        ended = values[np.isfinite(values)]
        if len(ended):
            rows.append((label, *(float(v) for v in np.quantile(ended, (0.0, 0.5, 0.95, 1.0))), (unit, "text")))
    count = len(next(iter(trace.plants.values())))
    return table((f"over {counted(count, 'drawn plant')}", "best", "median", "95 %", "worst", ("unit", "text")), rows)


def limits(view: StudyView) -> str:
    title, judged = "Limits, checked again from the stored traces", view.judged
    if judged is None:
        stored = _stored(view)
        text = "What the limits mean is not in the study's document, so they cannot be judged again. The stored excess of the result:"
        return section(title, paragraph(text), table(("limit", "excess", "tolerance"), stored))
    checks, damaged = {}, []
    for reading in view.readings(t for t in view.trials if t.trace_sha256 is not None):
        if reading.episode is None:
            damaged.append(reading.message)
        else:
            score = None if view.over_range else reading.trial.score
            checks[reading.trial.number] = recheck(judged, reading.episode, score)
    parts = []
    for label, trial in ((view.start_label, view.start), (view.tuned_label, view.tuned)):
        if trial is not None and trial.number in checks:
            parts.append(_check_table(f"{label}, trial {trial.number}", checks[trial.number]))
    wrong = [number for number, found in checks.items() if not all(c.agrees for c in found)]
    text = f"Judged again: {counted(len(checks), 'trial')} with a trace; "
    if wrong:
        parts.append(paragraph(f"{text}in trials {', '.join(map(str, wrong))} the stored score says something else.", "bad"))
    elif view.over_range:
        parts.append(paragraph(f"{text}each trace is that of one drawn plant, the stored excesses are the worst of all of them."))
    else:
        parts.append(paragraph(f"{text}every stored excess is what its trace says."))
    parts += [paragraph(line, "bad") for line in damaged]
    return section(title, *parts)


def _stored(view: StudyView) -> list[tuple[Cell, ...]]:
    score = None if view.tuned is None else view.tuned.score
    out: list[tuple[Cell, ...]] = []
    for limit in limits_of_study(view) if score is not None else []:
        excess = f"{limit.factor * score.excess[limit.name]:.4g} {limit.unit}".rstrip() if score and limit.name in score.excess else None
        out.append((limit.label, excess, _told(limit.tolerance, limit.unit)))
    return out


def _check_table(caption: str, checks: Sequence[LimitCheck]) -> str:
    rows: list[tuple[Cell, ...]] = [
        (
            c.name, f"{c.bound:g} {c.name.rpartition('_')[2]}", f"{c.reached:.5g}", f"{c.at_s / 60:.2f}", _amount(c.name, c.excess, ".4g"),
            _amount(c.name, c.tolerance), c.judged, None if c.true_excess is None else _amount(c.name, c.true_excess, ".4g"),
            ("kept", "good") if c.kept else ("broken", "bad"),
        )
        for c in checks
    ]  # fmt: skip
    headings = ("limit", "bound", "reached", "at (min)", "excess", "tolerance", "judged on", "without noise", "")
    return table(headings, rows, caption)


def violations(view: StudyView) -> str:
    broke = [t for t in view.trials if t.score is not None and not t.feasible]
    title = "Violations during tuning"
    if not broke:
        return section(title, paragraph("No trial went beyond a limit by more than its tolerance."))
    rows: list[tuple[Cell, ...]] = []
    for limit in limits_of_study(view):
        over = [(limit.factor * t.score.excess[limit.name], t.number) for t in broke if t.score is not None and _over(t, limit.name)]
        if over:
            worst, number = max(over)
            said = f"{worst:.4g} {limit.unit}".rstrip()
            rows.append((limit.label, len(over), said, number, min(n for _, n in over), max(n for _, n in over)))
    return section(
        title,
        paragraph(f"{len(broke)} of {counted(len(view.trials), 'trial')} went beyond a limit by more than its tolerance."),
        table(("limit", "trials", "worst excess", "in trial", "first", "last"), rows),
    )


def _over(trial: Trial, name: str) -> bool:
    return trial.score is not None and trial.score.excess.get(name, 0.0) > trial.score.tolerance.get(name, 0.0)


def failures(view: StudyView) -> str:
    failed = [t for t in view.trials if t.status is TrialStatus.FAILED]
    if not failed:
        return section("Failures", paragraph("No trial failed."))
    kinds = Counter((t.ending or "unknown").partition(":")[0] for t in failed)
    by_kind: list[tuple[Cell, ...]] = []
    for kind, count in kinds.most_common():
        last = next(t for t in reversed(failed) if (t.ending or "unknown").partition(":")[0] == kind)
        by_kind.append((kind, count, last.number, (last.ending or "", "long text")))
    return section("Failures", table(("kind", "trials", "last", "what the last one says"), by_kind))


def sensitivities(view: StudyView, moved: Sequence[Sensitivity]) -> str:
    parts = []
    if moved:
        where = "on the drawn plants of the result" if view.over_range else "on the simulated plant at the result"
        text = (
            f"Finite differences {where}, with the seed of its trial: each entry of theta alone is moved by "
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


def provenance(view: StudyView, best: Trial | None, *, reproduced: bool) -> str:
    record = view.record
    rows: list[tuple[Cell, ...]] = [("store", store_name(view.location))]
    if record is not None:
        rows += [("study begun", record.created_at), ("configuration (SHA-256)", record.identity_sha256)]
        rows += [("seed of the study", str(record.identity.get("seed"))), ("trials proposed at a time", str(record.identity.get("batch")))]
    if best is not None:
        rows += [
            (f"trial {best.number}: told", best.told_at or ""),
            ("its seed", str(best.seed)),
            ("its trace (SHA-256)", best.trace_sha256),
        ]
        rows.append(("made with", ", ".join(f"{name} {version}" for name, version in best.provenance.get("versions", {}).items())))
        if reproduced and view.problem is not None:
            off = again(view, best)
            rows.append(("evaluated again now, largest difference", "no score" if off is None else f"{off:.1e}"))
    others = {json.dumps(t.provenance.get("versions"), sort_keys=True) for t in view.trials}
    if len(others) > 1:
        rows.append(("further versions", f"the trials were made with {counted(len(others), 'different set')} of programs"))
    parts = [table(("", ""), [(a, (str(b), "long text")) for a, b in rows], kind="facts")]
    if record is not None:
        text = escape(json.dumps(record.identity, indent=1, ensure_ascii=False))
        parts.append(f"<details>\n<summary>The whole configuration</summary>\n<pre>{text}</pre>\n</details>\n")
    return section("Provenance", *parts)
