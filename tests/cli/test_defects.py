"""Which errors are the user's to mend, and which are this program's."""

import numpy as np
import pytest

from chargetune.cli import app as cli
from chargetune.study.store.store import StoreError


@pytest.fixture
def raising(monkeypatch, chargetune_here, tmp_path):
    """`chargetune show` of a store whose opening does what the test says."""

    def run(action):
        class Opened:
            def __init__(self, *_, **__):
                action()

        monkeypatch.setattr("chargetune.report.study_view.Store", Opened)
        return chargetune_here("show", tmp_path / "s.sqlite")

    return run


def raises(error):
    def action():
        raise error

    return action


@pytest.mark.parametrize(
    "action",
    [
        lambda: np.linalg.inv(np.zeros((2, 2))),
        lambda: b"\xff".decode("utf-8"),
        lambda: {}["absent"],
        raises(RuntimeError("a torch that broke")),
    ],
)
def test_a_defect_shows_where_it_is_and_has_an_exit_code_of_its_own(raising, action):
    code, out, said = raising(action)
    assert (code, out) == (cli.DEFECT, "")
    assert "Traceback" in said
    assert "a defect of this program" in said


@pytest.mark.parametrize(
    "error", [ValueError("x = 3, allowed is 4"), StoreError("no such store"), OSError("no room"), FileNotFoundError("f")]
)
def test_what_a_user_can_mend_is_one_message(raising, error):
    code, out, said = raising(raises(error))
    assert (code, out, said) == (2, "", f"chargetune: {error}\n")


@pytest.mark.parametrize("command", [("tune",), ("check",), ("simulate",), ("compare",), ("campaign",), ("identify",), ("verify",)])
@pytest.mark.parametrize("content", [b"\xff\xfe\x00nonsense", b"[study\n", b"{"])
def test_a_file_that_cannot_be_read_is_the_users(refused, tmp_path, command, content):
    path = tmp_path / "given.txt"
    path.write_bytes(content)
    said = refused(*command, path)
    assert said.startswith("chargetune: ")
    assert "given.txt" in said
    assert "Traceback" not in said
