"""Every route of the application: required login, origin, host name and size."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute, APIWebSocketRoute

from fdhil.web.access import Asker
from fdhil.web.app import make_app, page_routers
from fdhil.web.gate import DISARM, LARGEST_BODY, READING
from tests.web.clients import OWN, app_of, client_of, machine_of

OPEN = "/api/session"
NOT_ACTING = ("/api/program",)


def listed(*, writing: bool) -> list[tuple[str, str]]:
    found = [route for router in page_routers() for route in router.routes if isinstance(route, APIRoute)]
    named = [(m, re.sub(r"\{[^}]*\}", "1", route.path)) for route in found for m in sorted(route.methods or ())]
    return [(m, p) for m, p in named if p != OPEN and (m not in READING) is writing]


WRITES, READS = listed(writing=True), listed(writing=False)


def kind_of(path: str) -> str:
    return "computes" if path.startswith(NOT_ACTING) else "disarms" if path == DISARM else "acts"


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return app_of(tmp_path_factory.mktemp("machine"), acting=True)


@pytest.fixture(scope="module")
def careful(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return app_of(tmp_path_factory.mktemp("careful"))


@pytest.fixture(scope="module")
def without_users(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return make_app(machine_of(tmp_path_factory.mktemp("without"), users=False))


@pytest.fixture
async def stranger(app: FastAPI) -> AsyncIterator[httpx.AsyncClient]:
    async with client_of(app) as client:
        yield client


@pytest.mark.goal("R16")
def test_there_are_routes_of_both_kinds(record_property: Callable[[str, object], None]) -> None:
    assert ("POST", "/api/machine/arm") in WRITES
    assert ("POST", DISARM) in WRITES
    assert ("GET", "/api/machine") in READS
    told = f"{len(WRITES)} routes that write, each refused without a login, from another page and by another name"
    record_property("goal", told)


def test_no_route_is_beside_those_of_the_pages(app: FastAPI) -> None:
    paths = {path for route in app.routes if (path := getattr(route, "path", "")).startswith("/api")}
    assert paths == {"/api/openapi.json"}


@pytest.mark.fault("G1")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_a_write_is_refused_without_a_login(stranger: httpx.AsyncClient, method: str, path: str) -> None:
    for token in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic b3A6b3A="}, {"Cookie": "token=x"}):
        answer = await stranger.request(method, path, headers={**OWN, **token}, json={})
        assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired"), token
        assert answer.headers["www-authenticate"] == "Bearer"


@pytest.mark.fault("G1")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_a_write_is_refused_when_its_login_has_ended(app: FastAPI, method: str, path: str) -> None:
    async with client_of(app, "operator") as client:
        assert (await client.delete("/api/session", headers=OWN)).status_code == 200
        answer = await client.request(method, path, headers=OWN, json={})
        assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


@pytest.mark.fault("G2")
@pytest.mark.goal("R16")
@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_a_write_is_refused_from_another_page(app: FastAPI, method: str, path: str) -> None:
    async with client_of(app, "operator") as client:
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
async def test_no_other_name_leads_here(app: FastAPI, method: str, path: str) -> None:
    async with client_of(app, "operator") as client:
        for host in ("evil.example", "localhost.evil.example", "evil@localhost", "localhost/x", "", "[::2]"):
            answer = await client.request(method, path, headers={**OWN, "Host": host}, json={})
            assert (answer.status_code, answer.json()["code"]) == (421, "BadHost"), host


@pytest.mark.parametrize(("method", "path"), WRITES)
async def test_a_write_is_refused_to_who_may_only_watch(app: FastAPI, method: str, path: str) -> None:
    async with client_of(app, "watcher") as client:
        answer = await client.request(method, path, headers=OWN, json={})
    refused = answer.json().get("code") == "RoleRequired"
    assert refused == (kind_of(path) == "acts"), answer.text
    assert answer.status_code == 403 or not refused


@pytest.mark.parametrize(("method", "path"), [route for route in WRITES if kind_of(route[1]) == "acts"])
async def test_nothing_acts_by_default(careful: FastAPI, method: str, path: str) -> None:
    async with client_of(careful, "operator") as client:
        answer = await client.request(method, path, headers=OWN, json={})
    assert (answer.status_code, answer.json()["code"]) == (403, "ActingOff")


@pytest.mark.parametrize(("method", "path"), [route for route in WRITES if kind_of(route[1]) != "computes"])
async def test_without_users_nobody_acts(without_users: FastAPI, method: str, path: str) -> None:
    async with client_of(without_users) as client:
        answer = await client.request(method, path, headers=OWN, json={})
    assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


@pytest.mark.parametrize(("method", "path"), READS)
async def test_a_read_needs_a_login_where_there_are_users(stranger: httpx.AsyncClient, method: str, path: str) -> None:
    answer = await stranger.request(method, path)
    assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


async def test_what_a_stranger_sees_tells_nothing_of_the_machine(stranger: httpx.AsyncClient, app: FastAPI) -> None:
    """As stated in docs/how-to/browser.md: the shell, its scripts, and that a login is needed."""
    seen = []
    for path in ("/", "/machine", "/live", "/static/app.js", "/static/uplot/uPlot.min.css", OPEN, "/nothing", "/api/x"):
        answer = await stranger.get(path)
        assert "server" not in answer.headers
        seen.append(answer.text)
    assert (await stranger.get(OPEN)).json() == {"name": "", "role": None, "login_needed": True, "acting": False}
    for secret in ("bench", str(app.state.context.config.store.directory), "watcher", "operator", "0.1.0"):
        assert not [text for text in seen if secret in text and "<!doctype" not in text.lower()], secret


async def test_a_page_that_is_allowed_and_a_name_that_is_allowed_may(tmp_path: Path) -> None:
    machine = machine_of(tmp_path, allowed_hosts=["mill.local"], allowed_origins=["https://panel.example/"])
    async with client_of(make_app(machine), "watcher") as client:
        for more in ({"Host": "MILL.local:8437"}, {"Origin": "https://panel.example"}, {"Origin": "http://localhost"}):
            assert (await client.get("/api/machine", headers=more)).status_code == 200, more


async def test_a_body_is_bounded_before_it_is_read(app: FastAPI) -> None:
    async def endless() -> AsyncIterator[bytes]:
        for _ in range(3):
            yield b"[" * LARGEST_BODY

    async with client_of(app, "operator") as client:
        for body in (b" " * (LARGEST_BODY + 1), endless()):
            headers = {**OWN, "Content-Type": "application/json"}
            answer = await client.post("/api/machine/arm", content=body, headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (413, "TooLarge")


async def test_every_answer_forbids_what_a_page_of_ours_never_does(stranger: httpx.AsyncClient) -> None:
    for path in ("/", "/static/app.js", "/api/machine", "/nothing"):
        headers = (await stranger.get(path)).headers
        assert headers["content-security-policy"].startswith("default-src 'self';"), path
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cache-control"] == ("no-store" if path.startswith("/api") else "no-cache")
        assert not [name for name in headers if name.startswith("access-control") or name == "set-cookie"]


async def test_a_socket_is_refused_as_a_request_is(app: FastAPI) -> None:
    found = [route for router in page_routers() for route in router.routes]
    paths = [route.path for route in found if isinstance(route, APIWebSocketRoute)]
    assert paths
    own = [(b"host", b"localhost"), (b"origin", b"http://localhost")]
    for path in paths:
        for headers in (own, [own[0], (b"origin", b"http://evil.example")], [(b"host", b"evil.example")]):
            assert await _socket(app, path, headers) == ["websocket.close"], headers


async def _socket(app: FastAPI, path: str, headers: list[tuple[bytes, bytes]]) -> list[str]:
    sent: list[str] = []

    async def receive() -> dict[str, object]:
        return {"type": "websocket.connect"}

    async def send(message: dict[str, object]) -> None:
        sent.append(str(message["type"]))

    scope = {"type": "websocket", "path": path, "headers": headers, "scheme": "ws", "query_string": b""}
    await app(scope, receive, send)  # type: ignore[arg-type]
    return sent


def test_who_asks_is_empty_for_someone_on_this_computer(without_users: FastAPI) -> None:
    access = without_users.state.context.access
    assert access.asker(None) == Asker("", "watch")
