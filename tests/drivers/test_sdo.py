"""The SDO channel after a time-out: a late answer is never taken as the answer to the next request."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from fdhil.drivers.can import sdo_channel
from fdhil.drivers.can.sdo_channel import SdoChannel
from fdhil.errors import ProtocolError, SdoAbort, SdoTimeout, SdoToggle, SdoTooLarge


class SlowNode:
    """A node that answers 0x1016 only after every time-out, and everything else at once with 7."""

    def __init__(self) -> None:
        self.link: Any = None
        self.waiting: list[bytes] = []

    def send(self, can_id: int, data: bytes) -> None:
        """Take a request; late answers are sent before the answer to it."""
        assert can_id == 0x601
        if data[0] == 0x80:  # an abort has no answer
            return
        answer = b"\x43" + data[1:4] + struct.pack("<I", 7)
        if data[1:3] == b"\x16\x10":
            self.waiting.append(answer)
            return
        self.deliver_answers()
        self.link.deliver_response(answer)

    def deliver_answers(self, _seconds: float = 0.0) -> None:
        """Deliver the late answers."""
        for answer in self.waiting:
            self.link.deliver_response(answer)
        self.waiting = []


@pytest.mark.fault("A26")
def test_roll_back_is_not_corrupted_by_a_late_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdo_channel, "RESPONSE_TIMEOUT_S", 0.02)
    node = SlowNode()
    link = SdoChannel("drive X", 1, node.send)
    node.link = link
    monkeypatch.setattr(sdo_channel, "QUIET_S", 0.0)
    with pytest.raises(SdoTimeout):
        link.read_int(0x1016, 1)
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.time.sleep", node.deliver_answers)
    assert link.read_int(0x60B0) == 7
    assert link.read_int(0x6041) == 7


@pytest.mark.fault("A26")
def test_answer_to_another_programs_request_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdo_channel, "QUIET_S", 0.0)
    node = SlowNode()
    node.link = link = SdoChannel("drive X", 1, node.send)
    node.waiting = [b"\x60\x16\x10\x01" + bytes(4)]  # a download's, of a program that has ended
    assert link.read_int(0x1018, 2) == 7
    link = SdoChannel("drive X", 1, lambda can_id, data: link.deliver_response(b"\x60\x16\x10\x01" + bytes(4)))
    with pytest.raises(ProtocolError, match="got a wrong answer"):
        link.read_int(0x1018, 2)


@pytest.mark.parametrize(
    ("command", "size"), [(0x4B, 2), (0x43, 4), (0x4F, 1), (0x42, None)], ids=["two", "four", "one", "not told"]
)
def test_object_size_is_read_from_the_answer(command: int, size: int | None) -> None:
    """CiA 301, 7.2.4.3.5: an expedited answer need not give how many of its four bytes are data."""

    def send(_can_id: int, data: bytes) -> None:
        link.deliver_response(bytes([command]) + data[1:4] + bytes(4))

    link = SdoChannel("drive X", 1, send)
    assert link.read_size(0x6041) == size


class SegmentedNode:
    """A node that answers an upload with endless segments, or with a wrong toggle bit in each."""

    def __init__(self, toggles: bool, declares: int = 0) -> None:
        self.link: Any = None
        self.toggles = toggles
        self.declares = declares
        self.aborts: list[int] = []
        self.segments = 0

    def send(self, can_id: int, data: bytes) -> None:
        if data[0] == 0x80:
            self.aborts.append(int.from_bytes(data[4:], "little"))
        elif data[0] == 0x40:
            self.link.deliver_response(b"\x41" + data[1:4] + struct.pack("<I", self.declares))
        else:
            self.segments += 1
            self.link.deliver_response(bytes([data[0] & 0x10 if self.toggles else 0x10 & ~data[0]]) + bytes(7))


@pytest.mark.fault("A27")
@pytest.mark.parametrize(
    ("node", "says", "code", "error"),
    [
        (SegmentedNode(toggles=False), "got a wrong answer .*toggle", 0x05030000, SdoToggle),
        (SegmentedNode(toggles=True), "is longer than 65536 bytes", 0x05040005, SdoTooLarge),
        (SegmentedNode(toggles=True, declares=1 << 30), "is longer than 65536 bytes", 0x05040005, SdoTooLarge),
    ],
    ids=["toggle", "endless", "declares too much"],
)
def test_wrong_or_endless_segments_are_aborted(
    node: SegmentedNode, says: str, code: int, error: type[ProtocolError], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sdo_channel, "QUIET_S", 0.0)
    node.link = SdoChannel("drive X", 1, node.send, patience=100.0)
    with pytest.raises(error, match=f"(?i){says}"):
        node.link.read_bytes(0x1008)
    assert set(node.aborts) == {code}
    assert node.segments <= 65536 // 7 + 2


@pytest.mark.fault("A27")
def test_slow_segments_are_aborted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdo_channel, "DEADLINE_S", 0.0)
    node = SegmentedNode(toggles=True)
    node.link = SdoChannel("drive X", 1, node.send)
    with pytest.raises(SdoTooLarge, match="was not finished after 0 s"):
        node.link.read_bytes(0x1008)
    assert node.aborts == [0x05040000]


@pytest.mark.fault("A25")
def test_drives_abort_is_reported_with_its_code() -> None:
    for code in (0x06090030, 0x08000022):
        link = SdoChannel("drive X", 1, lambda can_id, data: None)
        link._send = (
            lambda can_id, data, to=link, code=code: to.deliver_response(  # type: ignore[misc] # the loop's own
                b"\x80" + data[1:4] + struct.pack("<I", code)
            )
        )
        with pytest.raises(SdoAbort, match=f"{code:08X}") as caught:
            link.write_int(0x6065, 0, 5, 4)
        assert caught.value.code == code
