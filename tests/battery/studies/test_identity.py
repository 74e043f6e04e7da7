"""What a study is recognised by: the configuration that is stored, and studies of the released program that go on."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from chargetune.battery.studies.open_study import open_study
from chargetune.battery.studies.study_file import Config, load_config, problem_of_document
from chargetune.report.page.page import report_page
from chargetune.report.study_view import read_study
from chargetune.study.identity import StudyError
from chargetune.study.serialization import canonical_json, sha256
from chargetune.study.store.store import Store

pytestmark = pytest.mark.usefixtures("virtual_machine")

ROOT = Path(__file__).parents[3]
EXAMPLES = ROOT / "examples"
# Written by the released program, schema 2: a study of three trials for each of its tuners, "safe" that of "twin" with [safety].
RELEASED = ROOT / "tests" / "study" / "store" / "data" / "schema-2-studies.db"
# Its examples that are other studies today.
CHANGED = Path(__file__).parent / "data" / "released"
# SHA-256 of the stored configuration of each of its examples, as it wrote it.
DOCUMENTS = {
    "dfn_fast_charge": "6bc1912dd6e8463f55a2f6bc04e885181c0e397264cd70ef1b61bdc899d29bef",
    "dfn_fast_charge_cold": "a31b45c219fe023c0d24c1e24b925826ec795a3e16b9e88eee899f5f17a8e71e",
    "dfn_safe_charge": "0408cb0bf26b3b7a24fda54bc8a7b1968a28f60c77d1e7d0bd5f3dccb1be4ce7",
    "fast_charge": "42b8e3c40a6559e86c1f9c5664ba0752938c0ef9059fa976ba58642bead68586",
    "reference_backoff": "9886c68186fc932ac7a82b85d871015fbb523a6a67099325276963156a643bb2",
    "reference_exact": "e796b450eb281064d6840b16679548156b8460e1ccd3ee59839215c9be5e1d48",
    "reference_model": "c4dddd72ff2ef490db8f3ff62cd61b7b6d5bdce8411362b972b5b93fae2dc84a",
    "safe_charge": "08da2526b4fa763d605b88165b35a536224d4ba73207fd5b217f06b217887b31",
}
# The file of each study, but for its name and tuner.
STUDY = """
[study]
name = "NAME"
tuner = "TUNER"
trials = 3
[controller]
mismatch_seed = 1
[episode]
steps = 40
soc_start = 0.6
[theta.R0]
scale = true
lower = 0.1
upper = 4.0
"""
SAME = {
    "default": "default",
    "ei": "ei",
    "sobol": "sobol",
    "composite": "composite",
    # By its name of then.
    "envelope": "iterative_learning",
}


@pytest.fixture
def released(tmp_path):
    return Path(shutil.copy(RELEASED, tmp_path / "s.db"))


def config_of(folder, name, tuner, more=""):
    path = folder / f"{name}.toml"
    path.write_text(STUDY.replace("NAME", name).replace("TUNER", tuner) + more)
    return load_config(path)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_stored_configuration_of_an_example_is_that_of_the_released_program(name, tmp_path):
    for file in (*EXAMPLES.glob("okane2022*.toml"), CHANGED / f"{name}.toml"):
        if file.exists():
            shutil.copy(file, tmp_path)
    path = tmp_path / f"{name}.toml"
    path = path if path.exists() else EXAMPLES / path.name
    document = load_config(path).document(path.parent)
    assert sha256(canonical_json(document, name)) == DOCUMENTS[name]
    # Sorted as JSON is, it is the same problem again.
    assert problem_of_document(json.loads(canonical_json(document, name))) == load_config(path).problem(path.parent)


@pytest.mark.parametrize("name", SAME)
def test_a_study_of_the_released_program_goes_on(released, tmp_path, name):
    config = config_of(tmp_path, name, SAME[name])
    with Store(released) as store, open_study(store, config) as study:
        assert len(study.trials()) == 3
        assert "problem" not in json.dumps(study.record.identity)
        (waiting,) = study.ask_batch(4)
        assert waiting.number == 3


@pytest.mark.parametrize(("name", "more"), [("twin", ""), ("safe", "[safety]\nprobability = 0.95\n")])
def test_a_tuner_that_has_other_settings_now_says_so_and_goes_on_when_that_is_accepted(released, tmp_path, name, more):
    config = config_of(tmp_path, name, "twin", more)
    with Store(released) as store:
        with pytest.raises(StudyError, match=r"tuner\.pool: 32 -> \(absent\)\n.*tuner\.settings: \(absent\) -> ") as refused:
            open_study(store, config)
        assert "accept" in str(refused.value)
        assert "config" not in str(refused.value).split("something else")[1]
        with open_study(store, config, accept_changed=True) as study:
            assert len(study.trials()) == 3


def test_studies_of_the_released_program_are_read_and_reported(released):
    Store(released).close()
    for name in (*SAME, "twin", "safe"):
        view = read_study(released, name)
        assert (len(view.trials), view.problem.episode.steps) == (3, 40)
        assert view.tuner == SAME.get(name, "twin")
        assert name in report_page(view, evaluate=False)


def test_a_damaged_identity_stays_as_it_is(released):
    with closing(sqlite3.connect(released)) as connection:
        connection.execute("UPDATE study SET identity = '{' WHERE name = 'twin'")
        connection.commit()
    Store(released).close()
    with closing(sqlite3.connect(released)) as connection:
        kept = dict(connection.execute("SELECT name, identity FROM study").fetchall())
    assert kept["twin"] == "{"
    assert json.loads(kept["envelope"])["tuner"]["type"] == "IterativeLearning"


# What is refused names file, field, value and what is allowed.
REFUSED = [
    ("[controller]\nhorizn = 5", "controller.horizn is not a known key"),
    ("[controller]\nhorizon = 5.0", "controller.horizon = 5.0, allowed is a whole number"),
    ("[controller]\nhorizon = 51", "controller: horizon = 51, allowed is an integer in [1, 50]"),
    ("[controller]\nsampling_time_s = true", "controller.sampling_time_s = true, allowed is a number"),
    ("[controller]\nsampling_time_s = 1979-05-27", "controller.sampling_time_s = a date, allowed is a number"),
    ("[controller]\nsampling_time_s = nan", "controller: sampling_time_s = nan, allowed is [0.001, 3600] s"),
    ("[controller]\noverpotential = 'none'", "controller.overpotential = 'none', allowed is 'model' or 'exact'"),
    ("[estimator.kalman]\nvoltage_sd_V = 0.0", "estimator.kalman: kalman: voltage_sd_V = 0.0, allowed is (0, 100]"),
    ("[limits]\nhard = 'voltage_max_V'", "limits.hard = 'voltage_max_V', allowed is a list"),
    (
        "[limits]\nhard = ['anode_min_V']",
        "limits: hard names anode_min_V, allowed are the limits that are set: voltage_max_V, voltage_min_V",
    ),
    ("[sensors]\nvoltage_noise_sd_V = -1.0", "sensors: voltage_noise_sd_V = -1.0, allowed is [0, 0.5] V (was it given in mV?)"),
    ("[theta.R0]\nlower = 2.0", "theta.R0: resistance ratio: lower = 2.0, allowed is [0.001, 0.999]"),
    ("[theta.anode_backoff]\nlower = -5.0\nupper = 0.1", "theta: anode_backoff: lower = -5.0, allowed is [-0.5, 0] V"),
    ("[theta.anode_backoff]\nupper = 0.1", "theta.anode_backoff.lower is not given, and is needed"),
    ("[safety]\nprobability = 0.2", "safety: probability = 0.2, allowed is [0.5, 1)"),
    ("[plant]\nmodel = 'P2D'", "plant.model = 'P2D', allowed is 'SPM', 'SPMe' or 'DFN'"),
    ("controller = 3", "controller = 3, allowed is a table [controller] with "),
]


@pytest.mark.parametrize(("text", "said"), REFUSED)
def test_a_study_file_is_refused_by_file_field_value_and_what_is_allowed(tmp_path, text, said):
    path = tmp_path / "study.toml"
    path.write_text(text)
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - what it says is checked below
        load_config(path)
    assert str(refused.value).startswith(f"{path}: {said}")


def test_a_file_without_anything_is_the_default_problem():
    problem = Config().problem()
    assert (problem.current_max_A, problem.voltage_max_V, problem.voltage_min_V) == (6.0, 4.2, 2.5)
    assert (problem.plant, problem.safety, problem.controller.mismatch_seed) == (None, None, None)


def test_a_stored_number_that_another_replaced_is_refused_with_what_did():
    """Its value says nothing about the other's, so that the stored trials are not those of today's controller."""
    document = json.loads(json.dumps(load_config(EXAMPLES / "offset_free.toml").document(EXAMPLES)))
    assert problem_of_document(document).estimator.kind == "offset_free"
    settings = document["estimator"]["offset_free"]
    settings["resistance_rate"] = 2.0
    del settings["resistance_drift"]
    with pytest.raises(
        ValueError, match=r"^estimator\.offset_free\.resistance_rate = 2\.0 is no key any more; resistance_drift replaced it"
    ):
        problem_of_document(document)
