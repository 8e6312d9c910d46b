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

from fdhil.arming.operator_token import ensure_token
from fdhil.config import MachineConfig
from fdhil.config.user_file import Role, write_users
from fdhil.web.application import make_app
from tests.daemon.simulated_machine import SimulatedMachine
from tests.daemon.test_daemon_service import serving
from tests.web.http_clients import OWN, make_client, make_user, serve_daemon, write_machine

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
    return write_machine(tmp_path, acting=True, programs_directory="nc")


def grant_request(request: Mapping[str, Any]) -> Mapping[str, Any]:
    if request["request"] == "arm":
        return ARMED
    return {"ok": True, "state": "OFF", "text": "guard: OFF, offset 0"} | (
        RUNNING if request["request"] == "status" else {}
    )


async def confirm_plan(client: httpx.AsyncClient) -> dict[str, Any]:
    plan = (await client.get(PLAN)).json()
    return {"program": plan["program"]["name"], "method": plan["method"], "confirm": plan["confirm"]}


async def test_shown_plan_is_armed(config: MachineConfig) -> None:
    token = ensure_token(_make_app(config))
    async with serve_daemon(config, grant_request) as asked, make_client(make_app(config), "operator") as client:
        choice = (await client.get("/api/machine/programs")).json()
        plan = (await client.get(PLAN)).json()
        assert [program["name"] for program in choice["programs"]] == ["part.ngc"]
        assert plan["axes"]["X"]["max_offset_um"] == 250.0  # the daemon's, whatever the file says
        assert "the configuration file has changed" in plan["difference"]
        assert plan["program"]["sha256"] == DIGEST
        assert "path" not in plan["program"]
        assert all(request["request"] == "status" for request in asked)  # showing does nothing
        answer = await client.post("/api/machine/arm", json=await confirm_plan(client), headers=OWN)
        assert answer.json() == {"ok": True, "text": "armed part.ngc", "state": "ARMED"}
        assert token not in answer.text
    reported = next(request for request in asked if request["request"] == "arm")
    path = str((config.store.directory.parent / "nc" / "part.ngc").resolve())
    assert (reported["program"], reported["by"], reported["token"], reported["progress"]) == (
        path,
        "operator",
        token,
        True,
    )
    assert reported["program_digest"] == DIGEST


async def test_program_changed_since_plan_is_not_armed(config: MachineConfig) -> None:
    ensure_token(_make_app(config))
    async with serve_daemon(config, grant_request) as asked, make_client(make_app(config), "operator") as client:
        request = await confirm_plan(client)
        (config.store.directory.parent / "nc" / "part.ngc").write_bytes(PROGRAM + b"%")
        answer = await client.post("/api/machine/arm", json=request, headers=OWN)
        assert (answer.status_code, answer.json()["code"]) == (409, "PlanChanged")
        assert not [request for request in asked if request["request"] == "arm"]


@pytest.mark.usefixtures("long_computation")
async def test_program_changed_while_arming_is_disarmed(config: MachineConfig) -> None:
    ensure_token(_make_app(config))

    def other(request: Mapping[str, Any]) -> Mapping[str, Any]:
        return {**grant_request(request), "program_digest": "0" * 64}

    async with serve_daemon(config, other) as asked, make_client(make_app(config), "operator") as client:
        answer = await client.post("/api/machine/arm", json=await confirm_plan(client), headers=OWN)
    assert (answer.status_code, answer.json()["code"]) == (409, "PlanChanged")
    assert asked[-1]["request"] == "disarm"


async def test_daemon_refusal_is_returned_with_all_reasons(config: MachineConfig) -> None:
    async with serving(config, SimulatedMachine()), make_client(make_app(config), "operator") as client:
        answer = await client.post("/api/machine/arm", json=await confirm_plan(client), headers=OWN)
        disarmed = await client.post("/api/machine/disarm", headers=OWN)
    reported = answer.json()
    assert (answer.status_code, reported["ok"], reported["code"]) == (409, False, "ModelNotValidated")
    assert reported["advice"] == "run a few rapids of this axis"
    assert reported["refused"]
    assert disarmed.json()["code"] == "GuardAbsent"


