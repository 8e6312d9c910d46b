"""Alarms, acknowledgement through the daemon, and black boxes, by the API."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from fdhil.config import MachineConfig
from fdhil.daemon import black_box
from fdhil.drivers.can.frame_history import format_candump
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.history_rows import Acknowledgement, TimeStamp
from fdhil.web.application import make_app
from tests.daemon.simulated_machine import SimulatedMachine
from tests.daemon.test_daemon_service import _skip_kernel_warmup, serving, status_when  # noqa: F401 (a fixture)
from tests.drivers.frame_builder import FrameBuilder
from tests.web.http_clients import OWN, make_client, write_machine

DAY_S = 86_400.0
TRIP = (
    "EchoMismatch: axis X: the drive's offset is not the one that was sent; the offset is ramped to zero and the "
    "correction is off until it is armed again; check the PDO mapping and the scaling"
)
NOTICES = (
    Notice("Armed", "info", "armed part.ngc"),
    Notice("GuardTripped", "MAJOR", TRIP, "X"),
    Notice("MaintenanceDue", "minor", "ft has changed by 55 %, limit 50 %", "Y"),
    Notice("GuardTripped", "MAJOR", TRIP, "X"),
    Notice("StrayFiles", "minor", "2 files are no windows"),
)


@pytest.fixture
def machine(tmp_path: Path) -> MachineConfig:
    config = write_machine(tmp_path, acting=True)
    with History.open(config.store.directory) as history:
        numbers = [
            history.add_notice(notice, TimeStamp(1.7e9 + k * DAY_S, "boot", k)) for k, notice in enumerate(NOTICES)
        ]
        history.add_acknowledgement(Acknowledgement((numbers[-1],), "anna", "swept", TimeStamp.now()))
    return config


@pytest.fixture
async def client(machine: MachineConfig) -> AsyncIterator[httpx.AsyncClient]:
    async with make_client(make_app(machine), "operator", **OWN) as client:
        yield client


async def _get_document(client: httpx.AsyncClient, **wanted: Any) -> Any:
    answer = await client.get("/api/events", params=wanted)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def test_unacknowledged_alarms_come_first_with_explanation(client: httpx.AsyncClient) -> None:
    reported = await _get_document(client)
    due, tripped = reported["waiting"]  # what is active is in front
    assert (due["state"], due["until"], tripped["state"], tripped["count"]) == ("active", None, "gone", 2)
    assert (tripped["newest"]["code"], tripped["numbers"], due["newest"]["code"]) == (
        "GuardTripped", [4, 2], "MaintenanceDue",
    )  # fmt: skip
    newest = tripped["newest"]
    assert newest["cause"] == "EchoMismatch: axis X: the drive's offset is not the one that was sent"
    assert newest["effect"] == "the offset is ramped to zero and the correction is off until it is armed again"
    assert newest["action"] == "check the PDO mapping and the scaling"
    assert (
        reported["active_count"],
        reported["waiting_count"],
        reported["waiting_major"],
        reported["newest_waiting"],
    ) == (1, 3, 2, 4)
    assert [(event["code"], event["acknowledged"]["who"]) for event in reported["others"]] == [("StrayFiles", "anna")]


async def test_end_of_alarm_is_shown_as_until(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    with History.open(machine.store.directory) as history:
        history.add_notice(
            Notice("MaintenanceDue", "info", "ft is back at 0.05 N.m.s", "Y"), TimeStamp(1.8e9, "boot", 9)
        )
        history.add_acknowledgement(Acknowledgement((3,), "anna", "", TimeStamp.now()))
    reported = await _get_document(client)
    assert [kind["newest"]["code"] for kind in reported["waiting"]] == ["GuardTripped"]
    due = next(event for event in reported["others"] if event["code"] == "MaintenanceDue")
    assert (due["severity"], due["until"]) == ("minor", "2027-01-15T08:00:00+00:00")
    assert [event["code"] for event in reported["others"]].count("MaintenanceDue") == 1


async def test_event_list_is_filtered_and_paged(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    assert [kind["newest"]["axis"] for kind in (await _get_document(client, axis="Y"))["waiting"]] == ["Y"]
    assert [kind["newest"]["code"] for kind in (await _get_document(client, code="GuardTripped"))["waiting"]] == [
        "GuardTripped"
    ]
    informed = await _get_document(client, severity="info")
    assert ([event["code"] for event in informed["others"]], informed["waiting"]) == (["Armed"], [])
    with History.open(machine.store.directory) as history:
        for k in range(5):
            history.add_notice(Notice("Armed", "info", f"armed {k}"), TimeStamp.now())
    seen: list[str] = []
    before: int | None = None
    while True:
        page = await _get_document(client, severity="info", limit=4, **({"before": before} if before else {}))
        seen += [event["text"] for event in page["others"]]
        before = page["older_before"]
        if before is None:
            break
    assert seen == [f"armed {k}" for k in range(4, -1, -1)] + ["armed part.ngc"]


async def test_acknowledgement_is_stored_by_daemon_and_shown(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    async with serving(machine, SimulatedMachine()) as path:
        wanted = {"notices": [4, 2], "note": "the mapping was wrong"}
        answer = await client.post("/api/events/acknowledge", json=wanted)
        assert answer.status_code == 200, answer.text
        assert sorted(answer.json()["acknowledged"]) == [2, 4]
        status = await status_when(path, lambda s: True)
        assert [notice["code"] for notice in status["unacknowledged"]["newest"]] == ["MaintenanceDue"]
        unknown = await client.post("/api/events/acknowledge", json={"notices": [99]})
        assert (unknown.status_code, unknown.json()["code"]) == (409, "NoSuchNotice")
    reported = await _get_document(client)
    assert [kind["newest"]["code"] for kind in reported["waiting"]] == ["MaintenanceDue"]
    given = next(event for event in reported["others"] if event["number"] == 4)["acknowledged"]
    assert (given["who"], given["note"]) == ("operator", "the mapping was wrong")
    course = (await client.get("/api/history/X")).json()["notices"][0]
    assert course["acknowledged"]["who"] == "operator"


async def test_acknowledging_without_daemon_is_reported(client: httpx.AsyncClient) -> None:
    answer = await client.post("/api/events/acknowledge", json={"notices": [4]})
    assert (answer.status_code, answer.json()["code"]) == (503, "ConnectError")
    assert (await _get_document(client))["waiting_count"] == 3


async def test_black_box_is_listed_drawn_and_downloaded(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    log = format_candump("can0", FrameBuilder(n=900).build_frames())
    black_box.write_black_box(machine.store.directory, "EchoMismatch", lambda: {"can0": log})
    (machine.store.directory / black_box.BLACK_BOX_FOLDER / "notes.log").write_text("no black box")
    (box,) = (await client.get("/api/events/black-boxes")).json()
    assert (box["code"], box["size_bytes"]) == ("EchoMismatch", len(log))
    drawn = (await client.get(f"/api/events/black-boxes/{box['name']}")).json()
    (axis,) = drawn["axes"]
    assert (axis["axis"], axis["lost_frames"]) == ("X", 0)
    assert axis["samples"] > 800
    signals = {signal["name"]: signal for signal in axis["signals"]}
    assert set(signals) == {"following_error", "offset", "speed", "current", "voltage"}
    for signal in signals.values():
        assert len(signal["low"]) == len(signal["high"]) == len(axis["time_s"]) <= 400
        assert all(low <= high for low, high in zip(signal["low"], signal["high"], strict=True))
    assert axis["time_s"] == sorted(axis["time_s"])
    assert axis["time_s"][-1] <= 0.0
    file = await client.get(f"/api/events/black-boxes/{box['name']}/file")
    assert file.text == log
    assert box["name"] in file.headers["content-disposition"]


@pytest.mark.parametrize("name", ["..%2f..%2fhistory.sqlite", "%2e%2e", "a%00b", "x" * 65, "linked.log", "pipe%0a.log"])
@pytest.mark.fault("G4")
async def test_foreign_name_opens_no_other_file(name: str, client: httpx.AsyncClient, machine: MachineConfig) -> None:
    folder = machine.store.directory / black_box.BLACK_BOX_FOLDER
    folder.mkdir()
    (folder / "linked.log").symlink_to(machine.store.directory / "history.sqlite")
    for path in (f"/api/events/black-boxes/{name}", f"/api/events/black-boxes/{name}/file"):
        answer = await client.get(path)
        assert answer.status_code in (400, 404), (path, answer.text)
        assert b"SQLite" not in answer.content


async def test_invalid_black_box_is_reported(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    folder = machine.store.directory / black_box.BLACK_BOX_FOLDER
    folder.mkdir()
    (folder / "20261123T010203.000004Z-Made.log").write_text("nothing that candump wrote")
    answer = await client.get("/api/events/black-boxes/20261123T010203.000004Z-Made.log")
    assert (answer.status_code, answer.json()["code"]) == (422, "RecordingError")
