"""check, certify and verify as a user runs them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import tuned

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.identification.pulse_fit import cell_toml
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

EXAMPLES = Path(__file__).parents[2] / "examples"

STUDY = study_text(
    study={"name": "quick", "trials": 6},
    controller={"mismatch_seed": 1},
    episode={"steps": 100, "soc_start": 0.4, "soc_target": 0.8},
    sensors={"voltage_noise_sd_V": 0.001},
)


@pytest.fixture
def study(tmp_path):
    def write(controller=""):
        path = tmp_path / "study.toml"
        path.write_text(STUDY.replace("[controller]", f"[controller]\n{controller}"))
        return path

    return write


def test_check_is_silent_on_an_example(chargetune_here, tmp_path):
    code, out, _ = chargetune_here("check", EXAMPLES / "reference_backoff.toml", "--json", "--figures", tmp_path / "f")
    assert code == 0
    told = json.loads(out)
    setting = {"plant": "its own circuit, simulated", "pack": "", "note": told["note"]}
    assert told == {"file": str(EXAMPLES / "reference_backoff.toml"), "findings": [], "figures": [], **setting}
    text = chargetune_here("check", EXAMPLES / "reference_backoff.toml")[1]
    assert "nothing found" in text
    assert f"note: {told['note']}\n" in text


@pytest.mark.parametrize(("kind", "read"), [("open_loop", False), ("exact", False), ("kalman", True), ("offset_free", True)])
def test_check_says_that_a_measured_voltage_is_not_read(chargetune_here, tmp_path, kind, read):
    path = tmp_path / "s.toml"
    path.write_text(study_text(episode={"steps": 60, "soc_start": 0.4, "soc_target": 0.7}) + f'[estimator]\nkind = "{kind}"\n')
    _, out, _ = chargetune_here("check", path, "--json")
    note = json.loads(out)["note"]
    if read:
        assert note is None
    else:
        assert f"estimator.kind = '{kind}' does not read it" in note
        assert "kind = 'offset_free' or 'adaptive' reads it" in note


def test_check_tells_that_there_is_nothing_to_tune(chargetune_here):
    code, out, _ = chargetune_here("check", EXAMPLES / "reference_model.toml")
    assert code == 1
    assert "error no-theta: theta is empty" in out
    assert "add a table [theta.backoff]" in out


def test_check_tells_an_error_with_its_figure_and_exit_code(chargetune_here, study, tmp_path):
    code, out, _ = chargetune_here("check", study("penalty_per_V = 0.01"), "--json", "--figures", tmp_path / "f")
    told = json.loads(out)
    assert code == 1
    assert next((f["code"], f["severity"]) for f in told["findings"]) == ("inexact-penalty", "error")
    assert told["findings"][0]["numbers"]["penalty"] == 0.01
    assert all(f["message"] and f["remedy"] for f in told["findings"])
    assert next(Path(f).name for f in told["figures"]) == "1-inexact-penalty.png"
    assert all(Path(f).read_bytes().startswith(b"\x89PNG") for f in told["figures"])
    code, out, _ = chargetune_here("check", study("penalty_per_V = 0.01"))
    assert code == 1
    assert "error inexact-penalty: the penalty of voltage_V" in out
    assert "what to do: a penalty" in out


def test_a_warning_is_no_failure_and_entries_are_printed_with_their_brackets(chargetune_here, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(STUDY.replace("[theta.backoff]\nnodes = 3\nlower_V = 0.0\nupper_V = 0.2\n", "[theta.current_limit]\n"))
    code, out, _ = chargetune_here("check", path)
    assert code == 0
    assert "current_limit[0]" in out
    assert "0 errors, 1 warning" in out


def test_a_theta_that_is_declared_safe_is_checked(chargetune_here, study):
    assert chargetune_here("check", study(), "--safe", "0.2,0.2,0.2")[0] == 0
    code, out, _ = chargetune_here("check", study(), "--safe", '{"backoff_V": [0, 0, 0]}', "--json")
    assert code == 1
    assert [f["code"] for f in json.loads(out)["findings"]] == ["unsafe-start"]
    code, _, err = chargetune_here("check", study(), "--safe", "1,2")
    assert code == 2
    assert "--safe has 2 values" in err


def test_tune_stops_at_an_error_before_it_makes_a_store_unless_forced(chargetune_here, study, tmp_path):
    store = tmp_path / "s.sqlite"
    code, _, err = chargetune_here("tune", study("penalty_per_V = 0.01"), "--store", store)
    assert code == 2
    assert "inexact-penalty" in err
    assert "--force" in err
    assert not store.exists()
    code, out, err = chargetune_here("tune", study("penalty_per_V = 0.01"), "--store", store, "--trials", 1, "--force", "--json")
    assert code == 0
    assert json.loads(out)["trials"] == 1
    assert "inexact-penalty" in err


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    return tuned(tmp_path_factory.mktemp("studied"), STUDY)


@pytest.fixture
def store(tmp_path, studied):
    path = tmp_path / "s.sqlite"
    path.write_bytes(studied)
    return path


def test_certify_and_verify(chargetune_here, store, tmp_path):
    target = tmp_path / "out" / "c.json"
    some = ("--episodes", 30, "--resistance", 0.01, "--growth", 0.02, "--soc-start", 0.3, 0.5)
    code, out, _ = chargetune_here("certify", store, *some, "-o", target, "--json")
    assert code == 0
    told = json.loads(out)
    assert told == json.loads(target.read_text())
    assert told["figures"]["episodes"] == 30
    use = told["range"]
    assert (told["origin"]["study"], use["resistance"], use["growth"], use["soc_start"]) == ("quick", 0.01, 0.02, [0.3, 0.5])
    # What no option changes is the default.
    assert (use["capacity"], use["fade"], use["ambient_K"]) == (0.02, 0.05, None)
    assert told["origin"]["range"] == "the default, since the study has no table [range], with other soc_start, resistance, growth"
    assert told["origin"]["trials"] == 6
    assert {p.suffix for p in target.parent.iterdir()} == {".json", ".npz", ".png"}
    # The theta is that of the best feasible trial.
    code, out, _ = chargetune_here("show", store, "--json")
    best = json.loads(out)["studies"][0]["best"]
    assert list(told["theta"].values()) == best["theta"]

    assert chargetune_here("certify", store, "--episodes", 1, "--trial", 0, "-o", tmp_path / "first.json")[0] == 0
    first = json.loads((tmp_path / "first.json").read_text())
    assert (first["origin"]["trial"], set(first["theta"].values())) == (0, {0.0})

    code, out, _ = chargetune_here("verify", target)
    assert code == 0
    assert "every figure is what the traces give" in out
    again = tmp_path / "again.json"
    assert chargetune_here("certify", store, *some, "--workers", 2, "-o", again)[0] == 0
    assert json.loads(again.read_text())["figures"] == told["figures"]
    traces = [path.with_name(json.loads(path.read_text())["traces"]["file"]) for path in (target, again)]
    assert traces[0].read_bytes() == traces[1].read_bytes()

    told["figures"]["violations"] += 1
    target.write_text(json.dumps(told))
    code, out, _ = chargetune_here("verify", target, "--json")
    assert code == 1
    assert {d["name"] for d in json.loads(out)["differences"]} == {"sha256", "violations"}
    assert "violations: stated" in chargetune_here("verify", target)[1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--study", "other"), "other"),
        (("--trial", "6"), "--trial 6: study 'quick' has no such trial, allowed is 0 to 5"),
        (("--confidence", "1"), "--confidence = 1"),
        (("--resistance", "-1"), "range: resistance = -1"),
        (("--soc-start", "0.5", "0.4"), "range: soc_start = [0.5, 0.4], allowed is [lowest, highest]"),
        (("--soc-start", "0.1", "0.9"), "range: soc_start = [0.1, 0.9], allowed is less than the SOC that is charged to, 0.8"),
        (("--ambient-K", "280", "300"), "range: ambient_K = [280.0, 300.0], allowed only for a cell with a [thermal] table"),
        (("-o", "c.txt"), "c.txt"),
        (("--cells", "nowhere"), "cells = 'nowhere', allowed is a folder of cell files"),
        (("--node-correlation", "1"), "range: node_correlation = 1.0, allowed is [0, 0.99]"),
    ],
)
def test_certify_refuses(arguments, words, chargetune_here, store):
    code, _, err = chargetune_here("certify", store, *arguments)
    assert code == 2
    assert words in err


def test_a_theta_is_certified_for_other_cells_than_it_was_tuned_for(chargetune_here, store, tmp_path):
    for number, factor in enumerate((0.99, 1.0, 1.02)):
        cell = replace(default_cell(), name=f"cell {number}", R0_ohm=tuple(factor * np.array(default_cell().R0_ohm)))
        (tmp_path / f"{number}.toml").write_text(cell_toml(cell))
    # Nothing that is read is written, whatever it is called.
    code, _, err = chargetune_here("certify", store, "--cells", tmp_path, "-o", tmp_path / "1.toml", "--overwrite")
    assert code == 2
    assert "1.toml" in err
    target = tmp_path / "c.json"
    code, out, _ = chargetune_here("certify", store, "--cells", tmp_path, "--episodes", 3, "-o", target, "--json")
    assert code == 0
    told = json.loads(out)
    assert told["range"]["cells"] == tmp_path.name
    assert "3 cells: cell 0, cell 1, cell 2" in told["drawn"]
    assert chargetune_here("verify", target)[0] == 0


def test_a_study_without_a_trial_that_kept_the_limits_is_not_certified(chargetune_here, study, tmp_path):
    store = tmp_path / "s.sqlite"
    assert chargetune_here("tune", study(), "--store", store, "--trials", 1)[0] == 0
    code, _, err = chargetune_here("certify", store)
    assert code == 2
    assert "broke a limit (no trial kept every limit, and it came closest" in err
    code, _, err = chargetune_here("verify", study())
    assert code == 2
    assert "is not JSON" in err
