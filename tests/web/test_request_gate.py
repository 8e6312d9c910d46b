"""Every route of the application: required login, origin, host name and size."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute, APIWebSocketRoute

from fdhil.web.application import find_page_routers, make_app
from fdhil.web.login import Principal
from fdhil.web.request_gate import DISARM, LARGEST_BODY, READING
from tests.web.http_clients import OWN, make_client, make_test_app, write_machine

OPEN = "/api/session"
NOT_ACTING = ("/api/program",)


def list_routes(*, writing: bool) -> list[tuple[str, str]]:
    found = [route for router in find_page_routers() for route in router.routes if isinstance(route, APIRoute)]
    named = [(m, re.sub(r"\{[^}]*\}", "1", route.path)) for route in found for m in sorted(route.methods or ())]
    return [(m, p) for m, p in named if p != OPEN and (m not in READING) is writing]


WRITES, READS = list_routes(writing=True), list_routes(writing=False)


def classify_route(path: str) -> str:
    return "computes" if path.startswith(NOT_ACTING) else "disarms" if path == DISARM else "acts"


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return make_test_app(tmp_path_factory.mktemp("machine"), acting=True)


@pytest.fixture(scope="module")
def protected_client(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return make_test_app(tmp_path_factory.mktemp("careful"))


@pytest.fixture(scope="module")
def client_without_users(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return make_app(write_machine(tmp_path_factory.mktemp("without"), users=False))


@pytest.fixture
async def client_without_login(app: FastAPI) -> AsyncIterator[httpx.AsyncClient]:
    async with make_client(app) as client:
        yield client


@pytest.mark.goal("R16")
def test_routes_of_both_kinds_exist(record_property: Callable[[str, object], None]) -> None:
    assert ("POST", "/api/machine/arm") in WRITES
    assert ("POST", DISARM) in WRITES
    assert ("GET", "/api/machine") in READS
    reported = f"{len(WRITES)} routes that write, each refused without a login, from another page and by another name"
    record_property("goal", reported)


def test_no_route_exists_outside_the_pages(app: FastAPI) -> None:
    paths = {path for route in app.routes if (path := getattr(route, "path", "")).startswith("/api")}
    assert paths == {"/api/openapi.json"}


@pytest.mark.fault("G1")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_write_is_refused_without_login(client_without_login: httpx.AsyncClient, method: str, path: str) -> None:
    for token in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic b3A6b3A="}, {"Cookie": "token=x"}):
        answer = await client_without_login.request(method, path, headers={**OWN, **token}, json={})
        assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired"), token
        assert answer.headers["www-authenticate"] == "Bearer"


@pytest.mark.fault("G1")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_write_is_refused_after_login_ended(app: FastAPI, method: str, path: str) -> None:
    async with make_client(app, "operator") as client:
        assert (await client.delete("/api/session", headers=OWN)).status_code == 200
        answer = await client.request(method, path, headers=OWN, json={})
        assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


@pytest.mark.fault("G2")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_write_is_refused_from_foreign_page(app: FastAPI, method: str, path: str) -> None:
    async with make_client(app, "operator") as client:
        for foreign in ("http://evil.example", "null", "http://localhost:3000", "https://localhost", ""):
            answer = await client.request(method, path, headers={**OWN, "Origin": foreign}, json={})
            assert (answer.status_code, answer.json()["code"]) == (403, "BadOrigin"), foreign
        # what a form or an image of another page can send without being asked
        for site in ("cross-site", "same-site"):
            answer = await client.request(method, path, headers={**OWN, "Sec-Fetch-Site": site}, json={})
            assert (answer.status_code, answer.json()["code"]) == (403, "BadOrigin"), site
        answer = await client.request(method, path, json={})  # without the header of our own
        assert (answer.status_code, answer.json()["code"]) == (403, "BadOrigin")


@pytest.mark.fault("G3")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), [*WRITES, ("GET", "/api/machine"), ("GET", "/"), ("POST", OPEN)])
async def test_unknown_host_name_is_refused(app: FastAPI, method: str, path: str) -> None:
    async with make_client(app, "operator") as client:
        for host in ("evil.example", "localhost.evil.example", "evil@localhost", "localhost/x", "", "[::2]"):
            answer = await client.request(method, path, headers={**OWN, "Host": host}, json={})
            assert (answer.status_code, answer.json()["code"]) == (421, "BadHost"), host


@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_write_is_refused_to_watcher(app: FastAPI, method: str, path: str) -> None:
    async with make_client(app, "watcher") as client:
        answer = await client.request(method, path, headers=OWN, json={})
    refused = answer.json().get("code") == "RoleRequired"
    assert refused == (classify_route(path) == "acts"), answer.text
    assert answer.status_code == 403 or not refused


@pytest.mark.parametrize(("method", "path"), [route for route in WRITES if classify_route(route[1]) == "acts"])
async def test_acting_is_off_by_default(protected_client: FastAPI, method: str, path: str) -> None:
    async with make_client(protected_client, "operator") as client:
        answer = await client.request(method, path, headers=OWN, json={})
    assert (answer.status_code, answer.json()["code"]) == (403, "ActingOff")


@pytest.mark.parametrize(("method", "path"), [route for route in WRITES if classify_route(route[1]) != "computes"])
async def test_acting_is_refused_without_users(client_without_users: FastAPI, method: str, path: str) -> None:
    async with make_client(client_without_users) as client:
        answer = await client.request(method, path, headers=OWN, json={})
    assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


@pytest.mark.parametrize(("method", "path"), READS)
async def test_read_needs_login_if_there_are_users(
    client_without_login: httpx.AsyncClient, method: str, path: str
) -> None:
    answer = await client_without_login.request(method, path)
    assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


async def test_open_pages_reveal_nothing_of_the_machine(client_without_login: httpx.AsyncClient, app: FastAPI) -> None:
    """As stated in docs/how-to/browser.md: the shell, its scripts, and that a login is needed."""
    seen = []
    for path in ("/", "/machine", "/live", "/static/app.js", "/static/uplot/uPlot.min.css", OPEN, "/nothing", "/api/x"):
        answer = await client_without_login.get(path)
        assert "server" not in answer.headers
        seen.append(answer.text)
    assert (await client_without_login.get(OPEN)).json() == {
        "name": "",
        "role": None,
        "login_needed": True,
        "acting": False,
    }
    for secret in ("bench", str(app.state.context.config.store.directory), "watcher", "operator", "0.1.0"):
        assert not [text for text in seen if secret in text and "<!doctype" not in text.lower()], secret


async def test_allowed_origin_and_host_are_accepted(tmp_path: Path) -> None:
    machine = write_machine(tmp_path, allowed_hosts=["mill.local"], allowed_origins=["https://panel.example/"])
    async with make_client(make_app(machine), "watcher") as client:
        for more in ({"Host": "MILL.local:8437"}, {"Origin": "https://panel.example"}, {"Origin": "http://localhost"}):
            assert (await client.get("/api/machine", headers=more)).status_code == 200, more


async def test_body_is_limited_before_it_is_read(app: FastAPI) -> None:
    async def endless() -> AsyncIterator[bytes]:
        for _ in range(3):
            yield b"[" * LARGEST_BODY

    async with make_client(app, "operator") as client:
        for body in (b" " * (LARGEST_BODY + 1), endless()):
            headers = {**OWN, "Content-Type": "application/json"}
            answer = await client.post("/api/machine/arm", content=body, headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (413, "TooLarge")


async def test_every_response_has_security_headers(client_without_login: httpx.AsyncClient) -> None:
    for path in ("/", "/static/app.js", "/api/machine", "/nothing"):
        headers = (await client_without_login.get(path)).headers
        assert headers["content-security-policy"].startswith("default-src 'self';"), path
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cache-control"] == ("no-store" if path.startswith("/api") else "no-cache")
        assert not [name for name in headers if name.startswith("access-control") or name == "set-cookie"]


async def test_socket_is_refused_like_a_request(app: FastAPI) -> None:
    found = [route for router in find_page_routers() for route in router.routes]
    paths = [route.path for route in found if isinstance(route, APIWebSocketRoute)]
    assert paths
    own = [(b"host", b"localhost"), (b"origin", b"http://localhost")]
    for path in paths:
        for headers in (own, [own[0], (b"origin", b"http://evil.example")], [(b"host", b"evil.example")]):
            assert await _open_socket(app, path, headers) == ["websocket.close"], headers


async def _open_socket(app: FastAPI, path: str, headers: list[tuple[bytes, bytes]]) -> list[str]:
    sent: list[str] = []

    async def receive() -> dict[str, object]:
        return {"type": "websocket.connect"}

    async def send(message: dict[str, object]) -> None:
        sent.append(str(message["type"]))

    scope = {"type": "websocket", "path": path, "headers": headers, "scheme": "ws", "query_string": b""}
    await app(scope, receive, send)  # type: ignore[arg-type]
    return sent


def test_local_principal_has_empty_name(client_without_users: FastAPI) -> None:
    access = client_without_users.state.context.access
    assert access.find_principal(None) == Principal("", "watch")
