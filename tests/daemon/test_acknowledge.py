"""Notices stay open until an operator acknowledges them; name and time are stored and reported everywhere."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fdhil.daemon import notice_log
from fdhil.daemon.daemon_socket import ask_daemon
from fdhil.daemon.notice_log import NotAcknowledged, NoticeLog, parse_acknowledgement
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.history_rows import StoredNotice
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.daemon.test_daemon_service import _skip_kernel_warmup, serving, status_when  # noqa: F401 (a fixture)
from tests.store.sample_records import STAMP

DOWN = Notice("BusDown", "MAJOR", "Bus can0: gone; nothing is received until it is reconnected, which is retried.")
BACK = Notice("BusDown", "info", "Bus can0 is back.")
DUE = Notice("MaintenanceDue", "minor", "ft will reach its limit soon; plan it.", "X")


async def _acknowledged(path: Path, **request: Any) -> dict[str, Any]:
    return await asyncio.to_thread(ask_daemon, path, {"request": "acknowledge", **request})


async def test_notice_stays_open_until_acknowledged_also_across_a_restart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_of(tmp_path)
    async with serving(config, SimulatedMachine([DOWN, BACK, DUE])) as path:
        status = await status_when(path, lambda s: s["unacknowledged"]["count"] == 2)
        assert status["unacknowledged"]["MAJOR"] == 1
        assert [n["code"] for n in status["unacknowledged"]["newest"]] == ["BusDown", "MaintenanceDue"]
        number = status["unacknowledged"]["newest"][0]["number"]
        answer = await _acknowledged(path, notices=[number], by="anna", note="plug was out")
        assert (answer["ok"], answer["acknowledged"]) == (True, [number])
        status = await status_when(path, lambda s: True)
        by_text = {notice["text"]: notice for notice in status["notices"]}
        assert by_text[DOWN.text]["acknowledged"]["who"] == "anna"
        assert by_text[DUE.text]["acknowledged"] is None
        again = await _acknowledged(path, notices=[number], by="ben")
        assert (again["ok"], again["acknowledged"]) == (True, [])
    assert "notice 1 acknowledged by anna" in capsys.readouterr().err
    async with serving(config, SimulatedMachine()) as path:
        status = await status_when(path, lambda s: True)
        assert [n["code"] for n in status["unacknowledged"]["newest"]] == ["MaintenanceDue"]
        answer = await _acknowledged(path, up_to=status["unacknowledged"]["newest"][-1]["number"], by="ben")
        assert answer["ok"]
    with History.open_read_only(config.store.directory) as history:
        known = {n.notice.text: n.acknowledged for n in history.read_notices() if n.notice.severity != "info"}
    assert {text: given.who for text, given in known.items() if given} == {DOWN.text: "anna", DUE.text: "ben"}
    assert [given.note for given in known.values() if given] == ["plug was out", ""]


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ({}, "BadRequest"),
        ({"notices": []}, "BadRequest"),
        ({"notices": ["1"]}, "BadRequest"),
        ({"notices": [True]}, "BadRequest"),
        ({"notices": [1], "up_to": 1}, "BadRequest"),
        ({"notices": [2]}, "NoSuchNotice"),  # one of severity info asks for nobody
        ({"notices": [99]}, "NoSuchNotice"),
        ({"notices": [1], "by": ""}, "BadRequest"),
        ({"notices": [1], "by": "x" * 65}, "BadRequest"),
        ({"notices": [1], "by": "anna", "note": 5}, "BadRequest"),
        ({"notices": [1], "by": "anna", "note": "x" * 201}, "BadRequest"),
    ],
)
def test_invalid_acknowledgement_is_refused_with_advice(request_: dict[str, Any], code: str) -> None:
    book = NoticeLog()
    book.load_history([StoredNotice(1, DOWN, STAMP), StoredNotice(2, BACK, STAMP)])
    with pytest.raises(NotAcknowledged) as refused:
        parse_acknowledgement(request_, book.select_open(request_))
    assert refused.value.answer["code"] == code
    assert refused.value.answer["advice"]
    assert book.build_status()["count"] == 1


def test_operator_name_cannot_forge_a_log_line() -> None:
    given = parse_acknowledgement({"by": "anna\x1b[2J\n", "note": "a\nb"}, [1])
    assert (given.who, given.note) == ("anna\\x1b[2J", "a\\nb")


def test_only_the_newest_notices_stay_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notice_log, "NEWEST", 3)
    book = NoticeLog()
    for number in range(1, 6):
        book.add_stored(DOWN, number, STAMP)
    assert [result["number"] for result in book.build_status()["newest"]] == [3, 4, 5]


def test_long_list_of_numbers_is_processed_in_linear_time() -> None:
    class Counted(list[int]):
        times = 0

        def __iter__(self) -> Iterator[int]:
            self.times += 1
            return super().__iter__()

    book = NoticeLog()
    book.load_history([StoredNotice(number, DOWN, STAMP) for number in range(1, 101)])
    numbers = Counted(range(1, 101))
    assert len(book.select_open({"notices": numbers})) == 100
    assert numbers.times < 5
