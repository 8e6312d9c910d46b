"""A short wire study: no wrong value, every loss counted; violations would be detected."""

from __future__ import annotations

import pytest

from fdhil.drivers.can import sdo_channel
from fdhil.drivers.cia402.pdo_queue import DensePdo
from fdhil.drivers.modbus import rtu_line
from studies import wires
from studies.late_answers import measure_modbus, measure_sdo_reads


@pytest.mark.fault("B3", "B4", "B6", "B7", "B8")
def test_stale_or_corrupted_serial_answers_are_refused() -> None:
    seen = measure_modbus(3000, 11, 2.0, wires.SPOILT, 0.3)
    assert seen["wrong"] == 0
    assert seen["late"] > 300
    assert seen["answered"] > 1000
    for kind in ("ModbusCrc", "ModbusShape", "ModbusUnit", "ModbusStale"):
        assert seen[kind] > 30, kind


@pytest.mark.usefixtures("long_computation")
def test_study_detects_retry_within_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtu_line, "is_damaged", lambda *_: True)
    assert measure_modbus(3000, 11, 2.0, wires.SPOILT, 0.3)["wrong"] > 0


@pytest.mark.fault("A26")
def test_late_sdo_answers_are_refused() -> None:
    seen = measure_sdo_reads(1500, 11, 1.45)
    assert seen["wrong"] == 0
    assert seen["late"] > 300
    assert seen["answered"] > 1000


def test_study_detects_unread_sdo_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdo_channel, "QUIET_S", 0.0)
    assert measure_sdo_reads(1500, 11, 1.45)["wrong"] > 0


@pytest.mark.parametrize("kind", ["stale", "too_many"])
def test_tcp_answer_matches_its_request(kind: str) -> None:
    seen = wires.query_over_tcp(40, kind)
    assert seen["wrong"] == 0
    assert seen["answered"] > 10


@pytest.mark.fault("A6", "A10")
@pytest.mark.parametrize("name", wires.LOSSES)
def test_lost_frames_are_counted_and_values_not_misplaced(name: str) -> None:
    seen = wires.lose_frames(20_000, 5, wires.LOSSES[name], 5.0)
    assert seen["reported"] == seen["lost"] > 150
    assert (seen["misplaced"], seen["late"]) == (0, 0)
    assert seen["rows"] > 1000


def test_study_detects_misplaced_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DensePdo, "find_certain_ticks", lambda self, between: self.present)
    assert wires.lose_frames(60_000, 5, wires.LOSSES["any of the three"], 5.0)["misplaced"] > 0


def test_goals_follow_from_counts() -> None:
    counts = {"frames": 100, "lost": 2, "reported": 2}
    good = [["SYNC", 1.0, counts]]
    promised = {"a": {"late": 9, "spoilt": 3, "wrong": 0}, wires.SDO: {"late": 4, "wrong": 0}}
    assert wires.evaluate_goals(promised, good) == {
        "R8": {"met": True, "figure": "0 of 9 stale and 3 wrong Modbus answers and 4 stale SDO answers taken"},
        "R9": {"met": True, "figure": "2 reported of 2 lost among 100 frames"},
    }
    for bad in ({"reported": 1}, {"misplaced": 1}):
        found = wires.evaluate_goals({"a": {"wrong": 1}}, [["SYNC", 1.0, counts | bad]])
        assert not found["R8"]["met"]
        assert not found["R9"]["met"]
