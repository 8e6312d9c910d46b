"""Alarms begin, end, chatter and are acknowledged as in ISA-18.2; they derive from notices alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil.daemon import service_log
from fdhil.daemon.alarms import AlarmTable, build_alarm_document
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.history_rows import Acknowledgement, StoredNotice, TimeStamp
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.daemon.test_daemon_service import _skip_kernel_warmup, serving, status_when  # noqa: F401 (a fixture)

LOST = Notice("HeartbeatLost", "MAJOR", "Drive X sends no heartbeat any more.", "X")
BACK = Notice("HeartbeatLost", "info", "Drive X sends its heartbeat again.", "X")
TRIP = Notice("GuardTripped", "MAJOR", "EchoMismatch: axis X", "X")


def at(second: int) -> TimeStamp:
    return TimeStamp(1.7e9 + second, "boot", second)


def table(*notices: Notice) -> AlarmTable:
    return AlarmTable(StoredNotice(k, notice, at(k)) for k, notice in enumerate(notices, 1))


def acknowledge(alarms: AlarmTable, *numbers: int) -> None:
    alarms.acknowledge_notices(Acknowledgement(numbers, "anna", "", at(90)))


def documents(alarms: AlarmTable) -> list[dict[str, Any]]:
    return [build_alarm_document(alarm) for alarm in alarms.list_shown()]


def test_returning_heartbeat_ends_its_alarm_only() -> None:
    (active,) = documents(table(LOST))
    assert (active["state"], active["until"]) == ("active", None)
    (gone,) = documents(table(LOST, BACK))
    assert (gone["state"], gone["severity"], gone["numbers"]) == ("gone", "MAJOR", [1])
    assert gone["since"] < gone["until"]


def test_acknowledged_alarm_stays_until_it_ends() -> None:
    alarms = table(LOST)
    acknowledge(alarms, 1)
    (active,) = documents(alarms)
    assert (active["state"], active["numbers"], active["acknowledged"]["who"]) == ("active", [], "anna")
    alarms.take_notice(StoredNotice(2, BACK, at(2)))
    assert documents(alarms) == []


def test_gone_alarm_stays_until_acknowledged_and_the_count_restarts() -> None:
    alarms = table(LOST, BACK)
    acknowledge(alarms, 1)
    assert documents(alarms) == []
    alarms.take_notice(StoredNotice(3, LOST, at(3)))
    assert documents(alarms)[0]["count"] == 1


def test_chattering_condition_is_counted_in_one_alarm() -> None:
    (alarm,) = documents(table(*[LOST, BACK] * 7, LOST))
    assert (alarm["state"], alarm["count"], len(alarm["numbers"])) == ("active", 8, 8)
    assert alarm["first"] < alarm["since"]


def test_event_is_gone_at_once_and_unacknowledged() -> None:
    (alarm,) = documents(table(TRIP))
    assert (alarm["state"], alarm["since"], alarm["numbers"]) == ("gone", alarm["until"], [1])


def test_active_alarms_precede_more_severe_gone_ones() -> None:
    due = Notice("MaintenanceDue", "minor", "ft has changed by 55 %, limit 50 %", "Y")
    assert [alarm["code"] for alarm in documents(table(due, TRIP, LOST))] == [
        "HeartbeatLost", "MaintenanceDue", "GuardTripped",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("ends", "left"),
    [
        (Notice("BusSilent", "info", "Bus can0 is active again."), ["can1"]),
        (Notice("BusSilent", "info", "Bus can1 is active again."), ["can0"]),
        (Notice("BusSilent", "info", "Bus can2 is active again."), ["can0", "can1"]),
    ],
)
def test_end_on_one_bus_keeps_the_alarm_of_another(ends: Notice, left: list[str]) -> None:
    silent = [Notice("BusSilent", "MAJOR", f"No frame is received on bus {bus}: so it is.") for bus in ("can0", "can1")]
    alarms = documents(table(*silent, ends))
    assert sorted(alarm["text"].split()[6].strip(":") for alarm in alarms if alarm["state"] == "active") == left


def test_recovered_parameter_keeps_the_alarm_of_another() -> None:
    due = [Notice("MaintenanceDue", "minor", f"{name} has changed by 55 %", "X") for name in ("ft", "Cd")]
    alarms = documents(table(*due, Notice("MaintenanceDue", "info", "ft is back at 0.05", "X")))
    assert {alarm["text"][:2]: alarm["state"] for alarm in alarms} == {"ft": "gone", "Cd": "active"}


def test_recovered_store_ends_the_disk_full_alarm() -> None:
    full = Notice("DiskFull", "MAJOR", "full")
    (alarm,) = documents(table(full, Notice("StoreRecovered", "info", "written again")))
    assert alarm["state"] == "gone"


async def test_next_daemon_ends_the_alarms_of_the_previous_one(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    async with serving(config, SimulatedMachine([LOST])) as path:
        status = await status_when(path, lambda s: s["alarms"]["active"])
        assert (status["alarms"]["first"][0]["code"], status["unacknowledged"]["count"]) == ("HeartbeatLost", 1)
    async with serving(config, SimulatedMachine()) as path:
        status = await status_when(path, lambda s: s["alarms"]["first"][0]["until"])
        assert (status["alarms"]["active"], status["alarms"]["unacknowledged"]) == (0, 1)


async def test_suppressed_end_of_an_alarm_is_stored_after_the_flood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_log, "REFILL_PER_S", 20.0)
    config = config_of(tmp_path)
    async with serving(config, SimulatedMachine([LOST, BACK] * 40)) as path:
        status = await status_when(path, lambda s: s["alarms"]["first"] and not s["alarms"]["active"])
        assert status["alarms"]["first"][0]["count"] < 40
        await status_when(path, lambda s: s["notices"][-1]["text"] == BACK.text)
    with History.open_read_only(config.store.directory) as history:
        assert history.read_notices()[-1].notice.severity == "info"
