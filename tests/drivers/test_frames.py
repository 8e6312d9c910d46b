"""The ring loses nothing silently."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fdhil.drivers.can.frames import FrameRing


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
