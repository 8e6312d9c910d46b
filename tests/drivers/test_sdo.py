"""The SDO channel after a time-out: an answer that comes too late is never taken for that of the next request."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from fdhil.drivers.can import sdo
from fdhil.drivers.can.sdo import SdoLink
from fdhil.errors import DeviceTimeout, ProtocolError


class SlowNode:
    """A node that answers 0x1016 only once everybody has given up, and all else at once with 7."""

    def __init__(self) -> None:
        self.link: Any = None
        self.waiting: list[bytes] = []

    def send(self, can_id: int, data: bytes) -> None:
        """Take a request; what waits arrives before the answer to it."""
        assert can_id == 0x601
        if data[0] == 0x80:  # an abort has no answer
            return
        answer = b"\x43" + data[1:4] + struct.pack("<I", 7)
        if data[1:3] == b"\x16\x10":
            self.waiting.append(answer)
            return
        self.arrive()
        self.link.deliver(answer)

    def arrive(self, _seconds: float = 0.0) -> None:
        """The late answers come."""
        for answer in self.waiting:
            self.link.deliver(answer)
        self.waiting = []


@pytest.mark.fault("A26")
def test_the_roll_back_is_not_spoilt_by_a_late_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdo, "RESPONSE_TIMEOUT_S", 0.02)
    node = SlowNode()
    link = SdoLink("drive X", 1, node.send)
    node.link = link
    monkeypatch.setattr(sdo, "QUIET_S", 0.0)
    with pytest.raises(DeviceTimeout):
        link.read_int(0x1016, 1)
    monkeypatch.setattr("fdhil.drivers.can.sdo.time.sleep", node.arrive)
    assert link.read_int(0x60B0) == 7
    assert link.read_int(0x6041) == 7


@pytest.mark.fault("A26")
def test_an_answer_to_what_another_program_asked_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdo, "QUIET_S", 0.0)
    node = SlowNode()
    node.link = link = SdoLink("drive X", 1, node.send)
    node.waiting = [b"\x60\x16\x10\x01" + bytes(4)]  # a download's, of a program that has ended
    assert link.read_int(0x1018, 2) == 7
    link = SdoLink("drive X", 1, lambda can_id, data: link.deliver(b"\x60\x16\x10\x01" + bytes(4)))
    with pytest.raises(ProtocolError, match="answered wrongly"):
        link.read_int(0x1018, 2)
