"""Who may look: a token, or this machine alone; and the headers that keep a page from doing what it should not."""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass, field
from urllib.parse import quote, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["LEAST_TOKEN", "Guard", "is_loopback"]

LEAST_TOKEN = 16

HEADERS = {
    # plotly.js writes style attributes; elements with styles or scripts of their own are never run.
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; style-src-attr 'unsafe-inline'; connect-src 'self';"
        " img-src 'self' data: blob:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


@dataclass(frozen=True)
class Guard:
    """Lets a request through to ``app`` if it may see it.

    With a ``token`` it must bring the token: once as ``?token=``, for which it gets a cookie, or as ``Authorization: Bearer``. Without
    one its Host must be a name of this machine, ``hosts``: else any page could have its own name resolve to 127.0.0.1, and read.
    """

    app: ASGIApp
    token: str | None = field(repr=False)
    hosts: frozenset[str]
    refused: str

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
            await send(message)

        answer = self._answer(Request(scope))
        await (self.app if answer is None else answer)(scope, receive, send_with_headers)

    def _answer(self, request: Request) -> Response | None:
        """None for a request that may pass."""
        if self.token is None:
            known = _host(request.headers.get("host", "")) in self.hosts
            return None if known else HTMLResponse("This server answers to names of this machine only.\n", 403, media_type="text/plain")
        name, seal = self._cookie(request)
        given = request.query_params.get("token")
        if given is not None and _same(given, self.token):
            # Without the token in its address the page can be shown to somebody, and no history has it.
            response = RedirectResponse("/" + quote(request.url.path.lstrip("/")), 303)
            response.set_cookie(name, seal, httponly=True, samesite="lax", secure=request.url.scheme == "https")
            return response
        scheme, _, bearer = request.headers.get("authorization", "").partition(" ")
        if (scheme.lower() == "bearer" and _same(bearer, self.token)) or _same(request.cookies.get(name, ""), seal):
            return None
        return HTMLResponse(self.refused, 401, {"www-authenticate": "Bearer"})

    def _cookie(self, request: Request) -> tuple[str, str]:
        # Browsers keep the cookies of all ports of a host together.
        port = (request.scope.get("server") or ("", 0))[1]
        return f"chargetune-{port}", hmac.new((self.token or "").encode(), b"chargetune web", "sha256").hexdigest()


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _same(given: str, right: str) -> bool:
    """Whether two texts are equal, in a time that does not tell how much of them is."""
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), right.encode("utf-8", "surrogatepass"))


def _host(value: str) -> str:
    try:
        return urlsplit(f"//{value}").hostname or ""
    except ValueError:
        return ""
