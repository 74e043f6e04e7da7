"""Server-sent events: what a page is told when a store changes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

from chargetune.report.page.trial_rows import study_head, study_summary, trial_rows
from chargetune.report.study_view import StudyView
from chargetune.study.store.store import StoreError
from chargetune.web.watch import StoreWatch

__all__ = ["Ending", "list_events", "study_events"]

PERIOD_S = 0.5
# A line now and then tells proxies, and this process, that the other side is still there.
ALIVE_S = 15.0
ALIVE = b": alive\n\n"


# Whether the server is about to end: a stream would hold it for ever.
Ending = Callable[[], bool]


def _never() -> bool:
    return False


async def list_events(watch: StoreWatch, ending: Ending = _never) -> AsyncIterator[bytes]:
    """``studies``: the summary of every study, at once and whenever one changed."""
    sent: object = None
    async for views in _changes(watch, None, ending):
        if isinstance(views, str):
            sent = None
            yield _event("trouble", {"message": views})
        elif views is None:
            yield ALIVE
        else:
            summaries = [study_summary(view) for view in views]
            if summaries != sent:
                yield _event("studies", {"studies": summaries})
            sent = summaries


async def study_events(watch: StoreWatch, study_id: int, ending: Ending = _never) -> AsyncIterator[bytes]:
    """``study``: its head, at once and when it changed; ``trials``: rows of new and newly told trials, all of them after a head."""
    head: Mapping[str, Any] | None = None
    sent: dict[int, str] = {}
    result: Mapping[str, Any] | None = None
    async for views in _changes(watch, study_id, ending):
        if views is None:
            yield ALIVE
            continue
        if isinstance(views, str) or not views:
            # When the trouble is over, everything is told again.
            head = None
            yield _event("trouble", {"message": views or "this study is not in the store any more"})
            continue
        view = views[0]
        new_head = await asyncio.to_thread(study_head, view)
        if new_head != head or len(view.trials) < len(sent):
            head, sent = new_head, {}
            yield _event("study", head)
        fresh = [t for t in view.trials if sent.get(t.number) != t.status]
        # The tuner is asked for the result once all trials are told.
        told = view.result.facts()
        if fresh or not sent or told != result:
            result = told
            rows = await asyncio.to_thread(trial_rows, view, fresh)
            start, tuned = view.start, view.tuned
            sent |= {t.number: t.status for t in fresh}
            yield _event(
                "trials",
                {
                    "rows": rows,
                    "start": None if start is None else start.number,
                    "start_label": view.start_label,
                    "tuned": None if tuned is None else tuned.number,
                    "tuned_label": view.tuned_label,
                    "result": result,
                },
            )


async def _changes(watch: StoreWatch, study_id: int | None, ending: Ending) -> AsyncIterator[list[StudyView] | str | None]:
    """The studies whenever they were read anew, the trouble with the store as text when it begins, None from time to time."""
    last: object = None
    idle = 0.0
    while not ending():
        now: list[StudyView] | str
        try:
            if study_id is None:
                now = await asyncio.to_thread(watch.studies)
            else:
                view = await asyncio.to_thread(watch.study, study_id)
                now = [] if view is None else [view]
        except StoreError as error:
            now = str(error)
        same = now == last if isinstance(now, str) or isinstance(last, str) else _identical(now, last)
        if not same:
            last, idle = now, 0.0
            yield now
        elif idle >= ALIVE_S:
            idle = 0.0
            yield None
        await asyncio.sleep(PERIOD_S)
        idle += PERIOD_S


def _identical(now: list[StudyView], last: object) -> bool:
    # By identity: comparing two thousand trials with each other would be the larger work.
    return isinstance(last, list) and len(now) == len(last) and all(a is b for a, b in zip(now, last, strict=True))


def _event(name: str, data: Mapping[str, Any]) -> bytes:
    return f"event: {name}\ndata: {json.dumps(data, allow_nan=False, separators=(',', ':'))}\n\n".encode()
