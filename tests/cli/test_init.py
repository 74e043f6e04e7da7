"""A first study file, as a user gets it."""

import re
import tomllib
from pathlib import Path

from commands import chargetune

from chargetune.battery.studies.study_file import load_config

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_it_writes_a_study_that_reads_the_voltage_and_has_a_range(tmp_path):
    path = tmp_path / "mine.toml"
    out = chargetune("init", path)
    assert f"next: chargetune check {path}" in out.stdout
    problem = load_config(path).problem(tmp_path)
    assert problem.estimator.kind == "offset_free"
    assert problem.range is not None
    assert problem.space.dimension > 0


def test_it_overwrites_nothing(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("mine")
    for more in ([], ["--overwrite"]):
        out = chargetune("init", path, *more, code=2)
        assert "there is a text file of this name" in out.stderr
    assert path.read_text() == "mine"
    path.write_text("[study]\nseed = 1\n")
    assert "exists; --overwrite replaces it" in chargetune("init", path, code=2).stderr
    chargetune("init", path, "--overwrite")
    assert "[range]" in path.read_text()


def test_the_cell_file_is_found_from_where_the_study_lies(tmp_path):
    folder = tmp_path / "studies"
    folder.mkdir()
    (tmp_path / "cell.toml").write_text((EXAMPLES / "okane2022.toml").read_text())
    chargetune("init", folder / "mine.toml", "--cell", tmp_path / "cell.toml")
    config = load_config(folder / "mine.toml")
    assert config.cell.file == "../cell.toml"
    assert config.problem(folder).controller.current_ramp_A_s > 0


def test_the_ramp_that_it_tells_of_is_one_that_can_be_tuned(tmp_path):
    path = tmp_path / "mine.toml"
    chargetune("init", path)
    text = path.read_text()
    for line in ("[theta.current_ramp]", "lower_A_s", "upper_A_s"):
        text = text.replace(f"# {line}", line)
    path.write_text(text)
    assert "current_ramp_A_s" in load_config(path).problem(tmp_path).space.entries


def test_a_slow_cell_gets_a_charge_that_is_long_enough(tmp_path):
    """What `identify` writes has the largest current of a pulse test: at C/2 an hour fills no cell, and then nothing was to be tuned."""
    text = (EXAMPLES / "okane2022.toml").read_text()
    capacity = tomllib.loads(text)["capacity_Ah"]
    (tmp_path / "cell.toml").write_text(re.sub(r"(?m)^current_max_A = .*", f"current_max_A = {capacity / 2}", text))
    chargetune("init", tmp_path / "mine.toml", "--cell", tmp_path / "cell.toml")
    assert load_config(tmp_path / "mine.toml").episode.steps == 1080
    assert "nothing found" in chargetune("check", tmp_path / "mine.toml").stdout
