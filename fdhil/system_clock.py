"""Reads this computer's clocks and waits by them; a class that takes a ``Clock`` also runs on simulated time.

Coroutines do not need it: the time of their event loop is the same monotonic clock.
"""

import select
import socket
import time
from pathlib import Path


class Clock:
    """This computer's clocks, and a thread's two ways to wait."""

    def now_s(self) -> float:
        """Return the monotonic time, s."""
        return time.monotonic()

    def wall_s(self) -> float:
        """Return the wall clock, s since 1970; it may be wrong, and may be set."""
        return time.time()

    def read_boot_time_ns(self) -> int:
        """Return the time since the computer was started, including suspended time: a machine ages meanwhile."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def read_boot_id(self) -> str:
        """Return the kernel's identifier of this boot; times since boot compare only within one boot."""
        try:
            return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
        except OSError:
            return ""

    def sleep(self, seconds: float) -> None:
        """Block this thread."""
        time.sleep(seconds)

    def wait_readable(self, connection: socket.socket, seconds: float) -> bool:
        """Wait until ``connection`` is readable, at most ``seconds``; return whether it is."""
        poll = select.poll()
        poll.register(connection, select.POLLIN)
        return bool(poll.poll(seconds * 1000))


SYSTEM_CLOCK = Clock()
