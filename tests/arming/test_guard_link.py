"""The daemon's link to the guard: it reports every trip, and a silent guard does not block it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fdhil.arming.arming_service import ALIVE_S, ArmingService
from fdhil.arming.checked_program import TablePiece
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.guard_link import GUARD_TRIPPED, GuardLink
from fdhil.arming.operator_token import read_token
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.errors import DeviceError
from tests.arming.guard_peer import FINE, GuardPeer
from tests.daemon.simulated_machine import config_of

STARVED = {"state": "RAMP_DOWN", "cause": {"code": "TableStarved", "text": "no rows", "axis": ""}, "ok": True}


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    return config_of(tmp_path, ("X", "Y"))


@pytest.fixture
def folder(config: MachineConfig) -> Path:
    assert config.store.run_directory is not None
    config.store.run_directory.mkdir(parents=True)
    return config.store.run_directory


@pytest.fixture
def guard(folder: Path) -> Iterator[GuardPeer]:
    made = GuardPeer(folder)
    yield made
    made.close()


class LongProgram:
    stream = SimpleNamespace(axes=("X",), program_digest="digest")


def test_closed_link_does_not_reconnect(guard: GuardPeer, folder: Path) -> None:
    """A status request in progress at shutdown would otherwise leave an open connection."""
    link = GuardLink(folder, folder)
    link.poll_changes()
    link.close()
    assert link.poll_changes() == []
    assert not link.is_connected
    with pytest.raises(DeviceError, match="is disconnected: the daemon is shutting down"):
        link.disarm()


def test_trip_seen_by_other_request_is_reported(guard: GuardPeer, folder: Path) -> None:
    link, long = GuardLink(folder, folder), LongProgram()
    assert [notice.code for notice in link.poll_changes()] == ["GuardFound"]
    guard.says = lambda _kind: STARVED
    piece = TablePiece(0, {"X": [0]}, {"X": [0]}, False)
    assert link.extend_stream(long, piece)["ok"]  # type: ignore[arg-type]
    assert link.state == "RAMP_DOWN"
    assert [notice.code for notice in link.poll_changes()] == ["GuardState", GUARD_TRIPPED]
    assert link.poll_changes() == []
    link.close()


def test_silent_guard_is_disconnected(guard: GuardPeer, folder: Path) -> None:
    link = GuardLink(folder, folder)
    link.poll_changes()
    assert link._client is not None
    link._client._timeout_s = 0.2
    guard.says = lambda kind: None if kind == "disarm" else FINE
    with pytest.raises(DeviceError):
        link.disarm()
    assert not link.is_connected
    assert [notice.code for notice in link.poll_changes()] == ["GuardLost", "GuardFound"]
    link.close()


@pytest.mark.usefixtures("real_time")
async def test_slow_guard_still_receives_alive(
    config: MachineConfig, guard: GuardPeer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.arming.guard_link.GuardClient", partial(GuardClient, timeout_s=100.0))
    guard.says = lambda _kind: None
    service = ArmingService(config, OutcomeStore(config), folder)
    attending = asyncio.create_task(service.supervise_guard(lambda _told: None))
    async with asyncio.timeout(60.0):
        while guard.heard.count("alive") < 20:  # noqa: ASYNC110 - it is another thread that hears
            await asyncio.sleep(ALIVE_S)
    assert [kind for kind in guard.heard if kind != "alive"] == ["status"]
    attending.cancel()
    guard.close()
    await asyncio.to_thread(service.guard.close)


@pytest.mark.parametrize("how", ["disarm", "abandon", "hang up"])
async def test_abandoned_program_is_not_armed(
    how: str, config: MachineConfig, guard: GuardPeer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planning, planned = threading.Event(), threading.Event()

    def slow(*_: object) -> Any:
        planning.set()
        assert planned.wait(60.0)

        demand = {"X": [0], "Y": [0]}
        begin = TablePiece(0, demand, demand, True)
        return SimpleNamespace(facts={}, first_piece=begin, row_count=1, summarise=lambda: {"method": "inverse"})

    monkeypatch.setattr(
        "fdhil.arming.arming_service.prepare_request",
        lambda *_: SimpleNamespace(ahead=False, program_digest="", models={}),
    )
    monkeypatch.setattr("fdhil.arming.arming_service.plan_whole_program", lambda *_: None)
    monkeypatch.setattr("fdhil.arming.arming_service.apply_learned_offsets", lambda *_: (None, None))
    monkeypatch.setattr("fdhil.arming.arming_service.prepare_program", slow)
    guard.says = lambda _kind: {**FINE, "state": "OFF"}
    service = ArmingService(config, OutcomeStore(config), folder)
    service.start_from_history({}, [])
    request = {"request": "arm", "program": "a.ngc", "token": read_token(folder)}
    hung_up = threading.Event()
    arming = asyncio.create_task(service.arm(request, hung_up.is_set))
    assert await asyncio.to_thread(planning.wait, 60.0)
    if how == "disarm":
        await service.disarm()
    elif how == "abandon":
        service.abandon_preparation()
    else:
        hung_up.set()
    planned.set()
    answer = await arming
    assert (answer["ok"], answer["code"]) == (False, "Abandoned")
    assert set(guard.heard) <= {"disarm", "status"}
    assert service.armed is None
    service.guard.close()


@pytest.mark.fault("E18")
async def test_disarm_does_not_wait_for_disk(config: MachineConfig, guard: GuardPeer, folder: Path) -> None:
    """Every thread of asyncio's pool waits for the disk, as with pending axes, history, notices and requests."""
    guard.says = lambda _kind: {**FINE, "state": "OFF"}
    service, answers = ArmingService(config, OutcomeStore(config), folder), threading.Event()
    waiting = [asyncio.create_task(asyncio.to_thread(answers.wait, 60.0)) for _ in range(40)]
    try:
        await asyncio.sleep(0)
        assert (await asyncio.wait_for(service.disarm(), 30.0))["ok"]
    finally:
        answers.set()
        await asyncio.gather(*waiting)
        service.guard.close()


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ({"token": "\ud800"}, "AuthRequired"),
        ({"program": "a\0b.ngc"}, "BadRequest"),
        ({"program": "\ud800.ngc"}, "BadRequest"),
    ],
)
async def test_invalid_program_or_token_text_is_refused(
    asked: Mapping[str, str], code: str, config: MachineConfig, folder: Path
) -> None:
    service = ArmingService(config, OutcomeStore(config), folder)
    service.start_from_history({}, [])
    request = {"request": "arm", "program": "a.ngc", "token": read_token(folder), **asked}
    assert (await service.arm(request))["code"] == code


