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

from fdhil.arming.checked_program import Piece
from fdhil.arming.desk import ALIVE_S, ArmingDesk
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.guard_link import GUARD_TRIPPED, GuardLink
from fdhil.arming.token import read_token
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.errors import DeviceError
from tests.arming.guard_peer import FINE, Guard
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
def guard(folder: Path) -> Iterator[Guard]:
    made = Guard(folder)
    yield made
    made.close()


class Long:
    stream = SimpleNamespace(axes=("X",), program_digest="digest")


def test_a_link_that_was_ended_makes_no_new_connection(guard: Guard, folder: Path) -> None:
    """A status request in progress at shutdown would otherwise leave an open connection."""
    link = GuardLink(folder, folder)
    link.refresh()
    link.close()
    assert link.refresh() == []
    assert not link.connected
    with pytest.raises(DeviceError, match="is disconnected: the daemon is shutting down"):
        link.disarm()


def test_a_trip_that_another_request_saw_is_told_all_the_same(guard: Guard, folder: Path) -> None:
    link, long = GuardLink(folder, folder), Long()
    assert [notice.code for notice in link.refresh()] == ["GuardFound"]
    guard.says = lambda _kind: STARVED
    piece = Piece(0, {"X": [0]}, {"X": [0]}, False)
    assert link.extend(long, piece)["ok"]  # type: ignore[arg-type]
    assert link.state == "RAMP_DOWN"
    assert [notice.code for notice in link.refresh()] == ["GuardState", GUARD_TRIPPED]
    assert link.refresh() == []
    link.close()


def test_a_guard_that_does_not_answer_is_let_go(guard: Guard, folder: Path) -> None:
    link = GuardLink(folder, folder)
    link.refresh()
    assert link._client is not None
    link._client._timeout_s = 0.2
    guard.says = lambda kind: None if kind == "disarm" else FINE
    with pytest.raises(DeviceError):
        link.disarm()
    assert not link.connected
    assert [notice.code for notice in link.refresh()] == ["GuardLost", "GuardFound"]
    link.close()


@pytest.mark.usefixtures("real_time")
async def test_a_slow_guard_still_hears_that_the_daemon_lives(
    config: MachineConfig, guard: Guard, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.arming.guard_link.GuardClient", partial(GuardClient, timeout_s=100.0))
    guard.says = lambda _kind: None
    desk = ArmingDesk(config, OutcomeStore(config), folder)
    attending = asyncio.create_task(desk.attend(lambda _told: None))
    async with asyncio.timeout(60.0):
        while guard.heard.count("alive") < 20:  # noqa: ASYNC110 - it is another thread that hears
            await asyncio.sleep(ALIVE_S)
    assert [kind for kind in guard.heard if kind != "alive"] == ["status"]
    attending.cancel()
    guard.close()
    await asyncio.to_thread(desk.guard.close)


@pytest.mark.parametrize("how", ["disarm", "abandon", "hang up"])
async def test_what_is_given_up_while_it_is_planned_is_not_armed(
    how: str, config: MachineConfig, guard: Guard, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planning, planned = threading.Event(), threading.Event()

    def slow(*_: object) -> Any:
        planning.set()
        assert planned.wait(60.0)

        demand = {"X": [0], "Y": [0]}
        begin = Piece(0, demand, demand, True)
        return SimpleNamespace(facts={}, begin=begin, rows=1, summary=lambda: {"method": "inverse"})

    monkeypatch.setattr(
        "fdhil.arming.desk.prepare", lambda *_: SimpleNamespace(ahead=False, program_digest="", models={})
    )
    monkeypatch.setattr("fdhil.arming.desk.plan_whole", lambda *_: None)
    monkeypatch.setattr("fdhil.arming.desk.taught", lambda *_: (None, None))
    monkeypatch.setattr("fdhil.arming.desk.prepare_armament", slow)
    guard.says = lambda _kind: {**FINE, "state": "OFF"}
    desk = ArmingDesk(config, OutcomeStore(config), folder)
    desk.begin({}, [])
    request = {"request": "arm", "program": "a.ngc", "token": read_token(folder)}
    hung_up = threading.Event()
    arming = asyncio.create_task(desk.arm(request, hung_up.is_set))
    assert await asyncio.to_thread(planning.wait, 60.0)
    if how == "disarm":
        await desk.disarm()
    elif how == "abandon":
        desk.abandon()
    else:
        hung_up.set()
    planned.set()
    answer = await arming
    assert (answer["ok"], answer["code"]) == (False, "Abandoned")
    assert set(guard.heard) <= {"disarm", "status"}
    assert desk.armed is None
    desk.guard.close()


@pytest.mark.fault("E18")
async def test_a_disarm_waits_for_no_disk(config: MachineConfig, guard: Guard, folder: Path) -> None:
    """Every thread of asyncio's pool waits for the disk, as with pending axes, history, notices and requests."""
    guard.says = lambda _kind: {**FINE, "state": "OFF"}
    desk, answers = ArmingDesk(config, OutcomeStore(config), folder), threading.Event()
    waiting = [asyncio.create_task(asyncio.to_thread(answers.wait, 60.0)) for _ in range(40)]
    try:
        await asyncio.sleep(0)
        assert (await asyncio.wait_for(desk.disarm(), 30.0))["ok"]
    finally:
        answers.set()
        await asyncio.gather(*waiting)
        desk.guard.close()


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ({"token": "\ud800"}, "AuthRequired"),
        ({"program": "a\0b.ngc"}, "BadRequest"),
        ({"program": "\ud800.ngc"}, "BadRequest"),
    ],
)
async def test_a_text_that_no_file_and_no_token_can_be_is_answered(
    asked: Mapping[str, str], code: str, config: MachineConfig, folder: Path
) -> None:
    desk = ArmingDesk(config, OutcomeStore(config), folder)
    desk.begin({}, [])
    request = {"request": "arm", "program": "a.ngc", "token": read_token(folder), **asked}
    assert (await desk.arm(request))["code"] == code


