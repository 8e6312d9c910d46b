"""Arming by the API: exactly the shown plan is armed, with the user's name; mismatches are refused."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
from anyio import to_thread

from fdhil.arming.token import ensure_token
from fdhil.config import MachineConfig
from fdhil.config.user_file import Role, write_users
from fdhil.web.app import make_app
from tests.daemon.simulated_machine import SimulatedMachine
from tests.daemon.test_daemon_service import serving
from tests.web.clients import OWN, client_of, daemon_that, machine_of, user

PROGRAM = b"G21 G90\nG1 X10 F1000\nM2\n"
DIGEST = hashlib.sha256(PROGRAM).hexdigest()
ARMED = {"ok": True, "state": "ARMED", "text": "armed part.ngc", "program_digest": DIGEST}
LIMITS = {"max_offset_um": 250.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0, "max_torque_nm": None}
RUNNING = {"config_digest": "another", "limits": {"X": {**LIMITS, "max_speed_rad_s": None}}}
PLAN = "/api/machine/plan?program=part.ngc"


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    (tmp_path / "nc").mkdir()
    (tmp_path / "nc" / "part.ngc").write_bytes(PROGRAM)
    return machine_of(tmp_path, acting=True, programs_directory="nc")


def granting(request: Mapping[str, Any]) -> Mapping[str, Any]:
    if request["request"] == "arm":
        return ARMED
    return {"ok": True, "state": "OFF", "text": "guard: OFF, offset 0"} | (
        RUNNING if request["request"] == "status" else {}
    )


async def confirmed(client: httpx.AsyncClient) -> dict[str, Any]:
    plan = (await client.get(PLAN)).json()
    return {"program": plan["program"]["name"], "method": plan["method"], "confirm": plan["confirm"]}


async def test_what_would_move_is_shown_and_that_is_armed_by_name(config: MachineConfig) -> None:
    token = ensure_token(_made(config))
    async with daemon_that(config, granting) as asked, client_of(make_app(config), "operator") as client:
        choice = (await client.get("/api/machine/programs")).json()
        plan = (await client.get(PLAN)).json()
        assert [program["name"] for program in choice["programs"]] == ["part.ngc"]
        assert plan["axes"]["X"]["max_offset_um"] == 250.0  # the daemon's, whatever the file says
        assert "the configuration file has changed" in plan["difference"]
        assert plan["program"]["sha256"] == DIGEST
        assert "path" not in plan["program"]
        assert all(request["request"] == "status" for request in asked)  # showing does nothing
        answer = await client.post("/api/machine/arm", json=await confirmed(client), headers=OWN)
        assert answer.json() == {"ok": True, "text": "armed part.ngc", "state": "ARMED"}
        assert token not in answer.text
    told = next(request for request in asked if request["request"] == "arm")
    path = str((config.store.directory.parent / "nc" / "part.ngc").resolve())
    assert (told["program"], told["by"], told["token"], told["progress"]) == (path, "operator", token, True)
    assert told["program_digest"] == DIGEST


async def test_a_program_that_changed_since_it_was_shown_is_not_armed(config: MachineConfig) -> None:
    ensure_token(_made(config))
    async with daemon_that(config, granting) as asked, client_of(make_app(config), "operator") as client:
        request = await confirmed(client)
        (config.store.directory.parent / "nc" / "part.ngc").write_bytes(PROGRAM + b"%")
        answer = await client.post("/api/machine/arm", json=request, headers=OWN)
        assert (answer.status_code, answer.json()["code"]) == (409, "PlanChanged")
        assert not [request for request in asked if request["request"] == "arm"]


@pytest.mark.usefixtures("long_computation")
async def test_a_program_that_changed_while_it_was_armed_is_disarmed(config: MachineConfig) -> None:
    ensure_token(_made(config))

    def other(request: Mapping[str, Any]) -> Mapping[str, Any]:
        return {**granting(request), "program_digest": "0" * 64}

    async with daemon_that(config, other) as asked, client_of(make_app(config), "operator") as client:
        answer = await client.post("/api/machine/arm", json=await confirmed(client), headers=OWN)
    assert (answer.status_code, answer.json()["code"]) == (409, "PlanChanged")
    assert asked[-1]["request"] == "disarm"


async def test_what_the_daemon_refuses_is_told_with_all_its_reasons(config: MachineConfig) -> None:
    async with serving(config, SimulatedMachine()), client_of(make_app(config), "operator") as client:
        answer = await client.post("/api/machine/arm", json=await confirmed(client), headers=OWN)
        disarmed = await client.post("/api/machine/disarm", headers=OWN)
    told = answer.json()
    assert (answer.status_code, told["ok"], told["code"]) == (409, False, "ModelNotValidated")
    assert told["advice"] == "run a few rapids of this axis"
    assert told["refused"]
    assert disarmed.json()["code"] == "GuardAbsent"


async def test_one_who_may_only_watch_may_disarm(config: MachineConfig) -> None:
    async with daemon_that(config, granting) as asked, client_of(make_app(config), "watcher") as client:
        answer = await client.post("/api/machine/disarm", headers=OWN)
    assert answer.json() == {"ok": True, "text": "guard: OFF, offset 0", "state": "OFF"}
    assert asked == [{"request": "disarm", "by": "watcher"}]


@pytest.mark.parametrize("daemon", [True, False])
async def test_a_disarm_waits_for_none_of_the_threads_that_serve_pages(config: MachineConfig, daemon: bool) -> None:
    threads = to_thread.current_default_thread_limiter()
    for _ in range(round(threads.total_tokens)):
        threads.acquire_on_behalf_of_nowait(object())
    async with AsyncExitStack() as stack, asyncio.timeout(60):
        if daemon:
            await stack.enter_async_context(daemon_that(config, granting))
        client = await stack.enter_async_context(client_of(make_app(config), "operator", **OWN))
        answer = await client.post("/api/machine/disarm")
        who = await client.get("/api/session")
    assert (answer.status_code, who.json()["name"]) == (200 if daemon else 503, "operator")


async def test_a_daemon_that_is_gone_is_told_with_what_to_do(config: MachineConfig) -> None:
    async with client_of(make_app(config), "operator") as client:
        answer = await client.post("/api/machine/disarm", headers=OWN)
    assert (answer.status_code, answer.json()["code"]) == (503, "ConnectError")
    assert answer.json()["advice"] == "start it with fdhil run CONFIG"


@pytest.mark.parametrize(
    "query", ["", "program=part.ngc&method=nonsense", "program=..", "program=a%2Fb", "program=a%00"]
)
async def test_a_plan_that_is_none_is_refused(config: MachineConfig, query: str) -> None:
    async with client_of(make_app(config), "operator") as client:
        answer = await client.get(f"/api/machine/plan?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "BadRequest")


@pytest.mark.fault("G4")
async def test_no_name_leads_out_of_the_folder(config: MachineConfig, tmp_path: Path) -> None:
    (tmp_path / "secret.ngc").write_text("(canary)")
    nc = tmp_path / "nc"
    (nc / "link.ngc").symlink_to(tmp_path / "secret.ngc")
    (nc / "folder").mkdir()
    os.mkfifo(nc / "pipe")
    async with client_of(make_app(config), "operator") as client:
        names = [p["name"] for p in (await client.get("/api/machine/programs")).json()["programs"]]
        assert names == ["part.ngc"]
        for name, code in (("link.ngc", "BadName"), ("folder", "BadName"), ("pipe", "BadName"), ("none", "NotFound")):
            answer = await client.get("/api/machine/plan", params={"program": name})
            assert answer.json()["code"] == code, name
            assert "canary" not in answer.text
        for name in ("../secret.ngc", "/etc/passwd", "a\0b", "..", "x" * 65, "ä", "-x"):
            answer = await client.get("/api/machine/plan", params={"program": name})
            assert (answer.status_code, answer.json()["code"]) == (422, "BadRequest"), name


@pytest.mark.usefixtures("real_time")
async def test_who_goes_away_while_a_program_is_checked_has_nothing_armed(config: MachineConfig) -> None:
    ensure_token(_made(config))
    gone, abandoned = asyncio.Event(), asyncio.Event()

    async def checking(request: Mapping[str, Any]) -> Mapping[str, Any]:
        if request["request"] == "arm":
            gone.set()
            await abandoned.wait()
        return granting(request)

    app = make_app(config)
    async with daemon_that(config, checking, abandoned.set), client_of(app, "operator") as client:
        await _posting(app, client, await confirmed(client), gone)
        await abandoned.wait()


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("left", [{}, {"operator": "watch"}])
async def test_a_user_who_is_removed_while_a_program_is_checked_has_nothing_armed(
    config: MachineConfig, tmp_path: Path, left: dict[str, Role]
) -> None:
    ensure_token(_made(config))
    abandoned = asyncio.Event()

    async def checking(request: Mapping[str, Any]) -> Mapping[str, Any]:
        if request["request"] == "arm":
            write_users(tmp_path / "users.json", {name: user(role) for name, role in left.items()})
            await abandoned.wait()
        return granting(request)

    async with (
        daemon_that(config, checking, abandoned.set),
        client_of(make_app(config), "operator", **OWN) as client,
    ):
        answer = await client.post("/api/machine/arm", json=await confirmed(client))
        await abandoned.wait()
    assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


async def _posting(app: Any, client: httpx.AsyncClient, document: dict[str, Any], gone: asyncio.Event) -> None:
    body = json.dumps(document).encode()
    headers = {**client.headers, **OWN, "host": "localhost", "content-type": "application/json"}
    first = True

    async def receive() -> dict[str, Any]:
        nonlocal first
        if first:
            first = False
            return {"type": "http.request", "body": body}
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(_: Any) -> None:
        pass

    scope = {
        "type": "http", "method": "POST", "path": "/api/machine/arm", "raw_path": b"/api/machine/arm", "scheme": "http",
        "headers": [(k.lower().encode(), v.encode()) for k, v in headers.items()], "query_string": b"",
        "http_version": "1.1", "client": ("127.0.0.1", 1), "server": ("localhost", 80),
    }  # fmt: skip
    await app(scope, receive, send)


def _made(config: MachineConfig) -> Path:
    config.run_directory.mkdir(parents=True, exist_ok=True)
    return config.run_directory
