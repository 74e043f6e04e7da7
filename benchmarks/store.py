"""What a store costs. Run: python benchmarks/store.py [--json] [--store URL].

``tell``: milliseconds and kilobytes of a told trial with a trace of 3600 samples of 6 signals, a charge of an hour sampled each
second. ``cycler``: every signal with noise and the resolution of an instrument. ``simulated``: noise in double precision on voltage and
temperatures, the others smooth. ``worst``: noise in double precision on all six, of which about 42 of 64 bits are random and nothing
compresses them. The time is that of `Study.tell`: encoding, hash, one transaction, on the disk. ``probe`` is what the disk itself
takes for a write of that size with fsync, in the same run.
``list``: seconds to open a store of 2000 trials in its own process and list them all.
Medians; goals are at most 10 ms and 120 kB, and 0.5 s.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.study.serialization import score_to_json
from chargetune.study.store.store import Store
from chargetune.study.store.trace import encode
from chargetune.study.study import Study
from chargetune.study.trial import Trial, TrialStatus

SPACE = ParameterSpace(tuple(Parameter(f"backoff_{k}", 0.0, 0.2, 0.1) for k in range(16)))
SAMPLES, TRIALS, LISTED = 3600, 60, 2000
SIGNALS = ("current_A", "voltage_V", "temperature_surface_K", "temperature_ambient_K", "soc", "anode_potential_V")


@dataclass(frozen=True)
class Points:
    """Any thetas; a tuner's own time is not the store's."""

    def ask(self, space, trials, n=1):
        """``n`` random points, by the number of trials."""
        return space.from_unit(np.random.default_rng(len(trials)).random((n, space.dimension)))


@dataclass(frozen=True)
class Hour:
    """An hour of charging, sampled each second."""

    signals: np.ndarray

    def arrays(self):
        """As a store takes them."""
        return {"time_s": np.arange(SAMPLES, dtype=float), "signals": self.signals}

    def meta(self):
        """Names, units, sampling time."""
        return {"names": list(SIGNALS), "units": dict(zip(SIGNALS, ("A", "V", "K", "K", "1", "V"), strict=True)), "sampling_time_s": 1.0}


KINDS = ("cycler", "simulated", "worst")


def hour(seed, kind):
    """Six signals of a charge, shape (3600, 6)."""
    rng, t = np.random.default_rng(seed), np.arange(SAMPLES)
    current = 6.0 * np.exp(-np.maximum(t - 1800, 0) // 10 * 10 / 900.0)
    soc = 0.05 + np.cumsum(current) / 3600.0 / 5.0
    voltage = 3.4 + 0.75 * soc + 0.02 * current
    smooth = np.column_stack([current, voltage, 300 + 15 * (1 - np.exp(-t / 900)), np.full(SAMPLES, 298.15), soc, 0.1 - 0.015 * current])
    noise = np.array([1e-3, 1e-3, 0.05, 0.05, 1e-5, 1e-3]) * ([0, 1, 1, 1, 0, 0] if kind == "simulated" else 1)
    signals = smooth + rng.normal(0, 1, smooth.shape) * noise
    step = np.array([1e-3, 1e-4, 1e-2, 1e-2, 1e-5, 1e-4])
    return np.round(signals / step) * step if kind == "cycler" else signals


def told(location, kind):
    """Milliseconds and kilobytes of a told trial, and their parts."""
    traces = [Hour(hour(seed, kind)) for seed in range(TRIALS)]
    ask, tell, encoding = [], [], []
    with Store(location) as store, Study.create_or_resume(store, kind, config={}, space=SPACE, tuner=Points()) as study:
        for k, trace in enumerate(traces):
            begin = time.perf_counter()
            (trial,) = study.hand_out(study.ask())
            ask.append(time.perf_counter() - begin)
            score = Score(
                1.0, 1.0, {f"voltage_{w}": 1e-3 * k for w in range(5)}, {f"voltage_{w}": 1e-3 for w in range(5)}, {"t80_min": 30.0}
            )
            begin = time.perf_counter()
            study.tell(trial.number, score, trace, attempt=trial.attempt)
            tell.append(time.perf_counter() - begin)
            begin = time.perf_counter()
            blob = encode(trace.arrays(), trace.meta())
            encoding.append(time.perf_counter() - begin)
    out = {
        "tell_ms": median_ms(tell),
        "tell_ms_90_percent": round(1e3 * float(np.quantile(tell, 0.9)), 2),
        "of_which_encode_ms": median_ms(encoding),
        "ask_and_hand_out_ms": median_ms(ask),
        "trace_kB": round(len(blob) / 1e3, 1),
        "plain_kB": round((SAMPLES * 7 * 8) / 1e3, 1),
    }
    path = Path(location)
    if "://" not in location:
        # After the log is folded in, as closing the store leaves it.
        out["file_kB_per_trial"] = round(path.stat().st_size / 1e3 / TRIALS, 1)
        out["probe_ms"] = median_ms(probe(path.with_name("probe"), len(blob)))
    return out


def probe(path, size):
    """Seconds of one write with fsync."""
    out = []
    for _ in range(TRIALS):
        begin = time.perf_counter()
        with path.open("ab") as file:
            file.write(os.urandom(size))
            file.flush()
            os.fsync(file.fileno())
        out.append(time.perf_counter() - begin)
    return out


def listed(location):
    """Seconds to open the store and list 2000 told trials with their scores."""
    windows = {f"voltage_{w}": 1e-3 for w in range(5)}
    score = Score(1.0, 1.0, windows, windows, {"t80_min": 30.0, "t95_min": 50.0}, {"voltage_V": tuple(1e-3 * k for k in range(5))})
    score_to_json(score)
    thetas, blob = Points().ask(SPACE, [], LISTED), encode(Hour(hour(0, "cycler")).arrays(), {})
    with Store(location) as store:
        study = store.add_study("long", {"space": []}).id
        store.add_trials(study, [Trial(k, tuple(theta), provenance={"versions": {"numpy": "2"}}) for k, theta in enumerate(thetas)])
        for k in range(LISTED):
            # Traces lie in the store too, a tenth of them here: a listing must not read past them.
            store.finish_trial(
                study, k, score=score, ending="done", trace=None if k % 10 else blob, provenance={"versions": {"numpy": "2"}}
            )
    times = []
    for _ in range(7):
        begin = time.perf_counter()
        with Store(location, read_only=True) as store:
            trials = store.trials(store.study("long").id)
        times.append(time.perf_counter() - begin)
    assert sum(t.status is TrialStatus.DONE for t in trials) == LISTED  # noqa: S101 - what is not there is not listed fast
    return {"trials": LISTED, "list_s": round(statistics.median(times), 4), "slowest_s": round(max(times), 4)}


def median_ms(seconds):
    """Median in milliseconds."""
    return round(1e3 * statistics.median(seconds), 2)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--store", help="an empty database, postgresql://...; by default files in a temporary folder")
    parser.add_argument("--folder", help="where that folder is; by default the system's")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        places = {name: arguments.store or str(Path(folder) / f"{name}.db") for name in (*KINDS, "list")}
        found = {kind: told(places[kind], kind) for kind in KINDS}
        found["list"] = listed(places["list"])
    found["load"] = [round(load, 1), round(os.getloadavg()[0], 1)]
    if arguments.json:
        print(json.dumps(found))
        return
    for name, figures in found.items():
        print(name, figures if isinstance(figures, list) else ", ".join(f"{key} {value}" for key, value in figures.items()))


if __name__ == "__main__":
    main()
