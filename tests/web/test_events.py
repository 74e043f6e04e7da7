"""The streams as a client reads them."""

import asyncio
import json

import pytest
from report_studies import TRIALS, charging, run_charging

from chargetune.episode.score import Score
from chargetune.study.result import made_from
from chargetune.study.store.rows import ResultRecord
from chargetune.study.store.store import Store
from chargetune.study.trial import Trial
from chargetune.web import events
from chargetune.web.events import list_events, study_events
from chargetune.web.watch import StoreWatch


@pytest.fixture
def path(tmp_path):
    return run_charging(tmp_path / "s.sqlite", charging())


async def following(stream):
    """The next event: its name and its data."""
    text = (await asyncio.wait_for(anext(stream), 5)).decode()
    name, data = text.removesuffix("\n\n").split("\n")
    return name.removeprefix("event: "), json.loads(data.removeprefix("data: "))


async def told(stream):
    return [row["number"] for row in (await following(stream))[1]["rows"]]


def tell(path, number, theta, *, finish=True):
    with Store(path) as opened:
        if finish:
            opened.finish_trial(1, number, score=Score(-0.01, -1.0, {"v": -1.0}, {"v": 0.0}), ending="done", trace=None, provenance={})
        else:
            opened.add_trials(1, [Trial(number, theta)])


def test_a_study_is_told_whole_and_then_what_is_new(path):
    async def client():
        watch = StoreWatch(path)
        theta = watch.study(1).trials[0].theta
        stream = study_events(watch, 1)
        name, head = await following(stream)
        assert (name, head["name"]) == ("study", "charge")
        name, first = await following(stream)
        assert name == "trials"
        assert [row["number"] for row in first["rows"]] == list(range(TRIALS))
        assert (first["start"], first["start_label"]) == (0, "untuned")
        tell(path, TRIALS, theta, finish=False)
        _, news = await following(stream)
        assert [(row["number"], row["status"]) for row in news["rows"]] == [(TRIALS, "running")]
        tell(path, TRIALS, theta)
        name, news = await following(stream)
        # Another limit in the score changes the unit of the axis, so everything is told again.
        assert name == "study"
        name, news = await following(stream)
        assert [(row["number"], row["status"]) for row in news["rows"]][-1] == (TRIALS, "done")
        assert news["tuned"] == TRIALS
        assert not news["result"]["asked"]
        # The tuner is asked when all trials are told: no trial is new then, and yet the result is.
        with Store(path) as opened:
            record = opened.study("charge")
            opened.set_result(record.id, ResultRecord(2, "believed", made_from(record, opened.trials(record.id))))
        name, news = await following(stream)
        assert (name, news["rows"], news["tuned"], news["result"]["reason"]) == ("trials", [], 2, "believed")
        await stream.aclose()

    asyncio.run(client())


def test_trouble_is_told_and_everything_again_after_it(path, tmp_path):
    async def client():
        stream = study_events(StoreWatch(path), 1)
        assert (await following(stream))[0] == "study"
        assert await told(stream) == list(range(TRIALS))
        path.rename(tmp_path / "away")
        name, data = await following(stream)
        assert name == "trouble"
        assert "no such store" in data["message"]
        (tmp_path / "away").rename(path)
        assert (await following(stream))[0] == "study"
        assert await told(stream) == list(range(TRIALS))
        await stream.aclose()

    asyncio.run(client())


def test_a_study_without_trials_yet(tmp_path):
    async def client():
        path = tmp_path / "s.sqlite"
        config = charging()
        with Store(path) as opened:
            from chargetune.study.serialization import space_to_json

            identity = {"config": config.document(), "space": space_to_json(config.problem().space), "tuner": {}, "seed": 0, "batch": 1}
            opened.add_study("empty", identity)
        stream = study_events(StoreWatch(path), 1)
        assert (await following(stream))[0] == "study"
        assert (await following(stream))[1] == {
            "rows": [], "start": None, "start_label": "untuned", "tuned": None, "tuned_label": "tuned",
            "result": {"trial": None, "reason": "none", "asked": True, "sentence": "no trial has a score"},
        }  # fmt: skip
        tell(path, 0, tuple(config.problem().space.default), finish=False)
        assert await told(stream) == [0]
        await stream.aclose()

    asyncio.run(client())


def test_the_list_follows_the_store(path):
    async def client():
        watch = StoreWatch(path)
        stream = list_events(watch)
        name, data = await following(stream)
        assert (name, data["studies"][0]["done"], data["studies"][0]["running"]) == ("studies", TRIALS, 0)
        tell(path, TRIALS, watch.study(1).trials[0].theta, finish=False)
        assert (await following(stream))[1]["studies"][0]["running"] == 1
        await stream.aclose()

    asyncio.run(client())


def test_a_quiet_store_gives_a_sign_of_life(path, monkeypatch):
    monkeypatch.setattr(events, "ALIVE_S", 0.1)
    monkeypatch.setattr(events, "PERIOD_S", 0.05)

    async def client():
        stream = list_events(StoreWatch(path))
        await following(stream)
        # The store is young, so it is read again at first; what it says is the same.
        assert await asyncio.wait_for(anext(stream), 5) == b": alive\n\n"
        await stream.aclose()

    asyncio.run(client())


def test_over_http_with_a_server(store, serve):
    import httpx

    with serve(store) as address, httpx.stream("GET", f"{address}/studies/1/stream", timeout=10) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        assert next(lines) == "event: study"
        assert json.loads(next(lines).removeprefix("data: "))["name"] == "charge"
