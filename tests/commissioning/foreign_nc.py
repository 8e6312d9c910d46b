"""An NC that is switched on while fdhil acts on a bus of this process."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import can

Frame = tuple[int, bytes]
SYNC, NMT, TARGET, OFFSET, SDO, HEARTBEAT = 0x080, 0x000, 0x201, 0x301, 0x601, 0x764
A_FEW = 11  # SYNCs for detection, ramp to zero offset, and switching off
TO_BRAKE = 17  # additional SYNCs if the axis moves
FOREIGN: dict[str, Frame] = {
    "SYNC": (SYNC, b""),
    "NMT": (NMT, b"\x01\x00"),
    "target": (TARGET, b"\x0f\x00" + (100).to_bytes(4, "little")),
    "offset": (OFFSET, (7).to_bytes(4, "little")),
    "set-points of another drive": (0x205, bytes(6)),
    "SDO request": (SDO, b"\x40\x41\x60\0\0\0\0\0"),
}
LEFT_TO_IT = {"target": TARGET, "offset": OFFSET}
"""What fdhil does not send any more, since another master does."""


@dataclass
class ForeignNc:
    """Listens to a bus and is switched on by a frame; ``sent`` are fdhil's frames after the NC's first one.

    Frames that fdhil sent before, still in the queue, are omitted.
    """

    channel: str
    frame: Frame
    when: Callable[[Frame], bool]
    often: bool = True
    sent: list[Frame] = field(default_factory=list)
    on: bool = False

    def __post_init__(self) -> None:
        self._bus = can.Bus(interface="virtual", channel=self.channel)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run_thread, daemon=True)

    def _run_thread(self) -> None:
        due = 0.0
        while not self._stopping.is_set():
            message = self._bus.recv(0.001)
            if message is not None and message.arbitration_id in (SYNC, NMT, TARGET, OFFSET, SDO, HEARTBEAT, 0x765):
                received = (message.arbitration_id, bytes(message.data))
                self.sent += [received] if due else []
                self.on = self.on or self.when(received)
            if self.on and time.monotonic() >= due:
                while not due and self._bus.recv(0) is not None:
                    pass
                due = time.monotonic() + 0.002 if self.often else float("inf")
                self._bus.send(can.Message(arbitration_id=self.frame[0], data=self.frame[1], is_extended_id=False))

    def __enter__(self) -> ForeignNc:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._bus.shutdown()

    def count_frames(self, can_id: int) -> int:
        return [sent for sent, _ in self.sent].count(can_id)


def decode_offset(frame: Frame) -> int:
    return int.from_bytes(frame[1][:4], "little", signed=True) if frame[0] == OFFSET else 0


def is_offset_frame(frame: Frame) -> bool:
    return decode_offset(frame) > 5


def is_moving_frame(frame: Frame) -> bool:
    return frame[0] == TARGET and int.from_bytes(frame[1][2:6], "little", signed=True) > 3000


class LateOperator(io.StringIO):
    """Answers just after an NC was switched on; ``question``: at which question."""

    def __init__(self, nc: ForeignNc, answers: str = "y\n", question: int = 1) -> None:
        super().__init__(answers)
        self._nc, self._before = nc, question

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]  # as in typeshed's TextIOBase
        self._before -= 1
        self._nc.on |= self._before == 0
        return super().readline(size)
