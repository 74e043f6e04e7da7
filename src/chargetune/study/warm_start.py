"""Earlier studies as initial data D_0 of a new one (warm start)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

from chargetune.model.parameter_space import ParameterSpace
from chargetune.study.identity import StudyError, parameters_of
from chargetune.study.serialization import space_to_json
from chargetune.study.store.database import store_name
from chargetune.study.store.store import Store, StoreError
from chargetune.study.store.trace import encode
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["Earlier", "read_earlier"]


@dataclass(frozen=True)
class Earlier:
    """An earlier study: where its store is, and its name there."""

    store: str | os.PathLike[str]
    study: str

    @property
    def name(self) -> str:
        """The study and its store without the folder or the password: what a study begun with it remembers."""
        return f"{self.study} in {store_name(self.store)}"


def read_earlier(earlier: Sequence[Earlier], space: ParameterSpace) -> list[tuple[Trial, bytes | None]]:
    """Their told trials in the order given, numbered -k .. -1, each with its trace, and with its origin in the provenance.

    A trace that is damaged is left behind. Raises StudyError for a study of other parameters and for a theta outside the bounds of
    ``space``, StoreError for a store or a study that is not there.
    """
    found: list[tuple[Trial, bytes | None]] = []
    for one in earlier:
        with Store(one.store, read_only=True) as store:
            record = store.study(one.study)
            old, new = parameters_of(record.identity["space"]), parameters_of(space_to_json(space))
            if old != new:
                raise StudyError(f"{store.label}: the earlier study {one.study!r} tunes {', '.join(old)}, allowed is {', '.join(new)}")
            for trial in store.trials(record.id):
                if trial.status in (TrialStatus.RUNNING, TrialStatus.APART):
                    continue
                try:
                    space.validate(trial.theta)
                except ValueError as error:
                    raise StudyError(f"{store.label}: trial {trial.number} of the earlier study {one.study!r}: {error}") from error
                found.append(_imported(store, record.id, one.study, trial))
    return [(replace(trial, number=k - len(found)), trace) for k, (trial, trace) in enumerate(found)]


def _imported(store: Store, study_id: int, study: str, trial: Trial) -> tuple[Trial, bytes | None]:
    origin = {"store": store.label, "study": study, "number": trial.number}
    trial = replace(trial, provenance={**trial.provenance, "origin": origin})
    try:
        trace = store.trace(study_id, trial.number)
    except StoreError:
        trace = None
    return (trial, encode(*trace)) if trace is not None else (replace(trial, trace_sha256=None), None)
