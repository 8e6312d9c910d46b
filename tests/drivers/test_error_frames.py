"""Error frames become notices: one when an error begins, one when it has ended."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.drivers.can.error_frames import (
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    ErrorFrameMonitor,
    translate_error_frames,
)
from fdhil.drivers.can.frame_ring import ERROR_FLAG, pack_frames


@pytest.mark.parametrize(
    ("can_id", "data", "expected"),
    [
        (ERROR_BUS_OFF, bytes(8), [("BusOff", "MAJOR")]),
        (ERROR_RESTARTED, bytes(8), [("BusRestarted", "MAJOR")]),
        (ERROR_CONTROLLER, bytes([0, 0x10]), [("ErrorPassive", "MAJOR")]),
        (ERROR_CONTROLLER, bytes([0, 0x20]), [("ErrorPassive", "MAJOR")]),
        (ERROR_CONTROLLER, bytes([0, 0x08]), [("ErrorPassive", "minor")]),
        (ERROR_CONTROLLER, bytes([0, 0x40]), []),
        (0x008, bytes(8), [("BusErrors", "minor")]),
        (0x002, bytes(8), []),
    ],
)
def test_error_frames_become_notices(can_id: int, data: bytes, expected: list[tuple[str, str]]) -> None:
    frames = pack_frames([(0, 0x181, bytes(8)), (1, ERROR_FLAG | can_id, data), (2, ERROR_FLAG | can_id, data)])
    assert [(n.code, n.severity) for n in translate_error_frames(frames)] == expected


def test_ordinary_frames_give_no_notice() -> None:
    assert translate_error_frames(pack_frames([(0, 0x181, bytes(8))])) == []
    assert translate_error_frames(np.empty(0, pack_frames([]).dtype)) == []


def build_error_frame(t_ns: int, of_class: int, *data: int) -> tuple[int, int, bytes]:
    return t_ns, ERROR_FLAG | of_class, bytes(data)


def build_data_frame(t_ns: int) -> tuple[int, int, bytes]:
    return t_ns, 0x181, bytes([0, 0xFF, 0xFF])


def list_codes(watch: ErrorFrameMonitor, now_s: float, *rows: tuple[int, int, bytes]) -> list[tuple[str, str]]:
    return [(n.code, n.severity) for n in watch.watch_frames(pack_frames(rows), int(now_s * 1e9))]


@pytest.mark.parametrize(
    ("row", "expected", "words"),
    [
        (build_error_frame(0, 0x008, 0, 0, 0x04 | 0x02), ("BusErrors", "minor"), "(form, stuff errors)"),
        (build_error_frame(0, 0x088), ("BusErrors", "minor"), "damaged and sent again"),
        (build_error_frame(0, 0x004, 0, 0x01), ("RxOverflow", "minor"), "unknown number of frames"),
        (build_error_frame(0, 0x010, 0, 0, 0, 0, 0x04), ("TransceiverFault", "MAJOR"), "breaks and shorts"),
        (build_error_frame(0, 0x020), ("NotAcknowledged", "minor"), "acknowledged by no node"),
    ],
)
def test_each_error_class_has_a_text(row: tuple[int, int, bytes], expected: tuple[str, str], words: str) -> None:
    (notice,) = translate_error_frames(pack_frames([row]))
    assert (notice.code, notice.severity) == expected
    assert words in notice.text


def test_flood_of_error_frames_is_reported_once_and_counted() -> None:
    watch = ErrorFrameMonitor()
    reported = [
        list_codes(watch, k * 0.05, *[build_error_frame(k * 50_000_000 + j, 0x008, 0, 0, 4) for j in range(100)])
        for k in range(50)
    ]
    assert [code for block in reported for code in block] == [("BusErrors", "minor")]
    assert watch.count == 5000
    assert list_codes(watch, 20.0) == [("BusErrors", "info")]
    assert list_codes(watch, 21.0, build_error_frame(21_000_000_000, 0x008)) == [("BusErrors", "minor")]


def test_warning_passive_and_active_states_are_tracked() -> None:
    watch = ErrorFrameMonitor()
    assert list_codes(watch, 0.0, build_error_frame(0, 0x004, 0, 0x08)) == [("ErrorPassive", "minor")]
    assert list_codes(watch, 0.1, build_error_frame(0, 0x004, 0, 0x20)) == [("ErrorPassive", "MAJOR")]
    assert list_codes(watch, 0.2, build_error_frame(0, 0x004, 0, 0x20), build_data_frame(1)) == []
    assert list_codes(watch, 60.0, build_data_frame(1)) == []  # it lasts until the controller says so
    assert list_codes(watch, 61.0, build_error_frame(1, 0x004, 0, 0x40), build_data_frame(2)) == [
        ("ErrorPassive", "info")
    ]


def test_bus_off_lasts_until_a_frame_is_received() -> None:
    watch = ErrorFrameMonitor()
    assert list_codes(watch, 0.0, build_data_frame(0), build_error_frame(1, 0x040)) == [("BusOff", "MAJOR")]
    assert list_codes(watch, 60.0) == []
    assert list_codes(watch, 61.0, build_error_frame(2, 0x100)) == [("BusRestarted", "MAJOR"), ("BusOff", "info")]


def test_repeated_bus_off_is_one_fault() -> None:
    watch = ErrorFrameMonitor()
    reported = [
        list_codes(
            watch,
            k,
            build_error_frame(k * 10**9, 0x040),
            build_error_frame(k * 10**9, 0x100),
            build_data_frame(k * 10**9),
        )
        for k in range(9)
    ]
    assert reported == [[("BusOff", "MAJOR"), ("BusRestarted", "MAJOR")], *[[]] * 8]
    assert list_codes(watch, 30.0, build_data_frame(30 * 10**9)) == [("BusOff", "info")]
