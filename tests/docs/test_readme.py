"""The Python code of the README runs as it stands, from top to bottom."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"


def blocks():
    """Indented blocks that are Python, those of one page after each other."""
    found = re.findall(r"(?:^(?: {4}.*)?\n)+", README.read_text(encoding="utf-8"), flags=re.MULTILINE)
    code = [re.sub(r"^ {4}", "", block, flags=re.MULTILINE).strip() for block in found]
    return [block for block in code if re.match(r"import |with |from ", block)]


@pytest.mark.usefixtures("virtual_machine")
def test_python_blocks_run(monkeypatch, tmp_path, capsys):
    code = blocks()
    assert len(code) == 2
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in code:
        exec(compile(block, str(README), "exec"), names)  # noqa: S102 - that the page runs is what is tested
    assert "Trial" in capsys.readouterr().out
    with names["ct"].Store("tank.sqlite") as store, names["ct"].Study.create_or_resume(store, "tank", **names["how"]) as study:
        result, trials = study.result(), study.trials()
    assert len(trials) == 12
    # Without a margin the tank is filled beyond its limit; the result keeps it.
    assert trials[0].score.excess["level"] > 1e-3
    assert result.kept.score.feasible
    with names["ct"].Store("my.sqlite") as store, names["ct"].Study.create_or_resume(store, "my plant", **names["how"]) as study:
        assert [t.theta for t in study.trials()] == [t.theta for t in trials]
