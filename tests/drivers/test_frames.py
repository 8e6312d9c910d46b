"""The ring loses no frame without counting it."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.drivers.can.frame_history import CHUNK_FRAMES, FrameHistory, candump
from fdhil.drivers.can.frames import DEFAULT_RING_FRAMES, FRAME, FrameRing, Frames


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


FLOOD = 50_000
PERIOD_NS = 1_000_000
HEAP_BYTES = 64_000  # of objects; the frames themselves are twenty times that


def flood(first: int, count: int) -> Frames:
    """Return this many frames a millisecond apart, each with its number as data."""
    frames = np.zeros(count, FRAME)
    frames["data"] = np.arange(first, first + count)
    frames["t_ns"] = frames["data"] * PERIOD_NS
    return frames


@pytest.mark.fault("F10")
def test_what_holds_frames_takes_nothing_of_the_heap_which_keeps_its_holes() -> None:
    tracemalloc.start()
    try:
        ring, history = FrameRing(DEFAULT_RING_FRAMES), FrameHistory(kept_s=FLOOD * PERIOD_NS * 1e-9)
        for start in range(0, FLOOD, 1250):
            history.add(flood(start, 1250))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ring.room == DEFAULT_RING_FRAMES
    assert history.frames().size == FLOOD
    assert taken < HEAP_BYTES


@pytest.mark.usefixtures("long_computation")
@given(st.lists(st.integers(0, 3 * CHUNK_FRAMES), max_size=8), st.integers(0, 4 * CHUNK_FRAMES))
def test_a_history_returns_the_newest_frames_in_order(sizes: list[int], kept: int) -> None:
    history, sent = FrameHistory(kept_s=kept * PERIOD_NS * 1e-9), 0
    for size in sizes:
        history.add(flood(sent, size))
        sent += size
        assert history.frames()["data"].tolist() == list(range(max(0, sent - kept - 1), sent))


def test_a_history_holds_a_chunk_more_than_it_must_at_most() -> None:
    history = FrameHistory(kept_s=1.0)
    for start in range(0, 10 * CHUNK_FRAMES, 50):
        history.add(flood(start, 50))
    assert sum(chunk.size for chunk in history._chunks) <= 1001 + CHUNK_FRAMES


@pytest.mark.usefixtures("long_computation")
def test_a_log_of_a_flood_is_made_piece_by_piece() -> None:
    frames = flood(0, FLOOD)
    tracemalloc.start()
    try:
        log = candump("can0", frames)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert log.count("\n") == FLOOD
    assert log.endswith(candump("can0", frames[-1:]))
    assert peak < 4 * len(log)
