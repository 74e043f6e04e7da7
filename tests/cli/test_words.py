"""Tables and summaries have the study's own limits, objective and figures, in their own units, within 80 columns."""

import io
import json
from dataclasses import replace

import pytest
from rich.console import Console

from chargetune.battery.baselines.comparison import Row
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.settings import SafetySettings, SensorSettings
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.charging.wording import METRIC_WORDS, limit_words, metric_words, objective_words
from chargetune.cli.compare import _table as _compare_table
from chargetune.cli.output import metrics_table, number
from chargetune.cli.show import show_command
from chargetune.cli.tune import _start_label
from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.study.serialization import space_to_json
from chargetune.study.store.store import Store
from chargetune.study.trial import Trial
from charging_problems import changed, charging_problem

NOISY = SensorSettings(voltage_noise_sd_V=0.002)


def printed(table):
    screen = Console(width=80, record=True, file=io.StringIO())
    screen.print(table)
    return screen.export_text()


def score(objective, excess, tolerance, **metrics):
    return Score(objective, objective, excess, tolerance, metrics)


@pytest.fixture(scope="module")
def problem():
    return replace(changed(charging_problem(default_cell()), charge_time_to_soc=0.8, verdict_samples=5), sensors=NOISY)


def test_a_noisy_verdict_says_what_was_judged_and_what_was_seen(problem):
    one = score(-0.4, {"voltage_max_V": 2e-4, "voltage_min_V": -1.0}, {"voltage_max_V": 0.003, "voltage_min_V": 0.003}, overshoot_mV=4.3)
    lines = printed(metrics_table({"this run": one}, problem)).splitlines()
    judged = next(line for line in lines if "as judged (moving mean of 5)" in line)
    largest = next(line for line in lines if "largest sample" in line)
    assert judged.split()[-3:] == ["0.20", "3", "mV"]
    assert largest.split()[-2:] == ["4.30", "mV"]
    assert next(line for line in lines if line.startswith("objective: time to 80 % SOC")).split()[-2:] == ["24.00", "min"]
    assert max(map(len, lines)) <= 80


def test_compare_has_no_column_of_dashes_and_no_negative_zero(problem):
    scored, episode, _ = evaluate(problem, None, 0)
    lines = printed(_compare_table([Row("nominal", episode, scored, {}), Row("lost", episode, None, {})])).splitlines()
    assert "over" in lines[0]
    assert not {"anode", "max"} & set(lines[0].split())
    assert [number(v) for v in (-0.001, -0.0, 0.006, None)] == ["0.00", "0.00", "0.01", "-"]


def test_a_time_that_was_not_reached_is_no_time(problem):
    words = objective_words(problem)
    assert (words.short, words.unit, words.most) == ("t80", "min", 60.0)
    assert words.text(0.4) == "24.00"
    # 1 + z* - z_K is the loss of a charge that ends below z*.
    assert words.text(1.1) == "> 60"


def test_an_objective_over_a_range_says_of_which_plants_it_is(problem):
    for quantile, label in ((None, ""), (0.9, ", 90 % quantile of the plants"), (1.0, ", slowest plant")):
        over = replace(problem, range=ChargingRangeSettings(resistance=0.1, objective_quantile=quantile))
        assert objective_words(over, "range").label == f"time to 80 % SOC{label}"
        # A charge of one cell is no quantile of anything.
        assert objective_words(over, "twin").label == "time to 80 % SOC"


@pytest.mark.parametrize(
    ("name", "label", "unit", "factor"),
    [
        ("voltage_max_V", "voltage over 4.2 V", "mV", 1e3),
        ("temperature_max_K", "temperature over 318 K", "K", 1.0),
        ("anode_min_V", "anode potential under 0.01 V", "mV", 1e3),
    ],
)
def test_limits_in_their_own_words(problem, name, label, unit, factor):
    from chargetune.battery.charging.limits import Limit

    bounds = {"voltage_max_V": 4.2, "temperature_max_K": 318.0, "anode_min_V": 0.01}
    words = limit_words(problem, Limit(name, bounds[name], 0.001))
    assert (words.label, words.unit, words.factor) == (label, unit, factor)


def test_every_figure_of_a_charge_has_words_and_others_keep_theirs(problem):
    scored, _, _ = evaluate(problem, None, 0)
    assert set(scored.metrics) <= set(METRIC_WORDS)
    assert metric_words("peak_tilt_rad") == ("peak tilt", "rad")
    assert metric_words("cost") == ("cost", "")


def test_only_theta_0_is_untuned():
    problem = charging_problem(default_cell(), R0=ResistanceRatio(0.1, 4.0))
    space = problem.space
    assert _start_label(problem, [Trial(0, tuple(space.default))]) == "untuned"
    assert _start_label(problem, [Trial(0, tuple(space.upper))]) == "trial 0"
    safe = replace(problem, safety=SafetySettings())
    assert _start_label(safe, [Trial(0, tuple(space.upper))]) == "cautious start"
    # Over a range the first theta is chosen for all of it.
    over = replace(safe, range=ChargingRangeSettings(resistance=0.1))
    assert _start_label(over, [Trial(0, tuple(space.upper))]) == "trial 0"


@pytest.fixture
def quadrotor(tmp_path):
    """A study of another system with a limit, a figure of its own and a theta of two entries."""
    path = tmp_path / "quad.sqlite"
    space = ParameterSpace((Parameter("gain", 0.1, 10.0, 1.0), Parameter("mass_kg", 0.5, 2.0, 1.0, unit="kg")))
    with Store(path) as store:
        record = store.add_study("quad", {"config": {}, "space": space_to_json(space), "tuner": {}, "seed": 0, "batch": 1})
        for n, over in enumerate((0.066, 0.0044, 0.0051)):
            store.add_trials(record.id, [Trial(n, (1.0 + n, 1.25))])
            one = score(-0.189 + 0.02 * n, {"height": over}, {"height": 0.005}, peak_tilt_rad=0.25 + n)
            store.finish_trial(record.id, n, score=one, ending="done", trace=None, provenance={})
    return path


def test_show_of_one_study_needs_no_name_and_has_its_own_figures(quadrotor, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    show_command(str(quadrotor), study=None, as_json=False)
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert "peak tilt" in text
    assert "t80" not in text
    assert "t95" not in text
    marked = [line.split() for line in lines if " * " in line]
    assert [(line[0], line[-1]) for line in marked] == [("1", "kept")]
    assert {"2", "1.25", "-0.169", "0.0044"} <= set(marked[0])
    # 5.1 mm are broken and 4.4 mm kept, by a tolerance that is told.
    assert "height beyond its limit 0.005" in text
    assert max(map(len, lines[:6])) <= 80
    show_command(str(quadrotor), study=None, as_json=True)
    assert json.loads(capsys.readouterr().out)["studies"][0]["best"]["number"] == 1
