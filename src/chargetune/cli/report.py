"""chargetune report."""

from __future__ import annotations

import json
from pathlib import Path

from chargetune.cli.output import beside, console, shown
from chargetune.cli.outputs import Kind, Output, claim
from chargetune.cli.tune import bar
from chargetune.report import figure_names, read_study, save_figures
from chargetune.report.page.evidence_sections import certificate_of
from chargetune.report.page.page import evaluations, report_page
from chargetune.report.study_view import read_studies
from chargetune.runtime.counted import counted
from chargetune.study.files import write_whole

__all__ = ["report_command"]


def report_command(
    location: str,
    *,
    study: str | None,
    out: Path | None,
    figures: Path | None,
    evaluate: bool,
    overwrite: bool,
    as_json: bool,
    certificate: Path | None = None,
) -> None:
    """Write the page, and with ``figures`` the figures of a paper."""
    if study is None:
        names = [view.name for view in read_studies(location)]
        if len(names) != 1:
            raise ValueError(
                f"{shown(location)} has {counted(len(names), 'study', 'studies')}, choose one by --study: {', '.join(names) or '(none)'}"
            )
        study = names[0]
    target = out or beside(location, ".html")
    page = Output("--output", target, Kind.PAGE)
    claim([page], inputs=[location], overwrite=overwrite, folders=False)
    view = read_study(location, study)
    vectors = [] if figures is None else [Output("--figures", figures / f"{stem}.pdf", Kind.PDF) for stem in figure_names(view)]
    claim([page, *vectors], inputs=[location, *([certificate] if certificate else [])], overwrite=overwrite)
    others = [one for one in read_studies(location) if one.name != study and one.trials]
    found = certificate_of(view, certificate or beside(location, "-certificate.json"))
    if certificate is not None and found is None:
        raise ValueError(f"--certificate {certificate}: allowed is a certificate of study {study!r} as it is now")
    with bar(quiet=as_json) as progress:
        task = progress.add_task("sensitivities", total=evaluations(view), note="")
        text = report_page(view, evaluate=evaluate, progress=lambda: progress.advance(task), others=others, certified=found)
        write_whole(target, text)
        progress.remove_task(task)
    drawn = save_figures(location, study, figures, ("pdf",)) if figures is not None else []
    if as_json:
        print(json.dumps({"study": study, "page": str(target), "figures": [str(f) for f in drawn]}))  # noqa: T201
        return
    console().print(f"page {target}" + "".join(f"\nfigure {f}" for f in drawn), markup=False, soft_wrap=True)
