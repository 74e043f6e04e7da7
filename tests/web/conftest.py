"""One store with a study of each kind, and a server of it as `chargetune web` runs it."""

import contextlib
import socket
import sys
import threading
import time
from pathlib import Path

import pytest
import uvicorn

sys.path.insert(0, str(Path(__file__).parents[1] / "report"))

from report_studies import charging, other_study, run_charging

from chargetune.web.app import make_app

# Far beyond what any step takes, also on a loaded machine.
TIMEOUT_MS = 90_000


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    """Study 1 charges a battery, study 2 has markup for a name and no traces."""
    path = tmp_path_factory.mktemp("web") / "store.sqlite"
    run_charging(path, charging(tolerance_V=0.035), cut=(3,), raising=(6,))
    return other_study(path)


@pytest.fixture(scope="session")
def serve():
    """A function that serves a store on a port of this machine, a free one by default, while its context lasts, and gives the address."""

    @contextlib.contextmanager
    def run(path, port=0, **options):
        with socket.create_server(("127.0.0.1", port)) as listening:
            app = make_app(path, ending=lambda: server.should_exit, **options)
            server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=3))
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
            thread.start()
            end = time.monotonic() + 20
            while not server.started:
                assert time.monotonic() < end, "the server does not start"
                time.sleep(0.02)
            try:
                yield f"http://127.0.0.1:{listening.getsockname()[1]}"
            finally:
                server.should_exit = True
                thread.join(10)

    return run


@pytest.fixture
def open_page(chromium):
    """A function that opens an address in a fresh context and notes what goes wrong in it."""
    contexts = []

    def run(address, width=1400, scheme="light", wait=None):
        context = chromium.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.wrong = []
        page.on("pageerror", lambda error: page.wrong.append(str(error)))
        page.on("console", lambda m: page.wrong.append(m.text) if m.type == "error" else None)
        page.on("dialog", lambda dialog: (page.wrong.append("a script of the store ran"), dialog.dismiss()))
        page.goto(address)
        if wait:
            page.wait_for_selector(wait, state="attached")
        return page

    yield run
    for context in contexts:
        context.close()
