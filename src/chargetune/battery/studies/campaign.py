"""Campaign: many study files with many seeds, as studies in one store, advanced by turns."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path

from chargetune.battery.studies.campaign_file import CampaignFile
from chargetune.battery.studies.open_study import evaluation_of, open_study
from chargetune.battery.studies.study_file import Config, load_config, read_tables
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.names import check_name
from chargetune.study.result import Reason, StudyResult, read_result
from chargetune.study.store.store import Store, StudyRecord
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["Entry", "Standing", "load_campaign", "run_campaign", "standings"]

# A worker keeps a study for so long, in seconds: opening it costs some ten milliseconds.
TURN_S = 2.0
# A plant that ends the process of its study does it that often before the study leaves the trial out; once more is something else.
LOSSES_MAX = 3


@dataclass(frozen=True)
class Entry:
    """One study of a campaign: what is tuned, where the file's own paths begin, and the file's name."""

    config: Config
    folder: Path
    source: str

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.config.study.name


@dataclass(frozen=True)
class Standing:
    """How far a study is. ``message`` says why it stopped; None: it did not."""

    name: str
    told: int
    trials: int
    failed: int
    violating: int
    result: StudyResult
    message: str | None = None

    @property
    def best(self) -> Trial | None:
        """The trial that is the study's result."""
        return self.result.trial

    @property
    def state(self) -> str:
        """waiting, running, done or stopped."""
        if self.message is not None:
            return "stopped"
        return "done" if self.told >= self.trials else "running" if self.told else "waiting"


def load_campaign(path: str | Path) -> list[Entry]:
    """The studies of a campaign file, by file and then by seed. Every study file is read, and its problem built.

    Raises FileNotFoundError, and ValueError naming file, field, value and what is allowed.
    """
    path = Path(path)
    table = read_tables(path, CampaignFile).campaign
    seeds = _seeds(path, table.seeds)
    stems = [Path(name).stem for name in table.configs]
    if len(set(stems)) != len(stems):
        raise ValueError(
            f"{path}: campaign.configs = {table.configs!r}: allowed are files of different names; the studies are named by them"
        )
    entries = []
    for name, stem in zip(table.configs, stems, strict=True):
        file = path.parent / name
        if not file.is_file():
            raise ValueError(f"{path}: campaign.configs: there is no file {file}")
        config = load_config(file)
        for seed in seeds:
            changes = {"name": check_name(f"{stem} seed {seed}"), "seed": seed, "trials": table.trials or config.study.trials}
            changed = config.model_copy(update={"study": config.study.model_copy(update=changes)})
            if table.mismatch_from_seed:
                changed = changed.model_copy(update={"controller": replace(config.controller, mismatch_seed=seed)})
            entries.append(Entry(changed, file.parent, name))
        if not entries[-1].config.problem(file.parent).space.dimension:
            raise ValueError(f"{file}: theta is empty; add a table [theta.backoff], [theta.R0] or [theta.R1]")
    return entries


def run_campaign(
    entries: Sequence[Entry], store: str | Path, executor: Executor, workers: int, *, progress: Callable[[Standing], None] | None = None
) -> list[Standing]:
    """Advance every study to its number of trials in ``store``, a file or a URL; standings in the order of ``entries``.

    At most ``workers`` studies are with the executor at once, each for `TURN_S` seconds, then it goes to the end of the queue.
    A study whose worker dies goes on with another one; the study itself finds the trial that is to blame. A study that raises
    stops, with the reason in its standing; the others go on. Raises StoreError for what cannot be a store, ValueError for workers.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise ValueError(f"workers = {workers!r}, allowed is an integer >= 1")
    with Store(store) as opened:  # made before the workers open it
        found = standings(opened, entries)
    # Those that are done too: the files may have changed since, and then their trials are not what the file says.
    queue = deque(entries)
    losses: dict[str, tuple[int, int]] = {}
    turns: dict[Future[Standing], Entry] = {}
    try:
        while queue or turns:
            while queue and len(turns) < workers:
                entry = queue.popleft()
                turns[executor.submit(_turn, entry, store)] = entry
            finished, _ = wait(turns, return_when=FIRST_COMPLETED)
            raise_lost_interrupt()
            for future in finished:
                entry = turns.pop(future)
                standing = _standing(future, entry, store, losses)
                found[entry.name] = standing
                if standing.state not in ("done", "stopped"):
                    queue.append(entry)
                if progress is not None:
                    progress(standing)
    finally:
        for future in turns:
            future.cancel()
    return [found[entry.name] for entry in entries]


def standings(store: Store, entries: Iterable[Entry]) -> dict[str, Standing]:
    """How far each study is, by name."""
    records = {record.name: record for record in store.studies()}
    return {e.name: _count(e, store, records.get(e.name)) for e in entries}


def _count(entry: Entry, store: Store, record: StudyRecord | None) -> Standing:
    wanted = [] if record is None else store.trials(record.id)[: entry.config.study.trials]
    return Standing(
        name=entry.name,
        told=sum(t.status is not TrialStatus.RUNNING for t in wanted),
        trials=entry.config.study.trials,
        failed=sum(t.status is TrialStatus.FAILED for t in wanted),
        violating=sum(t.score is not None and not t.score.feasible for t in wanted),
        result=StudyResult(None, Reason.NONE) if record is None else read_result(store, record, wanted),
    )


def _standing(future: Future[Standing], entry: Entry, kept: str | Path, losses: dict[str, tuple[int, int]]) -> Standing:
    try:
        return future.result()
    except Exception as error:  # noqa: BLE001 - the other studies go on, and this one says why it does not
        message: str | None = f"{type(error).__name__}: {error}"
        with Store(kept, read_only=True) as store:
            now = standings(store, [entry])[entry.name]
        if isinstance(error, BrokenExecutor):
            told, times = losses.get(entry.name, (-1, 0))
            losses[entry.name] = now.told, 1 if now.told > told else times + 1
            message = None if losses[entry.name][1] <= LOSSES_MAX else message
        return Standing(now.name, now.told, now.trials, now.failed, now.violating, now.result, message)


def _turn(entry: Entry, kept: str | Path) -> Standing:
    """Batches of one study for a while, in a worker."""
    evaluation = evaluation_of(entry.config.study.tuner, entry.config.problem(entry.folder))
    end = time.monotonic() + TURN_S
    wanted = entry.config.study.trials
    with Store(kept, busy_timeout_s=60.0) as store, open_study(store, entry.config, entry.folder) as study:
        while True:
            count = len(study.trials())
            # What a dead process left is told first, then one batch.
            limit = max(count, 1) if study.running() else (count // study.batch + 1) * study.batch
            study.advance(evaluation, min(limit, wanted))
            standing = _count(entry, store, study.record)
            if standing.told >= wanted:
                # Asking a tuner may take seconds, so it is asked once.
                study.result()
                return _count(entry, store, study.record)
            if time.monotonic() > end:
                return standing


def _seeds(path: Path, seeds: str | list[int]) -> list[int]:
    where = f"{path}: campaign.seeds = {seeds!r}: allowed are different whole numbers >= 0, as a list or as text A:B (B not included)"
    try:
        found = list(range(*(int(part) for part in seeds.split(":", 1)))) if isinstance(seeds, str) and ":" in seeds else seeds
    except ValueError as error:
        raise ValueError(where) from error
    if isinstance(found, str) or not found or min(found) < 0 or len(set(found)) != len(found):
        raise ValueError(where)
    return found
