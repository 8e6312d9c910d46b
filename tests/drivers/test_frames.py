"""The ring loses nothing silently, and error frames become notices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.drivers.can.frames import (
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_FLAG,
    ERROR_RESTARTED,
    FrameRing,
    error_notices,
    frames_of,
)


@given(st.lists(st.integers(0, 12), max_size=40))
def test_ring_gives_back_all_that_found_room(steps: list[int]) -> None:
    ring = FrameRing(8)
    sent, kept, given_back = 0, [], []
    waiting = 0
    for step in steps:
        for _ in range(step):
            if waiting < 8:
                kept.append(sent)
                waiting += 1
            ring.append(sent, 0x181, bytes([sent % 256]))
            sent += 1
        given_back += ring.drain()["t_ns"].tolist()
        waiting = 0
    assert given_back == kept
    assert ring.received == sent
    assert ring.overflowed == sent - len(kept)


def test_a_frame_survives_the_ring() -> None:
    ring = FrameRing(4)
    for length in (0, 3, 8):
        ring.append(7, 0x80000123, bytes(range(length)))
        (frame,) = ring.drain()
        assert int(frame["id"]) == 0x80000123
        assert int(frame["dlc"]) == length
        assert int(frame["data"]).to_bytes(8, "little")[:length] == bytes(range(length))
    assert ring.drain().size == 0


@pytest.mark.parametrize(
    ("can_id", "data", "expected"),
    [
        (ERROR_BUS_OFF, bytes(8), [("BusOff", "MAJOR")]),
        (ERROR_RESTARTED, bytes(8), [("BusRestarted", "MAJOR")]),
        (ERROR_CONTROLLER, bytes([0, 0x10]), [("ErrorPassive", "MAJOR")]),
        (ERROR_CONTROLLER, bytes([0, 0x20]), [("ErrorPassive", "MAJOR")]),
        (ERROR_CONTROLLER, bytes([0, 0x08]), [("ErrorPassive", "minor")]),
        (ERROR_CONTROLLER, bytes([0, 0x40]), []),
        (0x008, bytes(8), []),
    ],
)
def test_error_frames_become_notices(can_id: int, data: bytes, expected: list[tuple[str, str]]) -> None:
    frames = frames_of([(0, 0x181, bytes(8)), (1, ERROR_FLAG | can_id, data), (2, ERROR_FLAG | can_id, data)])
    assert [(n.code, n.severity) for n in error_notices(frames)] == expected


def test_no_error_frame_no_notice() -> None:
    assert error_notices(frames_of([(0, 0x181, bytes(8))])) == []
    assert error_notices(np.empty(0, frames_of([]).dtype)) == []
