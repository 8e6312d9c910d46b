"""Describes a CAN bus as the twin's loop sees it, and the pipe by which another thread wakes that loop."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Protocol

from fdhil.sim.frame import Frame

Handler = Callable[[Frame], None]
Spoil = Callable[[Frame, object], Iterable[tuple[Frame, object]]]
"""What really comes in place of a frame, each with who sent it."""


class Selectable(Protocol):
    """Anything that ``select`` takes."""

    def fileno(self) -> int:
        """The file descriptor."""
        ...


class Attachment(ABC):
    """A bus to which the twin is attached; the defaults are those of one that takes everything at once.

    ``settings`` are the arguments with which ``can.Bus`` joins. ``senders_left`` counts the parties that left after
    they had sent frames, as far as the bus can tell. ``spoil`` stands between the others and the twin.
    """

    settings: dict[str, str | int]
    senders_left = 0
    spoil: Spoil = staticmethod(lambda frame, sender: ((frame, sender),))

    @property
    def congested(self) -> bool:
        """Whether the bus takes no more for the moment."""
        return False

    @property
    def is_joined(self) -> bool:
        """Whether anybody else is on the bus; True where that does not show."""
        return True

    @abstractmethod
    def readers(self) -> Sequence[Selectable]:
        """Return those to select for reading."""

    def writers(self) -> Sequence[Selectable]:
        """Return those to select for writing."""
        return ()

    def deadline_s(self) -> float | None:
        """Monotonic time at which :meth:`flush` is due although nothing is ready."""
        return None

    @abstractmethod
    def pump(self, ready: Sequence[object], handler: Handler) -> None:
        """Give every frame that the other parties sent to ``handler``."""

    @abstractmethod
    def relay(self, frame: Frame, sender: object) -> None:
        """Let the others hear what one of them sent; nothing where the bus has done so by itself."""

    @abstractmethod
    def hang_up(self) -> None:
        """Let go of everybody, where that can be done; they may join anew."""

    @abstractmethod
    def send(self, frames: Sequence[Frame]) -> None:
        """Queue frames to everybody."""

    @abstractmethod
    def flush(self, now_s: float) -> None:
        """Send what is queued as far as the bus takes it; ``now_s`` is monotonic."""

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
        """The end that becomes readable."""
        return self._ends[0]

    def wake(self) -> None:
        """Make it readable; when it is full of calls already, or has just been closed, nothing is lost."""
        with suppress(OSError):
            os.write(self._ends[1], b"\0")

    def clear(self) -> None:
        """Take the calls out of it."""
        with suppress(BlockingIOError):
            os.read(self._ends[0], 4096)

    def close(self) -> None:
        """Close both ends."""
        ends, self._ends = self._ends, (-1, -1)  # what is opened next has their numbers: a late wake is not for it
        for end in ends:
            os.close(end)
