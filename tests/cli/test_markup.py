"""A person's own words are no markup of the terminal."""

from pathlib import Path

from commands import chargetune

from study_text import study_text

CELL = Path(__file__).parents[2] / "examples" / "okane2022.toml"


def test_brackets_in_a_cell_file_are_printed_as_they_stand(tmp_path):
    text = CELL.read_text().splitlines()
    text = ['name = "LIR2032 [aged]"' if line.startswith("name =") else line for line in text]
    text = ['remark = "see [ref 3] and [/note]"' if line.startswith("remark =") else line for line in text]
    (tmp_path / "cell.toml").write_text("\n".join(text))
    study = tmp_path / "s.toml"
    study.write_text(study_text(study={"name": "m", "trials": 1, "tuner": "sobol"}, cell={"file": "cell.toml"}, episode={"steps": 40}))
    for command in (("simulate", study), ("tune", study, "--store", tmp_path / "s.sqlite", "--force")):
        out = chargetune(*command).stdout
        assert "LIR2032 [aged]" in out
        assert "see [ref 3] and [/note]" in out
