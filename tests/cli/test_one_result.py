"""Each command and page names the same trial as the result of a study, also where the tuner believes another one than was measured best."""

import asyncio
import json
from dataclasses import dataclass, replace

import pytest
from commands import chargetune

from chargetune.battery.case_study.reproduce import seed_run
from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.studies.bdf_export import export
from chargetune.battery.studies.campaign import load_campaign, standings
from chargetune.battery.studies.open_study import open_study
from chargetune.report.page.page import report_page
from chargetune.report.page.trial_rows import study_summary
from chargetune.report.study_view import read_studies, read_study
from chargetune.study.result import Reason
from chargetune.study.store.store import Store
from chargetune.study.trial import best_feasible
from chargetune.web.events import study_events
from chargetune.web.watch import StoreWatch
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

NAME = "study seed 0"
STUDY = study_text(
    study={"name": NAME, "trials": 6},
    controller={"mismatch_seed": 1},
    episode={"steps": 100, "soc_start": 0.4, "soc_target": 0.8},
    limits={"tolerance_V": 0.03},
    sensors={"voltage_noise_sd_V": 0.001},
)
CAMPAIGN = """
[campaign]
configs = ["study.toml"]
seeds = [0]
"""


@dataclass(frozen=True)
class Believes:
    """Believes one trial best, and proposes nothing."""

    place: int

    def ask(self, space, trials, n=1):
        raise AssertionError("all trials are told")

    def best(self, space, trials):
        return self.place


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    return tmp_path


def shown(path, folder, *, kept=True):
    """The number of the result by every way in which it is told."""
    out = folder / "out"
    told = {}
    tuned = json.loads(chargetune("tune", folder / "study.toml", "--store", path, "--out", out, "--json").stdout)
    told["tune"], told["tune, result"] = tuned["tuned"]["trial"], tuned["result"]["trial"]
    told["summary.json"] = json.loads((out / "summary.json").read_text())["tuned"]["trial"]
    (study,) = json.loads(chargetune("show", path, "--json").stdout)["studies"]
    told["show, result"] = study["result"]["trial"]
    one = json.loads(chargetune("show", path, "--study", NAME, "--json").stdout)
    told["show one, result"] = one["result"]["trial"]
    told["compare"] = json.loads(chargetune("compare", folder / "study.toml", "--store", path, "--row", "tuned", "--json").stdout)[
        "result"
    ]["trial"]
    told["report"] = read_study(path, NAME).tuned.number
    page = report_page(read_study(path, NAME), evaluate=False)
    told["page"] = told["report"] if f"esult{':' if kept else ','} trial {told['report']}, " in page else None
    (view,) = read_studies(path)
    told["web, list"] = study_summary(view)["result"]["trial"]
    told["web, study"] = asyncio.run(first_trials(path))["tuned"]
    entries = load_campaign(folder / "campaign.toml")
    with Store(path, read_only=True) as store:
        told["campaign"] = standings(store, entries)[NAME].best.number
        told["reproduce"] = seed_run(store, NAME).tuned.number
        export(store, out, form="csv")
    (about,) = out.glob("*/study.json")
    told["export"] = json.loads(about.read_text())["result"]["trial"]
    if kept:
        certificate = chargetune("certify", path, "--episodes", 2, "--workers", 1, "-o", out / "c.json", "--json").stdout
        told["certify"] = json.loads(certificate)["origin"]["trial"]
        told["show"], told["show one"] = study["best"]["number"], one["best"]["number"]
        told["web, best"] = study_summary(view)["best"]
    return told


async def first_trials(path):
    async for event in study_events(StoreWatch(path), 1):
        kind, data = event.decode().strip().split("\n")
        if kind == "event: trials":
            return json.loads(data.removeprefix("data: "))
    return None


def test_the_believed_one_is_the_result_everywhere(folder):
    path = folder / "s.sqlite"
    (entry,) = load_campaign(folder / "campaign.toml")
    with Store(path) as store, open_study(store, entry.config, entry.folder) as study:
        study.advance(Evaluation(entry.config.problem(entry.folder)), 6)
        trials = study.trials()
        measured = best_feasible(trials)
        believed = best_feasible(t for t in trials if t != measured)
        found = replace(study, tuner=Believes(believed.number)).result()
    assert found.reason is Reason.BELIEVED
    told = shown(path, folder)
    assert told == dict.fromkeys(told, believed.number)
    assert believed.number != measured.number
    said = " ".join(chargetune("show", path, "--study", NAME).stdout.split())
    assert f"the result is trial {believed.number}: the tuner believes it best from all traces" in said
    # A named trial is certified instead.
    named = chargetune("certify", path, "--episodes", 2, "--trial", measured.number, "-o", folder / "n.json", "--json").stdout
    assert json.loads(named)["origin"]["trial"] == measured.number


def test_a_real_tuner_that_believes(folder):
    text = STUDY.replace('"sobol"', '"composite"').replace("tolerance_V = 0.03", "tolerance_V = 0.0005")
    (folder / "study.toml").write_text(text)
    path = folder / "s.sqlite"
    chargetune("tune", folder / "study.toml", "--store", path, "--json")
    kept = read_study(path, NAME).result.kept is not None
    told = shown(path, folder, kept=kept)
    assert len(set(told.values())) == 1, told


def test_where_no_trial_kept_the_limits_the_closest_is_named_and_not_certified(folder):
    path = folder / "s.sqlite"
    (folder / "study.toml").write_text(STUDY.replace("tolerance_V = 0.03", "tolerance_V = 0.0").replace("upper_V = 0.2", "upper_V = 0.001"))
    told = shown(path, folder, kept=False)
    assert len(set(told.values())) == 1
    (study,) = json.loads(chargetune("show", path, "--json").stdout)["studies"]
    assert (study["best"], study["result"]["reason"]) == (None, "closest")
    said = " ".join(chargetune("certify", path, code=2).stderr.split())
    assert f"trial {told['tune']}, broke a limit (no trial kept every limit, and it came closest" in said
