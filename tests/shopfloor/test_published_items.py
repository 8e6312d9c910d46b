"""Published items: every one has a value when everything is known, and none when nothing is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil import tables
from fdhil.records import Notice
from fdhil.shopfloor.published_items import (
    AXIS,
    BUS,
    MACHINE,
    PublishedValue,
    list_alarms,
    list_events,
    list_published_values,
)
from fdhil.shopfloor.status_poller import StatusPoller
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving, status_when
from tests.shopfloor.status_documents import NOW_MS, notice, publishing, said, status, trouble


def by_key(values: tuple[PublishedValue, ...]) -> dict[tuple[str, str, str], PublishedValue]:
    return {value.key: value for value in values}


def test_every_item_is_published_for_each_axis_and_bus() -> None:
    found = list_published_values("XY", ["can0"], status(), NOW_MS)
    assert len(found) == len(MACHINE) + 2 * len(AXIS) + len(BUS)
    assert [value.key for value in found if value.value is None] == []
    assert len(by_key(found)) == len(found)
    values = {key: value.value for key, value in by_key(found).items()}
    assert values["state", "", ""] == "ACTIVE"
    assert values["offset_stands", "", ""] is True
    assert values["armed_program", "", ""] == "part.ngc"  # no path of this computer
    assert values["pass_rms", "", ""] == 3.2
    assert values["L_low", "Y", ""] == pytest.approx(0.0045)
    assert values["last_rapid_reasons", "X", ""] == "LowExcitation: too slow"
    assert values["bus_load", "", "can0"] == 42.0


def test_silent_daemon_makes_every_value_unknown() -> None:
    found = list_published_values("X", ["can0"], None, NOW_MS)
    assert {value.value for value in found} == {None}
    assert [value.key for value in found] == [v.key for v in list_published_values("X", ["can0"], status("X"), NOW_MS)]


def test_outdated_values_are_unknown_and_others_have_their_time() -> None:
    silent_guard = status("X")
    silent_guard["guard"]["heard_s_ago"] = 2.5
    found = by_key(list_published_values("X", [], silent_guard, NOW_MS))
    assert found["offset", "X", ""].value is None
    assert found["nc_line", "", ""].stamp_ms == NOW_MS - 250
    assert found["state", "", ""].stamp_ms == NOW_MS


def test_each_value_has_its_kind() -> None:
    kinds: dict[str, tuple[type, ...]] = {
        "measure": (int, float), "count": (int,), "flag": (bool,), "state": (str,), "text": (str,),
    }  # fmt: skip
    for value in list_published_values("X", ["can0"], status("X"), NOW_MS):
        assert isinstance(value.value, kinds[value.item.kind]), value
        assert value.item.kind != "state" or value.value in value.item.choices
        assert value.item.kind == "flag" or not isinstance(value.value, bool)


@pytest.mark.parametrize(
    ("changes", "codes"),
    [
        ({}, []),
        ({"troubles": [trouble("BusSilent")]}, [("BusSilent", "MAJOR")]),
        ({"troubles": [trouble("MovesNotUsed", "X", "minor")]}, [("MovesNotUsed", "minor")]),
        ({"state": "FROZEN"}, [("OffsetStands", "MAJOR")]),
        ({"state": "lost"}, [("OffsetStands", "MAJOR")]),
        ({"state": "OFF", "may_stand": {"nothing": True, "text": "offset 0"}}, []),
        ({"source": {"state": "reconnecting"}}, [("SourceLost", "MAJOR")]),
        ({"store": {"fault": "DiskFull"}}, [("StoreFault", "MAJOR")]),
    ],
)
def test_alarms_are_the_active_problems(changes: dict[str, Any], codes: list[tuple[str, str]]) -> None:
    assert [(alarm.code, alarm.severity) for alarm in list_alarms(status(**changes))] == codes


def test_notice_is_an_event_once_also_after_a_daemon_restart(tmp_path: Path) -> None:
    listener = StatusPoller(config_of(tmp_path))

    def told(uptime_s: float, *notices: dict[str, Any]) -> list[str]:
        news = listener.build_update(status("X", uptime_s=uptime_s, notices=list(notices)), NOW_MS)
        return [event.code for event in news.events]

    assert told(100.0, notice("Old", 50.0)) == []  # it was there before anyone listened
    assert told(101.0, notice("Old", 51.0), notice("New", 0.5)) == ["New"]
    assert told(102.0004, notice("Old", 52.0), notice("New", 1.5)) == []
    assert listener.build_update(None, NOW_MS, "silent").events == ()
    assert told(2.0, notice("Begun", 1.0)) == ["Begun"]
    assert list_events(status(notices=[notice("New", 1.5)]), NOW_MS)[0].stamp_ms == NOW_MS - 1500


async def test_status_of_a_real_daemon_is_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)
    config = config_of(tmp_path)
    machine = SimulatedMachine([Notice("SourceLost", "MAJOR", "gone"), *rapids(config, count=1)])
    async with serving(config, machine) as path:
        answer = await status_when(path, lambda s: s["axes"]["X"]["accepted"] == 1)
    values = {v.key: v.value for v in list_published_values("X", ["can0"], answer, NOW_MS)}
    assert values["state", "", ""] == "OFF(SHADOW)"
    assert values["offset_stands", "", ""] is False
    low, value, high = (values[name, "X", ""] for name in ("K_low", "K", "K_high"))
    assert isinstance(low, float) and isinstance(value, float) and isinstance(high, float)  # noqa: PT018
    assert low < value < high
    assert values["last_rapid_accepted", "X", ""] is True
    assert values["offset", "X", ""] is None  # no guard runs
    assert "SourceLost" in {event.code for event in list_events(answer, NOW_MS)}


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("protocol", list(tables.PUBLISHERS))
async def test_every_publisher_runs_without_a_daemon_and_stops_on_request(
    protocol: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = 1 if protocol == "mqtt" else 0  # nobody listens there; the others take a free one
    config = config_of(tmp_path, publish={protocol: {"port": port}})
    async with publishing(protocol, config) as task:
        assert "no values are published" in await said(task, capsys, "daemon: is not running")
    assert task.done()
