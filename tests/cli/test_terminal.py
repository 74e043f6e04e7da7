"""Any terminal: few columns, few characters, markup in names, warnings; and a wrong key is answered without what is heavy."""

import os
import subprocess
import sys
import warnings

import pytest
from commands import chargetune
from rich.console import Console

from chargetune.cli.terminal import any_terminal
from chargetune.cli.tune import bar, progress_note
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")
HEAVY = ("scipy", "sqlalchemy", "torch", "matplotlib", "pandas", "rich.live")


@pytest.mark.parametrize("command", ["tune", "check", "simulate", "compare", "campaign"])
def test_a_wrong_key_is_answered_before_anything_heavy_is_imported(tmp_path, command):
    (tmp_path / "s.toml").write_text("[controller]\nhorizn = 5\n")
    code = (
        "import sys\nfrom chargetune.cli import main\n"
        f"sys.argv = ['chargetune', {command!r}, 's.toml']\n"
        "try:\n    main()\nexcept SystemExit as ended:\n    print(ended.code)\n"
        f"print([name for name in {HEAVY} if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "2\n[]\n"
    assert "s.toml" in done.stderr


def test_a_terminal_without_these_characters_gets_others(tmp_path):
    code = (
        "from chargetune.cli.terminal import any_terminal\n"
        "with any_terminal():\n    print('R0 mΩ 1.0±0.1 ²  漢')\n"
    )  # fmt: skip
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, env={**os.environ, "PYTHONIOENCODING": "ascii"}, capture_output=True, check=True)
    assert done.stdout == b"R0 mOhm 1.0+-0.1 2  ?\n"


@pytest.mark.parametrize("done", [3, 1234])
def test_counts_and_times_of_a_bar_stand_whole_at_80_columns(done):
    progress = bar(quiet=False)
    progress.add_task("certifying", total=20000, completed=done, note="best t95 37.11 min (trial 1233), 1041 [violating], 12 failed")
    screen = Console(width=80, color_system=None)
    with screen.capture() as captured:
        screen.print(progress.get_renderable())
    text = captured.get()
    assert f"{done}/20000" in text.replace(" ", "")
    assert "…" not in text
    assert "[violating]" in text
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("best", ["best t95 137.11 min (trial 299)", ""])
@pytest.mark.parametrize("failures", [0, 12])
@pytest.mark.parametrize("total", [60, 300])
def test_the_bar_of_a_study_is_one_line_at_80_columns(best, failures, total):
    progress = bar(quiet=False)
    progress.add_task("", total=total, completed=total - 1, note=progress_note(best, 41, failures))
    screen = Console(width=80, color_system=None)
    with screen.capture() as captured:
        screen.print(progress.get_renderable())
    (line,) = captured.get().splitlines()
    assert progress_note(best, 41, failures) in line
    assert ("failed" in line) == (failures > 0)


def test_a_warning_is_one_line_and_said_once(capsys):
    with any_terminal():
        warnings.simplefilter("always")
        for _ in range(2):
            warnings.warn("the compiler failed: cc -O3\nand its\nwhole output", RuntimeWarning, stacklevel=1)
    assert capsys.readouterr().err == "note: the compiler failed: cc -O3\n"


def test_names_with_brackets_are_printed_as_they_stand(tmp_path):
    folder = tmp_path / "run [red]"
    folder.mkdir()
    (folder / "s.toml").write_text(study_text(study={"trials": 2}))
    out = chargetune("tune", "s.toml", "--out", folder / "out", cwd=folder)
    assert "run [red]/out/study.sqlite" in out.stdout
    store = folder / "out" / "study.sqlite"
    assert "run [red]" in chargetune("certify", store, "--trial", 0, "--episodes", 1).stdout
    assert "run [red]" in chargetune("report", store, "--no-evaluate").stdout
    assert "run [red]" in chargetune("check", folder / "s.toml").stdout


def test_migrate_answers_a_program_and_makes_no_store(tmp_path):
    assert "no such store" in chargetune("store", "migrate", tmp_path / "none.sqlite", "--json", code=2).stderr
    assert not list(tmp_path.iterdir())
