"""Defines the interface between a CAN bus and the simulator's loop, and the pipe that wakes that loop."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Protocol

from fdhil.sim.frame_types import Frame

Handler = Callable[[Frame], None]
Spoil = Callable[[Frame, object], Iterable[tuple[Frame, object]]]
"""Return the frames that replace a frame, each with its sender."""


class Selectable(Protocol):
    """Anything that ``select`` accepts."""

    def fileno(self) -> int:
        """The file descriptor."""
        ...


class BusAttachment(ABC):
    """A bus to which the simulator is attached; the defaults suit a bus that accepts all frames at once.

    ``settings`` are the arguments with which ``can.Bus`` joins. ``senders_left`` counts the parties that left after
    sending frames, as far as the bus can detect it. ``spoil`` filters the frames of other parties.
    """

    settings: dict[str, str | int]
    senders_left = 0
    apply_faults: Spoil = staticmethod(lambda frame, sender: ((frame, sender),))

    @property
    def is_congested(self) -> bool:
        """Whether the bus accepts no more frames for the moment."""
        return False

    @property
    def has_clients(self) -> bool:
        """Whether another party is on the bus; True where that is not visible."""
        return True

    @abstractmethod
    def list_readers(self) -> Sequence[Selectable]:
        """Return the objects to select for reading."""

    def list_writers(self) -> Sequence[Selectable]:
        """Return the objects to select for writing."""
        return ()

    def find_deadline_s(self) -> float | None:
        """Return the monotonic time at which :meth:`flush` is due although nothing is ready."""
        return None

    @abstractmethod
    def receive_frames(self, ready: Sequence[object], handler: Handler) -> None:
        """Pass every frame of the other parties to ``handler``."""

    @abstractmethod
    def relay_frame(self, frame: Frame, sender: object) -> None:
        """Pass a frame of one party on to the others, unless the bus has done so."""

    @abstractmethod
    def disconnect_clients(self) -> None:
        """Disconnect all clients, where possible; they may reconnect."""

    @abstractmethod
    def queue_frames(self, frames: Sequence[Frame]) -> None:
        """Queue frames for all parties."""

    @abstractmethod
    def flush_frames(self, now_s: float) -> None:
        """Send the queued frames as far as the bus accepts them; ``now_s`` is monotonic."""

    @abstractmethod
    def close(self) -> None:
        """Leave the bus."""


class WakePipe:
    """A pipe that becomes readable when another thread, or a signal handler, calls :meth:`wake`."""

    def __init__(self) -> None:
        self._ends = os.pipe()
        for end in self._ends:
            os.set_blocking(end, False)

    def fileno(self) -> int:
        return self._ends[0]

    def wake_reader(self) -> None:
        """Make it readable; a full or just closed pipe is ignored."""
        with suppress(OSError):
            os.write(self._ends[1], b"\0")

    def clear_wakes(self) -> None:
        with suppress(BlockingIOError):
            os.read(self._ends[0], 4096)

    def close(self) -> None:
        ends, self._ends = self._ends, (-1, -1)  # their numbers may be reused: a late wake must not reach another file
        for end in ends:
            os.close(end)
