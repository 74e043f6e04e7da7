import csv
import io
import json
import re
import sqlite3
from pathlib import Path

import numpy as np
import plotly
import pytest
from html_check import parsed
from report_studies import HOSTILE, charging, run_charging
from starlette.testclient import TestClient

from chargetune.report.study_view import read_studies
from chargetune.web.app import make_app

ONE = "/studies/1"


@pytest.fixture(scope="module")
def client(store):
    return TestClient(make_app(store), base_url="http://127.0.0.1")


@pytest.fixture(scope="module")
def view(store):
    return read_studies(store, only=1)[0]


@pytest.mark.parametrize("path", ["/", ONE, "/studies/2"])
def test_pages_hold_no_script_or_style_of_their_own(client, path):
    found = client.get(path)
    assert found.status_code == 200
    assert found.headers["content-type"].startswith("text/html")
    tags = parsed(found.text).tags
    for tag, attributes in tags:
        assert tag != "style"
        assert "style" not in attributes
        assert not [name for name in attributes if name.startswith("on")]
        assert tag != "script" or attributes["src"].startswith("/static/")
    for address in [a[name] for _, a in tags for name in ("src", "href") if name in a]:
        assert re.fullmatch(r"/|data:,|/static/[a-z]+\.(css|js)", address)
        if address.startswith("/static"):
            assert client.get(address).status_code == 200


def test_plotly_comes_from_its_wheel(client):
    wheel = (Path(plotly.__file__).parent / "package_data" / "plotly.min.js").read_bytes()
    found = client.get("/static/plotly.js")
    assert found.content == wheel
    assert found.headers["content-encoding"] == "gzip"
    assert found.headers["content-type"].startswith("text/javascript")
    assert client.get("/static/plotly.js", headers={"accept-encoding": "identity"}).content == wheel


@pytest.mark.parametrize(
    "path",
    [
        "/static/../app.py", "/static/..%2fapp.py", "/static/%2e%2e/%2e%2e/app.py", "/static//etc/passwd", "/static/C:%5Cx", "/etc/passwd",
        "/static/store.sqlite", "/../../etc/passwd", "/studies/1/../../store.sqlite", "/static/look.css%00", "/static/", "/static",
        "/studies/1/trials/..%2f..%2f1/trace.csv", "/studies/charge", "/studies/-1", "/studies/1e3", "/studies/1/trials/x", "/docs",
        "/studies/99", "/studies/1/trials/10", "/studies/1/trials/10/trace.csv", "/studies/1/trials/99999999999999999999999/theta.json",
        "/studies/99999999999999999999999", "/studies/99/stream",
    ],
)  # fmt: skip
def test_no_other_path_leads_anywhere(client, path):
    found = client.get(path, follow_redirects=True)
    assert found.status_code == 404
    assert "root:" not in found.text
    assert "import" not in found.text


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
@pytest.mark.parametrize("path", ["/", ONE, f"{ONE}/trials/1", f"{ONE}/trials/1/theta.json", "/stream"])
def test_there_is_nothing_but_reading(client, method, path):
    assert client.request(method, path).status_code == 405


def test_the_store_is_not_written(tmp_path):
    path = run_charging(tmp_path / "s.sqlite", charging())
    path.chmod(0o444)
    before, client = path.read_bytes(), TestClient(make_app(path), base_url="http://127.0.0.1")
    for address in (ONE, f"{ONE}/trials/1", f"{ONE}/trials/1/trace.csv", f"{ONE}/trials/1/theta.json"):
        assert client.get(address).status_code == 200
    assert path.read_bytes() == before


def test_trial(client, view):
    tuned = view.tuned
    data = client.get(f"{ONE}/trials/{tuned.number}").json()
    assert list(data["theta"].values()) == list(tuned.theta)
    panels = {p["key"]: p for p in data["panels"]}
    assert list(panels) == ["soc", "current_A", "voltage_V", "near"]
    np.testing.assert_allclose(panels["soc"]["y"][1:], 100 * view.episode(tuned).signal("soc")[1], rtol=1e-5)
    assert client.get(f"{ONE}/trials/6").json()["message"] == "no trace is stored"


def test_downloads(client, view):
    number = view.tuned.number
    trace = client.get(f"{ONE}/trials/{number}/trace.csv")
    assert trace.headers["content-type"].startswith("text/csv")
    assert trace.headers["content-disposition"] == f'attachment; filename="charge-trial-{number}.csv"'
    rows = list(csv.DictReader(io.StringIO(trace.text)))
    np.testing.assert_array_equal([float(r["current_A"]) for r in rows], view.episode(view.tuned).input[:, 0])
    theta = client.get(f"{ONE}/trials/{number}/theta.json")
    assert theta.headers["content-disposition"] == f'attachment; filename="charge-trial-{number}.json"'
    np.testing.assert_array_equal(view.space.from_dict(theta.json()["theta"]), view.tuned.theta)
    assert client.get(f"{ONE}/trials/6/trace.csv").status_code == 404


def test_markup_in_a_name_stays_out_of_pages_and_headers(client):
    assert HOSTILE not in client.get("/studies/2").text
    found = client.get("/studies/2/trials/3/theta.json")
    assert re.fullmatch(r'attachment; filename="[A-Za-z0-9.-]+"', found.headers["content-disposition"])
    assert found.json()["study"] == HOSTILE
    assert found.headers["content-type"] == "application/json"
    assert found.headers["x-content-type-options"] == "nosniff"


def test_damaged_trace_is_said_and_the_others_stay(tmp_path):
    path = run_charging(tmp_path / "s.sqlite", charging())
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE trace SET data = substr(data, 1, 200) WHERE number = 5")
    connection.close()
    client = TestClient(make_app(path), base_url="http://127.0.0.1")
    assert "trace of trial 5 is damaged" in client.get(f"{ONE}/trials/5").json()["message"]
    assert "damaged" in client.get(f"{ONE}/trials/5/trace.csv").json()["message"]
    assert client.get(f"{ONE}/trials/4").json()["message"] == ""


def test_a_store_that_went_away_is_said(tmp_path):
    client = TestClient(make_app(tmp_path / "gone.sqlite"), base_url="http://127.0.0.1")
    found = client.get(ONE)
    assert found.status_code == 503
    assert "no such store" in found.json()["message"]


def test_trace_that_is_no_episode(tmp_path):
    from chargetune.model.parameter_space import Parameter, ParameterSpace
    from chargetune.study.serialization import space_to_json
    from chargetune.study.store.store import Store
    from chargetune.study.store.trace import encode
    from chargetune.study.trial import Trial

    space = ParameterSpace((Parameter("x", 0.0, 1.0, 0.0),))
    with Store(tmp_path / "s.sqlite") as opened:
        identity = {"config": {}, "space": space_to_json(space), "tuner": {}, "seed": 0, "batch": 1}
        record = opened.add_study("own", identity)
        opened.add_trials(record.id, [Trial(0, (0.0,))])
        opened.finish_trial(record.id, 0, score=None, ending="x", trace=encode({"a": np.ones(3)}, {"unit": "V"}), provenance={})
    client = TestClient(make_app(tmp_path / "s.sqlite"), base_url="http://127.0.0.1")
    assert "not that of an episode" in client.get(f"{ONE}/trials/0").json()["message"]
    assert json.loads(client.get(f"{ONE}/trials/0/theta.json").text)["theta"] == {"x": 0.0}
