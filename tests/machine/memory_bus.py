"""A CAN bus in memory that connects the simulated machine, the guard's socket and the daemon's listener."""

from __future__ import annotations

import hashlib
import select
import socket
from collections.abc import Callable, Iterable, Sequence
from typing import IO

import numpy as np

from fdhil import config
from fdhil.drivers.can.filters import filter_frames
from fdhil.drivers.can.frame_ring import Frames, pack_frames
from fdhil.drivers.can.receive_port import Filter, Stamps
from fdhil.errors import ConnectError
from fdhil.guard.can_socket import MOST_FRAMES, BusDown, CanSocket, Frame
from fdhil.sim.frame_faults import FrameFaults

Row = tuple[int, int, bytes]
MOST_ROWS = 20_000


class MemoryBus:
    """All frames of the bus in order; ``digest`` covers all of them, ``trace`` is the file they are written to.

    ``from_guard`` is called with each frame of the guard.
    """

    def __init__(self, name: str, now_s: Callable[[], float], faults: FrameFaults) -> None:
        self.name, self.now_s, self.faults = name, now_s, faults
        self.digest = hashlib.sha256()
        self.frames = 0
        self.trace: IO[bytes] | None = None
        self.listener: BusListener | None = None
        self.guard: GuardSocket | None = None
        self.from_guard: Callable[[int, bytes], bool] = lambda _cob_id, _data: True
        self._rows: list[Row] = []

    @property
    def is_down(self) -> bool:
        return self.faults.down

    def put_frame(self, frames: Iterable[tuple[int, bytes]], *, of_guard: bool = False) -> None:
        """Deliver frames to all listeners; the guard does not receive its own."""
        now_s = self.now_s()
        t_ns = round(now_s * 1e9)
        rows = [(t_ns, can_id, data) for can_id, data in frames]
        self._rows += rows
        if self.guard is not None and not of_guard:
            self.guard.inbox += [(can_id, data, now_s) for _, can_id, data in rows if can_id in self.guard.wanted]
        if len(self._rows) >= MOST_ROWS:
            self.deliver_frames()

    def deliver_frames(self) -> None:
        if not self._rows:
            return
        frames = pack_frames(self._rows)
        self._rows.clear()
        self.frames += frames.size
        self.digest.update(frames.tobytes())
        if self.trace is not None:
            self.trace.write(frames.tobytes())
        if self.listener is not None:
            self.listener.blocks.append(frames)

    def open_listener(self, name: str, settings: config.CanBus, *, filters: Sequence[Filter] = ()) -> BusListener:
        """Open the bus for listening, like ``CanBus``; ConnectError while it is down."""
        if self.is_down:
            raise ConnectError(name, "the interface is down; switch it on")
        self.deliver_frames()
        self.listener = BusListener(self, filters)
        return self.listener


class BusListener:
    """The daemon's end: the frames since it was opened, in blocks."""

    stamps: Stamps = "kernel"

    def __init__(self, bus: MemoryBus, filters: Sequence[Filter]) -> None:
        self.blocks: list[Frames] = []
        self.last_frame_ns = round(bus.now_s() * 1e9)
        self._bus, self._filters, self._count = bus, filters, 0

    @property
    def end_reason(self) -> str | None:
        """Why no more frames come."""
        return "the interface is down" if self._bus.is_down else None

    def drain_frames(self) -> Frames:
        self._bus.deliver_frames()
        blocks, self.blocks = self.blocks, []
        frames = filter_frames(np.concatenate(blocks), self._filters) if blocks else pack_frames(())
        self._count += frames.size
        if frames.size:
            self.last_frame_ns = int(frames["t_ns"][-1])
        return frames

    def read_counters(self) -> dict[str, int]:
        """Return frames received and lost."""
        return {"frames": self._count, "ring_overflow": 0, "kernel_drops": 0, "lost": 0}

    def close(self) -> None:
        if self._bus.listener is self:
            self._bus.listener = None


class GuardSocket(CanSocket):
    """The guard's end: ``inbox`` holds unread frames, ``wanted`` are the COB-IDs of its filter."""

    def __init__(self, bus: MemoryBus, allowed: Iterable[int], wanted: Iterable[int]) -> None:
        super().__init__(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM), allowed)
        self.inbox: list[Frame] = []
        self.wanted = frozenset(wanted)
        self._bus = bus

    @property
    def is_readable(self) -> bool:
        """Whether a frame waits, or the bus has ended."""
        return bool(self.inbox) or self._bus.is_down

    def receive(self) -> list[Frame]:
        if self._bus.is_down:
            self.inbox.clear()
            raise BusDown("Network is down")
        frames, self.inbox = self.inbox[:MOST_FRAMES], self.inbox[MOST_FRAMES:]
        return frames

    def try_restore(self) -> bool:
        self.inbox.clear()
        return not self._bus.is_down

    def _send(self, cob_id: int, data: bytes) -> bool:
        if self._bus.is_down:
            raise OSError(100, "Network is down")
        return self._bus.from_guard(cob_id, data)


class GuardPoll:
    """Replaces ``select.poll`` in the guard: never waits, but reports to ``rest`` how long it would have waited.

    For a guard whose loop has failed, which waits for the bus alone, ``wait`` advances time until a frame comes.
    """

    def __init__(self, can: GuardSocket, rest: Callable[[float], None], wait: Callable[[float], None]) -> None:
        self._can, self._rest, self._wait = can, rest, wait
        self._clients = select.poll()
        self._can_asked = self._clients_asked = False

    def register(self, what: object, events: int) -> None:
        """Register the bus, or an object with a descriptor."""
        if what is self._can:
            self._can_asked = True
        else:
            self._clients_asked = True
            self._clients.register(what, events)  # type: ignore[arg-type] # has fileno()

    def poll(self, wait_ms: float) -> list[tuple[int, int]]:
        if wait_ms > 0 and not self._clients_asked and not self._can.is_readable:
            self._wait(wait_ms * 1e-3)
        ready = self._clients.poll(0) if self._clients_asked else []
        by_client = bool(ready)
        if self._can_asked and self._can.is_readable:
            ready.append((self._can.fileno(), select.POLLIN))
        if self._clients_asked:  # else it only looks whether a frame waits
            self._rest(0.0 if by_client else wait_ms * 1e-3)  # after a frame it would wait again at once
        return ready
