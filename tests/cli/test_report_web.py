"""`chargetune report` and `chargetune web` as a user runs them."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "report"))

from report_studies import charging, other_study, run_charging

from chargetune.cli import main

pytestmark = pytest.mark.usefixtures("virtual_machine")

TOKEN = "correct horse battery"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return run_charging(tmp_path_factory.mktemp("cli") / "charge.sqlite", charging())


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a command in this process; it must end well, or refuse with exit code 2 and one message."""

    def call(*arguments, refused=False):
        monkeypatch.setattr(sys, "argv", ["chargetune", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == (2 if refused else 0)
        out, err = capsys.readouterr()
        return err if refused else out

    return call


def test_report_is_written_beside_the_store(run, store):
    out = run("report", store)
    page = store.with_suffix(".html")
    assert page.name in out
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")


def test_report_with_figures_for_a_paper(run, store, tmp_path):
    told = json.loads(run("report", store, "-o", tmp_path / "r.html", "--figures", tmp_path / "f", "--no-evaluate", "--json"))
    assert told["study"] == "charge"
    assert told["page"] == str(tmp_path / "r.html")
    assert {Path(f).name for f in told["figures"]} == {"trajectories.pdf", "backoff.pdf", "R0.pdf", "R1.pdf", "convergence.pdf"}
    assert all(Path(f).read_bytes().startswith(b"%PDF") for f in told["figures"])
    assert "evaluated again" not in (tmp_path / "r.html").read_text("utf-8")


def test_report_of_one_of_several_studies(run, tmp_path):
    path = other_study(other_study(tmp_path / "two.sqlite", "crane"), "ship")
    message = run("report", path, refused=True)
    assert "2 studies" in message
    assert "crane, ship" in message
    assert "ship" in run("report", path, "--study", "ship", "-o", tmp_path / "ship.html", "--json")
    assert "no study 'boat'" in run("report", path, "--study", "boat", refused=True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("report", "missing.sqlite"), "no such store"),
        (("report", "STORE", "-o", "no/such/folder/r.html"), "there is no folder"),
        (("web", "missing.sqlite"), "no such store"),
        (("web", "STORE", "--host", "0.0.0.0"), "give a --token of at least 16"),
        (("web", "STORE", "--host", "::"), "give a --token of at least 16"),
        (("web", "STORE", "--host", "0.0.0.0", "--token", "short"), "--token has 5 characters"),
        (("web", "STORE", "--token", "ü" * 20), "printable ASCII"),
        (("web", "STORE", "--token", ""), "--token has 0 characters"),
        (("web", "STORE", "--port", "70000"), ""),
        (("web", "STORE", "--host", "999.1.1.1", "--token", TOKEN), ""),
    ],
)
def test_what_is_refused(run, store, arguments, words):
    assert words in run(*(store if a == "STORE" else a for a in arguments), refused=True)


def test_port_that_is_taken(run, store):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"--port {port} is taken on 127.0.0.1" in run("web", store, "--port", port, refused=True)


def read(address, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:  # noqa: S310
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


@pytest.mark.parametrize("token", [None, TOKEN])
def test_web_serves_until_interrupted(store, token):
    environment = {k: v for k, v in os.environ.items() if k != "CHARGETUNE_WEB_TOKEN"} | ({"CHARGETUNE_WEB_TOKEN": token} if token else {})
    command = [sys.executable, "-m", "chargetune", "web", str(store), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            line = process.stdout.readline()
            address = re.search(r"http://127\.0\.0\.1:\d+/", line)[0]
            assert TOKEN not in line
            status, text = read(address)
            assert status == (401 if token else 200)
            assert ("Studies" in text) == (token is None)
            assert read(address, Authorization=f"Bearer {TOKEN}")[0] == 200
            assert read(address, Host="evil.example")[0] == (401 if token else 403)
            # A stream that is open holds nobody up.
            stream = urllib.request.Request(f"{address}stream", headers={"Authorization": f"Bearer {TOKEN}"})  # noqa: S310
            with urllib.request.urlopen(stream, timeout=10) as events:  # noqa: S310
                assert events.readline() == b"event: studies\n"
                process.send_signal(signal.SIGINT)
                assert process.wait(10) == 0
        finally:
            process.kill()
        assert process.stderr.read() == ""
