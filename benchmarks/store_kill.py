"""Three writers on one store, killed at random with SIGKILL. Run: python benchmarks/store_kill.py [--kills 100] [--json].

Each writer runs a study of its own in the one store, a trial in some milliseconds, and says through a pipe which trial was told.
A random one is killed after a random pause and begun again, while the others go on. After each kill: what was acknowledged is
stored as it was said, with its trace; at most one trial of the dead writer is running. At the end: the check of the whole store
finds nothing, every trial is what the study alone decides, and not more trials were begun again than processes were killed.
Exit code 1 when any of this is not so. ``--store`` takes another place, such as postgresql://user@host/database.
"""

import argparse
import json
import multiprocessing
import os
import select
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.study.evaluation import trial_seed
from chargetune.study.store.integrity import check_store
from chargetune.study.store.store import Store
from chargetune.study.store.trace import content_sha256
from chargetune.study.study import Study

# A fork is at work in a millisecond, so that kills fall into the work and not into imports.
FORK = multiprocessing.get_context("fork")
SPACE = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5), Parameter("y", 0.0, 1.0, 0.5)))
WRITERS = ("a", "b", "c")
SAMPLES = 600


@dataclass(frozen=True)
class Recurrence:
    """Thetas by their number alone."""

    def ask(self, space, trials, n=1):
        """The next ``n`` points."""
        steps = np.arange(len(trials) + 1, len(trials) + n + 1)[:, None]
        return (steps * np.array([0.7548776662466927, 0.5698402909980532])) % 1.0


@dataclass(frozen=True)
class Trace:
    """Six signals."""

    values: np.ndarray

    def arrays(self):
        """As a store takes them."""
        return {"signals": self.values}

    def meta(self):
        """Sampling time."""
        return {"sampling_time_s": 1.0}


def evaluate(theta, seed):
    """A score and a trace that depend on theta and seed alone."""
    values = theta.sum() + np.random.default_rng(seed).normal(0, 1e-3, (SAMPLES, 6))
    return Score(float(values.mean()), float(values.mean()), {"v": float(theta[0] - 0.9)}, {"v": 0.0}), Trace(values), "done"


def write(location, name, told):
    """One writer, until somebody ends it."""

    def acknowledge(trial, *_):
        line = json.dumps([name, trial.number, trial.score.objective, trial.trace_sha256]).encode()
        os.write(told, line + b"\n")  # shorter than PIPE_BUF, so whole or not at all

    with Store(location, busy_timeout_s=60.0) as store:
        study = Study.create_or_resume(store, name, config={}, space=SPACE, tuner=Recurrence(), seed=WRITERS.index(name))
        study.run(evaluate, 1_000_000, attempts=1_000_000, progress=acknowledge)


def run(location, kills, seed=0):
    """Kill so often; what was counted, and the promises that were broken."""
    rng, begin = np.random.default_rng(seed), time.perf_counter()
    with Store(location):
        pass
    read, told = os.pipe()
    start = {name: FORK.Process(target=write, args=(location, name, told), daemon=True) for name in WRITERS}
    for process in start.values():
        process.start()
    acknowledged, broken, at_work = {}, [], 0
    for _ in range(kills):
        time.sleep(rng.uniform(0.0, 0.3))
        name = str(rng.choice(WRITERS))
        start[name].kill()
        start[name].join()
        new = heard(read)
        acknowledged |= new
        running, faults = look(location, name, new)
        broken += faults
        at_work += running
        start[name] = FORK.Process(target=write, args=(location, name, told), daemon=True)
        start[name].start()
    for process in start.values():
        process.kill()
        process.join()
    kills += len(WRITERS)
    acknowledged |= heard(read)
    os.close(read)
    os.close(told)
    verdict = check_store(location)
    broken += [f"check of the store: {finding}" for finding in verdict.findings]
    told_trials, again, faults = compare(location, acknowledged)
    broken += faults
    if again > kills:
        broken.append(f"{again} trials were begun again after {kills} kills")
    return {
        "kills": kills,
        "kills_with_a_running_trial": at_work,
        "acknowledged": len(acknowledged),
        "told": told_trials,
        "begun_again": again,
        "traces_checked": verdict.traces,
        "seconds": round(time.perf_counter() - begin, 1),
        "broken": broken,
    }


def heard(read):
    """What the writers acknowledged since the last time."""
    data = b""
    while select.select([read], [], [], 0)[0]:
        data += os.read(read, 65536)
    return {(name, number): (objective, hashed) for name, number, objective, hashed in map(json.loads, data.splitlines())}


def look(location, killed, new):
    """Whether the dead writer left a running trial, and what is not as it was promised."""
    broken = []
    with Store(location, read_only=True) as store:
        ids = {record.name: record.id for record in store.studies()}
        trials = {name: store.trials(study) for name, study in ids.items()}
        for (name, number), (objective, hashed) in new.items():
            trial = trials[name][number] if name in trials and number < len(trials[name]) else None
            if trial is None or trial.score is None or (trial.score.objective, trial.trace_sha256) != (objective, hashed):
                broken.append(f"study {name}, trial {number} was acknowledged and is stored as {trial}")
            elif content_sha256(*store.trace(ids[name], number)) != hashed:
                broken.append(f"study {name}, trial {number}: its trace is another one")
    running = [t.number for t in trials.get(killed, []) if t.status == "running"]
    if len(running) > 1:
        broken.append(f"study {killed} has the running trials {running}")
    return bool(running), broken


def compare(location, acknowledged):
    """Number of told trials, of attempts after the first, and what differs from studies that nobody interrupts."""
    told = again = 0
    broken = []
    with Store(location, read_only=True) as store:
        for record in store.studies():
            trials = store.trials(record.id)
            thetas = Recurrence().ask(SPACE, [], len(trials))
            seed = WRITERS.index(record.name)
            for number, (trial, theta) in enumerate(zip(trials, thetas, strict=True)):
                again += max(0, trial.attempt - 1)
                if (trial.number, trial.seed, trial.theta) != (number, trial_seed(seed, number), tuple(theta)):
                    broken.append(f"study {record.name}, trial {number} is {trial}")
                if trial.score is None:
                    continue
                told += 1
                score, trace, _ = evaluate(theta, trial.seed)
                if trial.score != score or trial.trace_sha256 != content_sha256(trace.arrays(), trace.meta()):
                    broken.append(f"study {record.name}, trial {number}: another result than without interruption")
            lost = {n for name, n in acknowledged if name == record.name} - {t.number for t in trials if t.score is not None}
            broken += [f"study {record.name}, trial {n} was acknowledged and is lost" for n in sorted(lost)]
    return told, again, broken


def main():
    """Kill, count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", help="a new file or postgresql://...; by default a file in a temporary folder")
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(arguments.store or str(Path(folder) / "killed.db"), arguments.kills, arguments.seed)
    if arguments.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name}: {value}")
    sys.exit(bool(found["broken"]))


if __name__ == "__main__":
    main()
