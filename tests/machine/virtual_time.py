"""Time that passes only by being waited for: threads do not exist, and days of time-outs take minutes."""

from __future__ import annotations

import asyncio
import selectors
import signal
import socket
from collections.abc import Callable, Coroutine
from typing import Any

from fdhil.system_clock import Clock

FIRST_WALL_S = 1_790_000_000.0


class VirtualClock(Clock):
    """A clock that stands still until it is advanced; ``set_s`` is by how much the wall clock was set since."""

    def __init__(self) -> None:
        self.time_s = 1000.0
        self.set_s = 0.0

    def advance(self, until_s: float) -> None:
        """Let time pass until ``until_s``."""
        self.time_s = max(self.time_s, until_s)

    def now_s(self) -> float:
        return self.time_s

    def wall_s(self) -> float:
        return FIRST_WALL_S + self.time_s + self.set_s

    def since_boot_ns(self) -> int:
        return round(self.time_s * 1e9)

    def boot_id(self) -> str:
        return "00000000-0000-4000-8000-000000000001"

    def sleep(self, seconds: float) -> None:
        self.advance(self.time_s + seconds)

    def wait_readable(self, connection: socket.socket, seconds: float) -> bool:
        raise RuntimeError("nothing in this program can make the connection readable")


class Killed(BaseException):
    """What a call meets that a killed process would have made."""


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop on a virtual clock: where it would wait, the clock advances; worker threads are plain calls.

    Signal handlers are called by ``send_signal`` alone. Once ``dead``, nothing that leaves the loop happens any more.
    """

    def __init__(self, clock: VirtualClock | None = None) -> None:
        self.clock = clock or VirtualClock()
        super().__init__(_Advancing(self.clock))
        self._handlers: dict[int, Callable[[], object]] = {}
        self.dead = False

    def time(self) -> float:
        """Return the virtual time, s."""
        return self.clock.now_s()

    def monotonic_ns(self) -> int:
        """Stand in for ``time.monotonic_ns``."""
        return round(self.clock.now_s() * 1e9)

    def run_in_executor(self, executor: Any, call: Callable[..., Any], *given: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        """Make the call now, in this thread."""
        done = self.create_future()
        try:
            if self.dead:
                raise Killed
            done.set_result(call(*given))
        except StopIteration as error:
            done.set_exception(RuntimeError(repr(error)))
        except (Exception, Killed) as error:  # noqa: BLE001 - whatever it is, the waiting coroutine gets it
            done.set_exception(error)
        return done

    async def subprocess_exec(self, *arguments: Any, **named: Any) -> Any:
        raise OSError(11, "there are no processes on virtual time")

    def add_signal_handler(self, sig: int, callback: Callable[..., Any], *args: Any) -> None:  # type: ignore[override]
        self._handlers[sig] = lambda: callback(*args)

    def remove_signal_handler(self, sig: int) -> bool:
        return self._handlers.pop(sig, None) is not None

    def send_signal(self, number: int = signal.SIGTERM) -> None:
        """Call the handler of a signal."""
        self._handlers[number]()


class _Advancing(selectors.DefaultSelector):
    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0)
        if ready or timeout is None or timeout <= 0:
            return ready
        self._clock.advance(self._clock.now_s() + timeout)
        return super().select(0)


def run(main: Coroutine[Any, Any, Any], loop: VirtualLoop) -> Any:
    """Run a coroutine to its end in virtual time."""
    try:
        return loop.run_until_complete(main)
    finally:
        loop.close()
