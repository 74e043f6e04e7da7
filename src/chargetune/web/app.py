"""The web application: pages, events and downloads of one store. It reads, and has no way to write."""

from __future__ import annotations

import asyncio
import gzip
import json
import os
import re
from functools import cache
from importlib import resources
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from chargetune.report.page.html import plotly_js, static
from chargetune.report.page.plot_data import trial_drawing
from chargetune.report.page.trial_rows import theta_document, trace_csv
from chargetune.report.study_view import ReadStudy, StudyView
from chargetune.study.store.store import StoreError
from chargetune.study.trial import Trial
from chargetune.web.events import Ending, list_events, study_events
from chargetune.web.guard import Guard
from chargetune.web.watch import StoreWatch

__all__ = ["make_app"]

TYPES = {"css": "text/css", "js": "text/javascript", "html": "text/html"}


def make_app(
    store: str | os.PathLike[str],
    *,
    token: str | None = None,
    hosts: frozenset[str] = frozenset(),
    ending: Ending = lambda: False,
) -> ASGIApp:
    """The application for one store, a file or a URL. ``hosts`` are further names of this machine that a request without token may ask for.

    ``ending`` is asked twice a second whether the server is about to end; then the streams do too.

    A study and a trial are addressed by number, a file by its name in a table made here: no path from outside is ever opened.
    """
    watch = StoreWatch(store)
    files = _files()
    pages = {"index.html": _own("index.html"), "study.html": _own("study.html").replace(b"<!-- styles -->", _no_styles())}

    async def index(_request: Request) -> Response:
        return Response(pages["index.html"], media_type="text/html")

    async def study(request: Request) -> Response:
        await _study(watch, request)
        return Response(pages["study.html"], media_type="text/html")

    async def file(request: Request) -> Response:
        found = files.get(request.path_params["name"])
        if found is None:
            raise HTTPException(404, "no such file")
        content, kind = found
        return _compressed(request, content, kind)

    async def list_stream(_request: Request) -> Response:
        return _stream(list_events(watch, ending))

    async def study_stream(request: Request) -> Response:
        await _study(watch, request)
        return _stream(study_events(watch, request.path_params["study"], ending))

    async def trial(request: Request) -> Response:
        view, reading = await _reading(watch, request)
        return JSONResponse(await asyncio.to_thread(trial_drawing, view, reading))

    async def trace(request: Request) -> Response:
        view, reading = await _reading(watch, request)
        if reading.episode is None:
            raise HTTPException(404, reading.message)
        text = await asyncio.to_thread(trace_csv, reading.episode)
        return Response(text, headers=_attachment(view, reading.trial, "csv"), media_type="text/csv")

    async def theta(request: Request) -> Response:
        view, one = await _trial(watch, request)
        text = json.dumps(theta_document(view, one), indent=1)
        return Response(text, headers=_attachment(view, one, "json"), media_type="application/json")

    one = "/studies/{study:int}"
    routes = [
        Route("/", index),
        Route("/stream", list_stream),
        Route("/static/{name}", file),
        Route(one, study),
        Route(f"{one}/stream", study_stream),
        Route(f"{one}/trials/{{number:int}}", trial),
        Route(f"{one}/trials/{{number:int}}/trace.csv", trace),
        Route(f"{one}/trials/{{number:int}}/theta.json", theta),
    ]
    app = Starlette(routes=routes, exception_handlers={HTTPException: _refusal, StoreError: _trouble})
    return Guard(app, token, frozenset({"localhost", "127.0.0.1", "::1"}) | hosts, _own("refused.html").decode())


async def _study(watch: StoreWatch, request: Request) -> StudyView:
    view = await asyncio.to_thread(watch.study, request.path_params["study"])
    if view is None:
        raise HTTPException(404, "no such study in this store")
    return view


async def _trial(watch: StoreWatch, request: Request) -> tuple[StudyView, Trial]:
    view, number = await _study(watch, request), request.path_params["number"]
    found = next((t for t in view.trials if t.number == number), None)
    if found is None:
        raise HTTPException(404, "no such trial in this study")
    return view, found


async def _reading(watch: StoreWatch, request: Request) -> tuple[StudyView, ReadStudy]:
    view, found = await _trial(watch, request)
    return view, await asyncio.to_thread(lambda: next(view.readings([found])))


def _stream(events: Any) -> Response:
    # Proxies that buffer would hold every event back.
    return StreamingResponse(events, media_type="text/event-stream", headers={"x-accel-buffering": "no"})


def _refusal(_request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    return JSONResponse({"message": error.detail if isinstance(error, HTTPException) else ""}, status)


def _trouble(_request: Request, error: Exception) -> Response:
    return JSONResponse({"message": str(error)}, 503)


def _attachment(view: StudyView, trial: Trial, kind: str) -> dict[str, str]:
    plain = re.sub(r"[^A-Za-z0-9.]+", "-", view.name).strip("-.")[:60] or "study"
    return {"content-disposition": f'attachment; filename="{plain}-trial-{trial.number}.{kind}"'}


@cache
def _no_styles() -> bytes:
    """Empty elements with the ids of the style elements that plotly.js makes for maps: it makes none where there is one already.

    No figure here is a map, and the policy of the page refuses such an element, with an error in the browser's console.
    """
    ids = dict.fromkeys(re.findall(rb'getElementById\("([0-9a-f]{64})"\)', plotly_js()))
    return b"".join(b'<meta id="' + found + b'">' for found in ids)


def _own(name: str) -> bytes:
    return resources.files("chargetune.web").joinpath("static", name).read_bytes()


@cache
def _files() -> dict[str, tuple[dict[str, bytes], str]]:
    """Every file that a page may ask for: its content by encoding, and its type."""
    contents = {name: static(name).encode() for name in ("look.css", "figures.js", "trials.js")}
    contents |= {name: _own(name) for name in ("index.js", "study.js")}
    contents["plotly.js"] = plotly_js()
    return {name: ({"": c, "gzip": gzip.compress(c, 6)}, TYPES[name.rpartition(".")[2]]) for name, c in contents.items()}


def _compressed(request: Request, content: dict[str, bytes], kind: str) -> Response:
    how = "gzip" if "gzip" in request.headers.get("accept-encoding", "") else ""
    headers = {"vary": "accept-encoding", "cache-control": "private, max-age=600"}
    return Response(content[how], headers=headers | ({"content-encoding": how} if how else {}), media_type=kind)
