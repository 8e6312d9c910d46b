"""Error frames become notices: one when an error begins, one when it has ended."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.drivers.can.error_frames import (
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    ErrorWatch,
    error_notices,
)
from fdhil.drivers.can.frames import ERROR_FLAG, frames_of


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
    frames = frames_of([(0, 0x181, bytes(8)), (1, ERROR_FLAG | can_id, data), (2, ERROR_FLAG | can_id, data)])
    assert [(n.code, n.severity) for n in error_notices(frames)] == expected


def test_no_error_frame_no_notice() -> None:
    assert error_notices(frames_of([(0, 0x181, bytes(8))])) == []
    assert error_notices(np.empty(0, frames_of([]).dtype)) == []


def error(t_ns: int, of_class: int, *data: int) -> tuple[int, int, bytes]:
    return t_ns, ERROR_FLAG | of_class, bytes(data)


def plain(t_ns: int) -> tuple[int, int, bytes]:
    return t_ns, 0x181, bytes([0, 0xFF, 0xFF])


def codes(watch: ErrorWatch, now_s: float, *rows: tuple[int, int, bytes]) -> list[tuple[str, str]]:
    return [(n.code, n.severity) for n in watch.feed(frames_of(rows), int(now_s * 1e9))]


@pytest.mark.parametrize(
    ("row", "expected", "words"),
    [
        (error(0, 0x008, 0, 0, 0x04 | 0x02), ("BusErrors", "minor"), "(form, stuff errors)"),
        (error(0, 0x088), ("BusErrors", "minor"), "damaged and sent again"),
        (error(0, 0x004, 0, 0x01), ("RxOverflow", "minor"), "unknown number of frames"),
        (error(0, 0x010, 0, 0, 0, 0, 0x04), ("TransceiverFault", "MAJOR"), "breaks and shorts"),
        (error(0, 0x020), ("NotAcknowledged", "minor"), "acknowledged by no node"),
    ],
)
def test_each_class_is_told_in_words(row: tuple[int, int, bytes], expected: tuple[str, str], words: str) -> None:
    (notice,) = error_notices(frames_of([row]))
    assert (notice.code, notice.severity) == expected
    assert words in notice.text


def test_a_flood_is_told_once_and_counted() -> None:
    watch = ErrorWatch()
    told = [codes(watch, k * 0.05, *[error(k * 50_000_000 + j, 0x008, 0, 0, 4) for j in range(100)]) for k in range(50)]
    assert [code for block in told for code in block] == [("BusErrors", "minor")]
    assert watch.count == 5000
    assert codes(watch, 20.0) == [("BusErrors", "info")]
    assert codes(watch, 21.0, error(21_000_000_000, 0x008)) == [("BusErrors", "minor")]


def test_warning_passive_and_active_again() -> None:
    watch = ErrorWatch()
    assert codes(watch, 0.0, error(0, 0x004, 0, 0x08)) == [("ErrorPassive", "minor")]
    assert codes(watch, 0.1, error(0, 0x004, 0, 0x20)) == [("ErrorPassive", "MAJOR")]
    assert codes(watch, 0.2, error(0, 0x004, 0, 0x20), plain(1)) == []
    assert codes(watch, 60.0, plain(1)) == []  # it lasts until the controller says so
    assert codes(watch, 61.0, error(1, 0x004, 0, 0x40), plain(2)) == [("ErrorPassive", "info")]


def test_bus_off_lasts_until_the_bus_is_heard_again() -> None:
    watch = ErrorWatch()
    assert codes(watch, 0.0, plain(0), error(1, 0x040)) == [("BusOff", "MAJOR")]
    assert codes(watch, 60.0) == []
    assert codes(watch, 61.0, error(2, 0x100)) == [("BusRestarted", "MAJOR"), ("BusOff", "info")]


def test_a_controller_that_goes_off_again_and_again_is_one_fault() -> None:
    watch = ErrorWatch()
    told = [codes(watch, k, error(k * 10**9, 0x040), error(k * 10**9, 0x100), plain(k * 10**9)) for k in range(9)]
    assert told == [[("BusOff", "MAJOR"), ("BusRestarted", "MAJOR")], *[[]] * 8]
    assert codes(watch, 30.0, plain(30 * 10**9)) == [("BusOff", "info")]
