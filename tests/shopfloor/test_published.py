"""Published items: every one has a value when everything is known, and none when nothing is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil import tables
from fdhil.records import Notice
from fdhil.shopfloor.news import Listener
from fdhil.shopfloor.published import AXIS, BUS, MACHINE, Value, alarms, events, published
from tests.daemon.machine import Machine, config_of, rapids
from tests.daemon.test_service import serving, status_when
from tests.shopfloor.made import NOW_MS, notice, publishing, said, status, trouble


def by_key(values: tuple[Value, ...]) -> dict[tuple[str, str, str], Value]:
    return {value.key: value for value in values}


def test_all_that_is_listed_is_published_of_each_axis_and_bus() -> None:
    found = published("XY", ["can0"], status(), NOW_MS)
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


def test_a_silent_daemon_leaves_nothing_known() -> None:
    found = published("X", ["can0"], None, NOW_MS)
    assert {value.value for value in found} == {None}
    assert [value.key for value in found] == [v.key for v in published("X", ["can0"], status("X"), NOW_MS)]


def test_what_is_old_is_not_known_and_what_is_not_says_when_it_was_heard() -> None:
    silent_guard = status("X")
    silent_guard["guard"]["heard_s_ago"] = 2.5
    found = by_key(published("X", [], silent_guard, NOW_MS))
    assert found["offset", "X", ""].value is None
    assert found["nc_line", "", ""].stamp_ms == NOW_MS - 250
    assert found["state", "", ""].stamp_ms == NOW_MS


def test_each_value_is_of_its_kind() -> None:
    kinds: dict[str, tuple[type, ...]] = {
        "measure": (int, float), "count": (int,), "flag": (bool,), "state": (str,), "text": (str,),
    }  # fmt: skip
    for value in published("X", ["can0"], status("X"), NOW_MS):
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
def test_alarms_are_what_is_wrong_now(changes: dict[str, Any], codes: list[tuple[str, str]]) -> None:
    assert [(alarm.code, alarm.severity) for alarm in alarms(status(**changes))] == codes


def test_a_notice_is_news_once_also_of_the_next_daemon(tmp_path: Path) -> None:
    listener = Listener(config_of(tmp_path))

    def told(uptime_s: float, *notices: dict[str, Any]) -> list[str]:
        news = listener.news(status("X", uptime_s=uptime_s, notices=list(notices)), NOW_MS)
        return [event.code for event in news.events]

    assert told(100.0, notice("Old", 50.0)) == []  # it was there before anyone listened
    assert told(101.0, notice("Old", 51.0), notice("New", 0.5)) == ["New"]
    assert told(102.0004, notice("Old", 52.0), notice("New", 1.5)) == []
    assert listener.news(None, NOW_MS, "silent").events == ()
    assert told(2.0, notice("Begun", 1.0)) == ["Begun"]
    assert events(status(notices=[notice("New", 1.5)]), NOW_MS)[0].stamp_ms == NOW_MS - 1500


async def test_what_a_real_daemon_says_is_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.service.warm", lambda config, method: None)
    config = config_of(tmp_path)
    machine = Machine([Notice("SourceLost", "MAJOR", "gone"), *rapids(config, count=1)])
    async with serving(config, machine) as path:
        answer = await status_when(path, lambda s: s["axes"]["X"]["accepted"] == 1)
    values = {v.key: v.value for v in published("X", ["can0"], answer, NOW_MS)}
    assert values["state", "", ""] == "OFF(SHADOW)"
    assert values["offset_stands", "", ""] is False
    low, value, high = (values[name, "X", ""] for name in ("K_low", "K", "K_high"))
    assert isinstance(low, float) and isinstance(value, float) and isinstance(high, float)  # noqa: PT018
    assert low < value < high
    assert values["last_rapid_accepted", "X", ""] is True
    assert values["offset", "X", ""] is None  # no guard runs
    assert "SourceLost" in {event.code for event in events(answer, NOW_MS)}


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("protocol", list(tables.PUBLISHERS))
async def test_every_publisher_lives_without_a_daemon_and_ends_when_it_is_told(
    protocol: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = 1 if protocol == "mqtt" else 0  # nobody listens there; the others take a free one
    config = config_of(tmp_path, publish={protocol: {"port": port}})
    async with publishing(protocol, config) as task:
        assert "no values are published" in await said(task, capsys, "daemon: is not running")
    assert task.done()