async def test_watcher_may_disarm(config: MachineConfig) -> None:
    async with serve_daemon(config, grant_request) as asked, make_client(make_app(config), "watcher") as client:
        answer = await client.post("/api/machine/disarm", headers=OWN)
    assert answer.json() == {"ok": True, "text": "guard: OFF, offset 0", "state": "OFF"}
    assert asked == [{"request": "disarm", "by": "watcher"}]


@pytest.mark.parametrize("daemon", [True, False])
async def test_disarm_does_not_wait_for_page_threads(config: MachineConfig, daemon: bool) -> None:
    threads = to_thread.current_default_thread_limiter()
    for _ in range(round(threads.total_tokens)):
        threads.acquire_on_behalf_of_nowait(object())
    async with AsyncExitStack() as stack, asyncio.timeout(60):
        if daemon:
            await stack.enter_async_context(serve_daemon(config, grant_request))
        client = await stack.enter_async_context(make_client(make_app(config), "operator", **OWN))
        answer = await client.post("/api/machine/disarm")
        who = await client.get("/api/session")
    assert (answer.status_code, who.json()["name"]) == (200 if daemon else 503, "operator")


async def test_missing_daemon_is_reported_with_action(config: MachineConfig) -> None:
    async with make_client(make_app(config), "operator") as client:
        answer = await client.post("/api/machine/disarm", headers=OWN)
    assert (answer.status_code, answer.json()["code"]) == (503, "ConnectError")
    assert answer.json()["advice"] == "start it with fdhil run CONFIG"


@pytest.mark.parametrize(
    "query", ["", "program=part.ngc&method=nonsense", "program=..", "program=a%2Fb", "program=a%00"]
)
async def test_invalid_plan_is_refused(config: MachineConfig, query: str) -> None:
    async with make_client(make_app(config), "operator") as client:
        answer = await client.get(f"/api/machine/plan?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, "BadRequest")


@pytest.mark.fault("G4")
async def test_no_name_leads_out_of_the_program_folder(config: MachineConfig, tmp_path: Path) -> None:
    (tmp_path / "secret.ngc").write_text("(canary)")
    nc = tmp_path / "nc"
    (nc / "link.ngc").symlink_to(tmp_path / "secret.ngc")
    (nc / "folder").mkdir()
    os.mkfifo(nc / "pipe")
    async with make_client(make_app(config), "operator") as client:
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
async def test_disconnect_during_check_arms_nothing(config: MachineConfig) -> None:
    ensure_token(_make_app(config))
    gone, abandoned = asyncio.Event(), asyncio.Event()

    async def checking(request: Mapping[str, Any]) -> Mapping[str, Any]:
        if request["request"] == "arm":
            gone.set()
            await abandoned.wait()
        return grant_request(request)

    app = make_app(config)
    async with serve_daemon(config, checking, abandoned.set), make_client(app, "operator") as client:
        await _post_raw(app, client, await confirm_plan(client), gone)
        await abandoned.wait()


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("left", [{}, {"operator": "watch"}])
async def test_user_removed_during_check_arms_nothing(
    config: MachineConfig, tmp_path: Path, left: dict[str, Role]
) -> None:
    ensure_token(_make_app(config))
    abandoned = asyncio.Event()

    async def checking(request: Mapping[str, Any]) -> Mapping[str, Any]:
        if request["request"] == "arm":
            write_users(tmp_path / "users.json", {name: make_user(role) for name, role in left.items()})
            await abandoned.wait()
        return grant_request(request)

    async with (
        serve_daemon(config, checking, abandoned.set),
        make_client(make_app(config), "operator", **OWN) as client,
    ):
        answer = await client.post("/api/machine/arm", json=await confirm_plan(client))
        await abandoned.wait()
    assert (answer.status_code, answer.json()["code"]) == (401, "AuthRequired")


async def _post_raw(app: Any, client: httpx.AsyncClient, document: dict[str, Any], gone: asyncio.Event) -> None:
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


def _make_app(config: MachineConfig) -> Path:
    config.run_directory.mkdir(parents=True, exist_ok=True)
    return config.run_directory
