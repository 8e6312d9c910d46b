"""The black box: frames before a trip are stored in a standard format, without delaying anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.guard_link import GUARD_TRIPPED, _report_changes
from fdhil.daemon import black_box
from fdhil.drivers.can.frame_history import FrameHistory, format_candump
from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, pack_frames


def status(state: str, code: str = "") -> dict[str, Any]:
    cause = {"code": code, "text": "why", "axis": "X"} if code else None
    return {"state": state, "cause": cause}


@pytest.mark.parametrize("before", ["ARMED", "RAMPING", "ACTIVE", "HOLD", "FEEDFORWARD"])
@pytest.mark.parametrize("after", ["RAMP_DOWN", "OFF", "FROZEN"])
def test_alarm_that_ends_a_correction_is_a_trip(before: str, after: str) -> None:
    shown_status = _report_changes(status(before), status(after, "EchoMismatch"))
    assert [notice.code for notice in shown_status] == ["GuardState", GUARD_TRIPPED]
    assert (shown_status[1].severity, shown_status[1].axis, shown_status[1].text) == ("MAJOR", "X", "EchoMismatch: why")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (status("ACTIVE"), status("RAMP_DOWN", "Disarmed")),
        (status("ACTIVE"), status("OFF", "Finished")),
        (status("ARMED"), status("RAMP_DOWN", "Stopped")),
        (status("RAMP_DOWN", "EchoMismatch"), status("OFF", "EchoMismatch")),
        (status("OFF"), status("ADOPT", "StaleOffset")),
        (status("HOLD", "FeedHold"), status("RAMPING")),
        (status("absent"), status("OFF", "EchoMismatch")),
    ],
)
def test_ordered_end_or_continuing_correction_is_not_a_trip(before: dict[str, Any], after: dict[str, Any]) -> None:
    assert [notice.code for notice in _report_changes(before, after) if notice.code == GUARD_TRIPPED] == []


def test_record_voided_by_the_guard_is_reported_once() -> None:
    void = {"code": "RecordVoid", "axis": "X", "text": "the drive has rebooted", "advice": "compare it"}
    now = {"state": "OFF", "not_good": [void]}
    assert [(n.code, n.axis, n.text) for n in _report_changes({"state": "OFF", "not_good": []}, now)] == [
        ("RecordVoid", "X", "the drive has rebooted; compare it")
    ]
    assert _report_changes(now, now) == []
    assert [notice.code for notice in _report_changes({"state": "absent"}, now)] == ["RecordVoid", "GuardFound"]


def test_frame_history_keeps_ten_seconds() -> None:
    history = FrameHistory(kept_s=10.0)
    history.add_frames(pack_frames([]))
    for k in range(400):
        history.add_frames(
            pack_frames([(k * 50_000_000 + 1, 0x80, bytes([k % 240])), (k * 50_000_000 + 2, 0x181, b"\x01")])
        )
    kept = history.get_frames()
    stamps = kept["t_ns"]
    assert 10.0 <= (int(stamps[-1]) - int(stamps[0])) * 1e-9 <= 10.1
    assert kept.size == pytest.approx(402, abs=4)
    assert FrameHistory().get_frames().size == 0


def test_log_has_the_format_of_candump() -> None:
    frames = pack_frames(
        [
            (1_500_000_250, 0x080, b""),
            (2_000_001_000, 0x301, b"\x01\xff"),
            (3, ERROR_FLAG | 0x40, bytes(8)),
            (4_000, REMOTE_FLAG | 0x701, b""),
            (5_000, REMOTE_FLAG | 0x601, bytes(8)),
            (6_000, EXTENDED_FLAG | 0x123, b"\x01"),
            (7_000, EXTENDED_FLAG | REMOTE_FLAG | 0x18FF1234, bytes(2)),
        ]
    )
    assert format_candump("can0", frames).splitlines() == [
        "(1.500000) can0 080#",
        "(2.000001) can0 301#01FF",
        "(0.000000) can0 20000040#0000000000000000",
        "(0.000004) can0 701#R",
        "(0.000005) can0 601#R8",
        "(0.000006) can0 00000123#01",
        "(0.000007) can0 18FF1234#R2",
    ]


def test_black_box_merges_the_frames_of_all_buses_by_time(tmp_path: Path) -> None:
    logs = {"can0": "(9.000000) can0 080#\n(10.5) can0 080#\n", "can1": "(9.5) can1 080#\n(10.000000) can1 181#\n"}
    black_box.write_black_box(tmp_path, "SyncLost", lambda: logs)
    (file,) = (tmp_path / "blackbox").glob("*.log")
    stamps = [line.split(")")[0] for line in file.read_text().splitlines()]
    assert stamps == ["(9.000000", "(9.5", "(10.000000", "(10.5"]


def test_dump_writes_one_file_and_deletes_the_oldest(tmp_path: Path) -> None:
    for _ in range(11):
        result = black_box.write_black_box(tmp_path, "SyncLost", lambda: {"can0": "(1.000000) can0 080#\n", "can1": ""})
    assert result.code == "BlackBox"
    files = sorted((tmp_path / "blackbox").glob("*.log"))
    assert len(files) == black_box.KEPT_FILES
    assert files[-1].read_text() == "(1.000000) can0 080#\n"
    assert files[-1].name.endswith("-SyncLost.log")
    assert str(files[-1]) in result.text


def test_disk_error_is_reported(tmp_path: Path) -> None:
    (tmp_path / "blackbox").write_text("in the way")
    result = black_box.write_black_box(tmp_path, "SyncLost", dict)
    assert (result.code, result.severity) == ("StoreFault", "minor")


def test_file_with_an_invalid_date_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "blackbox").mkdir()
    (tmp_path / "blackbox" / "000007-20260230T101010.000000Z-GuardTripped.log").write_text("x")  # 30 February
    assert black_box.find_black_boxes(tmp_path) == []
    assert black_box.write_black_box(tmp_path, "SyncLost", dict).code == "BlackBox"
    assert [box.number for box in black_box.find_black_boxes(tmp_path)] == [1]
