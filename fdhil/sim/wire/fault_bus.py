"""A python-can bus that applies planned faults to another bus; use it with ``canopen.Network`` or any program.

plan = [FrameFault("drop", can_ids={0x181}, way="received", percent=5, from_sync=1000)]
bus = FaultBus(can.Bus(interface="virtual", channel="test"), plan, seed=1)
...
assert bus.faults.total("drop") == frames_my_program_missed
"""

import os
import threading
import time
from collections import deque
from collections.abc import Sequence

import can

from fdhil.sim.frame_faults import FrameFault, FrameFaults, Passed, PlannedBusError
from fdhil.sim.frame_types import EXTENDED, Frame

_ERROR, _REMOTE = 1 << 29, 1 << 30
_LOOK_S = 0.02  # polling interval for injected and delayed frames


class FaultBus(can.BusABC):
    """Wraps ``bus``, which is shut down with it. ``faults`` counts the applied faults; faults may be added any time.

    A planned error is a ``can.CanOperationError`` with its number, raised by ``send`` or ``recv``. Periodic messages go
    through the plan, too.
    """

    def __init__(self, bus: can.BusABC, plan: Sequence[FrameFault] = (), seed: int = 0) -> None:
        self.faults = FrameFaults(plan, seed)
        self.channel_info = f"faults on {bus.channel_info}"
        self._bus = bus
        self._ready: deque[can.Message] = deque()
        self._lock = threading.Lock()
        super().__init__(channel=self.channel_info)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send the message as changed by the plan."""
        now_s = time.monotonic()
        with self._lock:
            passed = self._apply_plan(msg, sent=True, now_s=now_s) + self.faults.release_due("sent", now_s)
        for each in passed:
            self._bus.send(_convert_to_message(each), timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        until_s = float("inf") if timeout is None else time.monotonic() + timeout
        while True:
            now_s = time.monotonic()
            self._release_due_frames(now_s)
            if self._ready:
                return self._ready.popleft(), False
            message = self._bus.recv(max(0.0, min(until_s - now_s, _LOOK_S)))
            if message is not None:
                with self._lock:
                    self._ready.extend(
                        map(_convert_to_message, self._apply_plan(message, sent=False, now_s=time.monotonic()))
                    )
            elif now_s >= until_s:
                return None, False

    def _release_due_frames(self, now_s: float) -> None:
        with self._lock:
            self._ready.extend(map(_convert_to_message, self.faults.release_due("received", now_s)))
            late = self.faults.release_due("sent", now_s)
        for each in late:
            self._bus.send(_convert_to_message(each))

    def _apply_plan(self, message: can.Message, *, sent: bool, now_s: float) -> list[Passed]:
        try:
            return self.faults.process_frame(_convert_to_frame(message), "sent" if sent else "received", now_s, message)
        except PlannedBusError as error:
            raise can.CanOperationError(os.strerror(error.number), error.number) from None

    def shutdown(self) -> None:
        super().shutdown()
        self._bus.shutdown()


def _convert_to_frame(message: can.Message) -> Frame:
    flags = message.is_extended_id * EXTENDED | message.is_error_frame * _ERROR | message.is_remote_frame * _REMOTE
    return message.arbitration_id | flags, bytes(message.data)


def _convert_to_message(passed: Passed) -> can.Message:
    (can_id, data), origin = passed
    message: can.Message | None = origin
    if message is not None and _convert_to_frame(message) == (can_id, data):
        return message
    return can.Message(
        timestamp=time.time() if message is None else message.timestamp,
        arbitration_id=can_id & 0x1FFFFFFF,
        is_extended_id=bool(can_id & EXTENDED),
        is_remote_frame=bool(can_id & _REMOTE),
        is_error_frame=bool(can_id & _ERROR),
        data=data,
    )
