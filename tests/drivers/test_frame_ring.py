"""The ring loses no frame without counting it."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.drivers.can.frame_history import CHUNK_FRAMES, FrameHistory, format_candump
from fdhil.drivers.can.frame_ring import DEFAULT_RING_FRAMES, FRAME, FrameRing, Frames


@given(st.lists(st.integers(0, 12), max_size=40))
def test_ring_returns_every_stored_frame(steps: list[int]) -> None:
    ring = FrameRing(8)
    sent, kept, given_back = 0, [], []
    waiting = 0
    for step in steps:
        for _ in range(step):
            if waiting < 8:
                kept.append(sent)
                waiting += 1
            ring.append_frame(sent, 0x181, bytes([sent % 256]))
            sent += 1
        given_back += ring.drain_frames()["t_ns"].tolist()
        waiting = 0
    assert given_back == kept
    assert ring.received_count == sent
    assert ring.overflow_count == sent - len(kept)


def test_frame_content_survives_the_ring() -> None:
    ring = FrameRing(4)
    for length in (0, 3, 8):
        ring.append_frame(7, 0x80000123, bytes(range(length)))
        (frame,) = ring.drain_frames()
        assert int(frame["id"]) == 0x80000123
        assert int(frame["dlc"]) == length
        assert int(frame["data"]).to_bytes(8, "little")[:length] == bytes(range(length))
    assert ring.drain_frames().size == 0


FLOOD = 50_000
PERIOD_NS = 1_000_000
HEAP_BYTES = 64_000  # of objects; the frames themselves are twenty times that


def build_flood(first: int, count: int) -> Frames:
    """Return this many frames a millisecond apart, each with its number as data."""
    frames = np.zeros(count, FRAME)
    frames["data"] = np.arange(first, first + count)
    frames["t_ns"] = frames["data"] * PERIOD_NS
    return frames


@pytest.mark.fault("F10")
def test_frame_buffers_do_not_fragment_the_heap() -> None:
    tracemalloc.start()
    try:
        ring, history = FrameRing(DEFAULT_RING_FRAMES), FrameHistory(kept_s=FLOOD * PERIOD_NS * 1e-9)
        for start in range(0, FLOOD, 1250):
            history.add_frames(build_flood(start, 1250))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ring.free_slots == DEFAULT_RING_FRAMES
    assert history.get_frames().size == FLOOD
    assert taken < HEAP_BYTES


@pytest.mark.usefixtures("long_computation")
@given(st.lists(st.integers(0, 3 * CHUNK_FRAMES), max_size=8), st.integers(0, 4 * CHUNK_FRAMES))
def test_history_returns_the_newest_frames_in_order(sizes: list[int], kept: int) -> None:
    history, sent = FrameHistory(kept_s=kept * PERIOD_NS * 1e-9), 0
    for size in sizes:
        history.add_frames(build_flood(sent, size))
        sent += size
        assert history.get_frames()["data"].tolist() == list(range(max(0, sent - kept - 1), sent))


def test_history_keeps_at_most_one_extra_chunk() -> None:
    history = FrameHistory(kept_s=1.0)
    for start in range(0, 10 * CHUNK_FRAMES, 50):
        history.add_frames(build_flood(start, 50))
    assert sum(chunk.size for chunk in history._chunks) <= 1001 + CHUNK_FRAMES


@pytest.mark.usefixtures("long_computation")
def test_log_of_a_frame_flood_is_written_in_chunks() -> None:
    frames = build_flood(0, FLOOD)
    tracemalloc.start()
    try:
        log = format_candump("can0", frames)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert log.count("\n") == FLOOD
    assert log.endswith(format_candump("can0", frames[-1:]))
    assert peak < 4 * len(log)