async def test_disarm_during_preparation_prevents_arming(
    config: MachineConfig, guard: GuardPeer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feeding = SimpleNamespace(laws={}, facts={}, summarise=dict, report_progress=dict)
    monkeypatch.setattr("fdhil.arming.arming_service.prepare_feedforward", lambda *_: feeding)
    guard.says = lambda _kind: {**FINE, "state": "OFF"}
    service = ArmingService(config, OutcomeStore(config), folder)
    service.start_from_history({}, [])
    asked, disarmed, feed_forward = threading.Event(), threading.Event(), service.guard.enable_feedforward

    def its_turn_comes_late(*given: Any) -> Any:
        asked.set()
        assert disarmed.wait(60.0)
        return feed_forward(*given)

    monkeypatch.setattr(service.guard, "enable_feedforward", its_turn_comes_late)
    arming = asyncio.create_task(service.arm({"request": "arm", "method": "flatness", "token": read_token(folder)}))
    assert await asyncio.to_thread(asked.wait, 60.0)
    assert (await service.disarm())["ok"]
    disarmed.set()
    assert (await arming)["code"] == "Abandoned"
    assert "feedforward" not in guard.heard
    service.guard.close()


async def test_arm_request_carries_disarm_count(
    config: MachineConfig, guard: GuardPeer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = ArmingService(config, OutcomeStore(config), folder)
    service.start_from_history({}, [])
    disarms, of_its_time = 4, SimpleNamespace(laws={}, facts={}, summarise=dict, report_progress=dict)

    def planned(*_: object) -> Any:
        nonlocal disarms
        disarms += 1
        service.guard.read_status()
        return of_its_time

    monkeypatch.setattr("fdhil.arming.arming_service.prepare_feedforward", planned)
    guard.says = lambda _kind: {**FINE, "state": "OFF", "disarms": disarms}
    await service.arm({"request": "arm", "method": "flatness", "token": read_token(folder)})
    asked = next(request for request in guard.requests if request["request"] == "feedforward")
    assert asked["disarms"] == 4
    service.guard.close()