async def test_a_disarm_that_is_answered_before_the_guard_is_asked_to_arm_is_the_last_word(
    config: MachineConfig, guard: Guard, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feeding = SimpleNamespace(laws={}, facts={}, summary=dict, progress=dict)
    monkeypatch.setattr("fdhil.arming.desk.prepare_feeding", lambda *_: feeding)
    guard.says = lambda _kind: {**FINE, "state": "OFF"}
    desk = ArmingDesk(config, OutcomeStore(config), folder)
    desk.begin({}, [])
    asked, disarmed, feed_forward = threading.Event(), threading.Event(), desk.guard.feed_forward

    def its_turn_comes_late(*given: Any) -> Any:
        asked.set()
        assert disarmed.wait(60.0)
        return feed_forward(*given)

    monkeypatch.setattr(desk.guard, "feed_forward", its_turn_comes_late)
    arming = asyncio.create_task(desk.arm({"request": "arm", "method": "flatness", "token": read_token(folder)}))
    assert await asyncio.to_thread(asked.wait, 60.0)
    assert (await desk.disarm())["ok"]
    disarmed.set()
    assert (await arming)["code"] == "Abandoned"
    assert "feedforward" not in guard.heard
    desk.guard.close()


async def test_the_guard_is_told_as_of_which_disarm_it_is_asked(
    config: MachineConfig, guard: Guard, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = ArmingDesk(config, OutcomeStore(config), folder)
    desk.begin({}, [])
    disarms, of_its_time = 4, SimpleNamespace(laws={}, facts={}, summary=dict, progress=dict)

    def planned(*_: object) -> Any:
        nonlocal disarms
        disarms += 1
        desk.guard.look()
        return of_its_time

    monkeypatch.setattr("fdhil.arming.desk.prepare_feeding", planned)
    guard.says = lambda _kind: {**FINE, "state": "OFF", "disarms": disarms}
    await desk.arm({"request": "arm", "method": "flatness", "token": read_token(folder)})
    asked = next(request for request in guard.requests if request["request"] == "feedforward")
    assert asked["disarms"] == 4
    desk.guard.close()
