"""Bad use of the commands: refused with exit code 2 and one message, before a store is made."""

import json

import pytest

from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

STUDY = study_text(study={"name": "NAME", "trials": 2}, controller={"mismatch_seed": 1})


@pytest.fixture
def chargetune(chargetune_here):
    """Exit code, stdout, stderr on one line."""

    def run(*arguments):
        code, out, err = chargetune_here(*arguments)
        return code, out, " ".join(err.split())

    return run


def write(folder, name="a study", steps=60):
    path = folder / "study.toml"
    path.write_text(STUDY.replace("NAME", name).replace("steps = 60", f"steps = {steps}"))
    return path


@pytest.mark.parametrize("option", ["--workers=0", "--workers=-1", "--workers=two", "--trials=0", "--trials=-5", "--trials=1.5"])
def test_bad_numbers(chargetune, tmp_path, option):
    code, _, said = chargetune("tune", write(tmp_path), "--store", tmp_path / "s.sqlite", option)
    assert code == 2
    assert f"Invalid value for '{option.partition('=')[0]}': Input should be " in said
    assert "greater than or equal to 1" in said or "a valid integer" in said
    assert not (tmp_path / "s.sqlite").exists()


@pytest.mark.parametrize("name", ["../../etc/passwd", "<script>alert(1)</script>", "a/b", "..", "C:\\\\x"])
def test_bad_names(chargetune, tmp_path, name):
    code, _, said = chargetune("tune", write(tmp_path, name), "--store", tmp_path / "s.sqlite")
    assert code == 2
    assert "study name = " in said
    assert "allowed are 1 to 100 letters, digits" in said
    assert sorted(p.name for p in tmp_path.iterdir() if "sqlite" not in p.name) == ["study.toml"]


def test_a_changed_file_is_refused_unless_asked(chargetune, tmp_path):
    store = tmp_path / "s.sqlite"
    assert chargetune("tune", write(tmp_path), "--store", store)[0] == 0
    path = write(tmp_path, steps=70)
    code, _, said = chargetune("tune", path, "--store", store, "--trials", 3)
    assert code == 2
    assert "config.episode.steps: 60 -> 70" in said
    assert "--accept-changed" in said
    code, out, _ = chargetune("tune", path, "--store", store, "--trials", 3, "--accept-changed", "--json")
    assert code == 0
    assert json.loads(out)["trials"] == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[objective]\nverdict_samples = 1000\n", "objective.verdict_samples = 1000, allowed is an integer in [1, 360]"),
        (
            "[objective]\ncharge_time_to_soc = 0.8\n[episode]\nsoc_target = 0.5\n",
            "objective.charge_time_to_soc = 0.8, allowed is (0.05, 0.5] from episode.soc_start to soc_target",
        ),
        ("[limits]\nvoltage_max_V = 9.0\n", "limits.voltage_max_V = 9.0, allowed is (2.5, 4.2] V"),
        ("[limits]\ncurrent_min_A = 3.0\ncurrent_max_A = 2.0\n", "limits.current_min_A = 3 must be less than current_max_A = 2"),
    ],
)
def test_what_tables_say_of_each_other_names_file_and_table(text, said, refused, tmp_path):
    path = tmp_path / "k.toml"
    path.write_text(text + "[theta.backoff]\nnodes = 2\n")
    for command in (["check", path], ["tune", path, "--store", tmp_path / "s.sqlite"], ["simulate", path]):
        assert refused(*command).startswith(f"chargetune: {path}: {said}")


def test_what_a_table_names_is_told_with_the_file_and_its_key(refused, tmp_path):
    path, theta = tmp_path / "k.toml", "[theta.backoff]\nnodes = 2\n"

    def said(text, *command):
        path.write_text(text + theta)
        return refused(*(command or ("check", path)))

    for table, key in (('[cell]\nfile = "none.toml"\n', "cell.file"), ('[plant]\ncell = "none.toml"\n', "plant.cell")):
        assert said(table).startswith(f"chargetune: {path}: {key} = {tmp_path / 'none.toml'}: No such file")
    safety = f"chargetune: {path}: [safety] is given with tuner = 'default', allowed is tuner = 'twin'"
    assert said("[safety]\n").startswith(safety)
    assert said("[safety]\n", "tune", path, "--store", tmp_path / "s.sqlite").startswith(safety)
    assert "(did you mean 'Chen2020'?)" in said('[plant]\nmodel = "SPM"\nparameters = "chen2020"\n')
    assert "--theta has 3 values, allowed is one for each of these 2: backoff_V[0]," in said("", "simulate", path, "--theta", "1,2,3")
