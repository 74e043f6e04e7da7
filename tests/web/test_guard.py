import asyncio

import pytest
from html_check import parsed
from starlette.testclient import TestClient

from chargetune.web.app import make_app
from chargetune.web.guard import is_loopback

TOKEN = "correct horse battery"
ONE = "/studies/1"
EVERY = ["/", ONE, "/stream", f"{ONE}/stream", f"{ONE}/trials/1", f"{ONE}/trials/1/trace.csv", "/static/study.js", "/x"]


def client(store, base="http://127.0.0.1", **options):
    return TestClient(make_app(store, **options), base_url=base, follow_redirects=False)


@pytest.mark.parametrize("path", EVERY)
@pytest.mark.parametrize(
    "bring",
    [
        {}, {"params": {"token": ""}}, {"params": {"token": TOKEN[:-1]}}, {"params": {"token": TOKEN + "x"}}, {"params": {"token": "ü"}},
        {"headers": {"authorization": "Bearer nonsense"}}, {"headers": {"authorization": TOKEN}}, {"headers": {"authorization": "Bearer"}},
        {"cookies": {"chargetune-80": TOKEN}}, {"cookies": {"chargetune-80": ""}},
    ],
)  # fmt: skip
def test_without_the_token_nothing_is_shown(store, path, bring):
    visitor = client(store, token=TOKEN)
    visitor.cookies.update(bring.pop("cookies", {}))
    found = visitor.get(path, **bring)
    assert found.status_code == 401
    assert "Token needed" in found.text
    parsed(found.text)
    assert TOKEN not in found.text
    assert "set-cookie" not in found.headers


def test_token_in_the_address_becomes_a_cookie(store):
    visitor = client(store, token=TOKEN)
    first = visitor.get("/studies/1", params={"token": TOKEN})
    assert first.status_code == 303
    assert first.headers["location"] == "/studies/1"
    cookie = first.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "samesite=lax" in cookie.lower()
    assert TOKEN not in cookie
    assert visitor.get("/studies/1").status_code == 200
    assert visitor.get("/studies/1/trials/1").status_code == 200


def test_token_in_a_header(store):
    assert client(store, token=TOKEN).get("/", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200


@pytest.mark.parametrize("path", ["//evil.example", "/%5cevil.example", "///evil.example/x", "/%0d%0aset-cookie:x=1"])
def test_the_token_leads_to_no_other_server(store, path):
    location = client(store, token=TOKEN).get(f"http://127.0.0.1{path}", params={"token": TOKEN}).headers["location"]
    assert location.startswith("/")
    assert not location.startswith(("//", "/\\"))
    assert "\n" not in location


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "192.168.1.5", "[::2]", "[", "0.0.0.0"]
)
def test_without_token_only_names_of_this_machine_are_served(store, host):
    assert client(store).get("/", headers={"host": host}).status_code == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST:8000", "[::1]:8000", "127.0.0.1:1"])
def test_names_of_this_machine(store, host):
    assert client(store).get("/", headers={"host": host}).status_code == 200


def test_with_token_any_name_is_served(store):
    found = client(store, token=TOKEN).get("/", headers={"host": "lab.example", "authorization": f"Bearer {TOKEN}"})
    assert found.status_code == 200


@pytest.mark.parametrize("path", ["/", "/studies/1", "/studies/1/trials/1", "/x", "/static/look.css"])
def test_security_headers(store, path):
    headers = client(store).get(path).headers
    policy = {part.split()[0]: part.split()[1:] for part in headers["content-security-policy"].split(";")}
    assert policy["default-src"] == ["'none'"]
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == ["'self'"]
    assert policy["frame-ancestors"] == policy["base-uri"] == ["'none'"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cache-control"] == ("private, max-age=600" if "static" in path else "no-store")


def test_headers_stand_on_a_refusal_too(store):
    assert "content-security-policy" in client(store, token=TOKEN).get("/").headers
    assert "content-security-policy" in client(store).get("/", headers={"host": "evil.example"}).headers


def test_a_web_socket_is_not_served(store):
    sent = []

    async def send(message):
        sent.append(message)

    app = make_app(store)
    asyncio.run(app({"type": "websocket", "path": "/", "headers": [(b"host", b"127.0.0.1")]}, None, send))
    assert sent == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.1", "::1", "localhost"])
def test_loopback(host):
    assert is_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1", "lab.example", "", "127.0.0.1.example"])
def test_not_loopback(host):
    assert not is_loopback(host)
