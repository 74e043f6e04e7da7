"""chargetune web."""

from __future__ import annotations

import contextlib
import errno
import socket

from chargetune.cli.output import console
from chargetune.runtime.counted import counted
from chargetune.runtime.interrupts import unwatched
from chargetune.study.store.store import Store

__all__ = ["web_command"]


def web_command(location: str, *, port: int, host: str, token: str | None) -> None:
    """Serve a store until Ctrl-C."""
    try:
        import uvicorn

        from chargetune.web.app import make_app
        from chargetune.web.guard import LEAST_TOKEN, is_loopback
    except ModuleNotFoundError as error:
        raise ValueError(f"chargetune web needs {error.name}: pip install 'chargetune[web]'") from error
    if token is None and not is_loopback(host):
        raise ValueError(f"--host {host} can be reached from other machines: give a --token of at least {LEAST_TOKEN} characters")
    if token is not None and (len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable()):
        raise ValueError(f"--token has {counted(len(token), 'character')}, allowed are at least {LEAST_TOKEN} printable ASCII ones")
    with Store(location, read_only=True) as store:
        label = store.label  # what cannot be shown is refused now
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with _listening(host, port, family) as listening:
        bound = listening.getsockname()[1]
        config = uvicorn.Config(
            make_app(location, token=token, hosts=frozenset({host.lower()}), ending=lambda: server.should_exit),
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=2,
        )
        server = uvicorn.Server(config)
        where = f"[{host}]" if family == socket.AF_INET6 else host
        secret = "" if token is None else " (once with ?token=... behind it)"
        console().print(f"{label}: http://{where}:{bound}/{secret} (Ctrl-C ends it)", markup=False, soft_wrap=True)
        # uvicorn passes Ctrl-C on once it has ended in good order.
        with contextlib.suppress(KeyboardInterrupt), unwatched():
            server.run(sockets=[listening])


def _listening(host: str, port: int, family: socket.AddressFamily) -> socket.socket:
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(f"--port {port} is taken on {host} by another program; --port 0 takes a free one") from error
        raise
