"""Virtual time: it advances only by waiting, without threads, so that days of time-outs take minutes."""

from __future__ import annotations

import asyncio
import json
import selectors
import signal
import socket
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

from fdhil.arming import program_check
from fdhil.system_clock import Clock

NO_PROCESS = 2**30  # more than any process has
FIRST_WALL_S = 1_790_000_000.0


class VirtualClock(Clock):
    """A clock that advances only on request; ``set_s`` is the change of the wall clock since then."""

    def __init__(self) -> None:
        self.time_s = 1000.0
        self.set_s = 0.0

    def advance(self, until_s: float) -> None:
        """Advance time to ``until_s``."""
        self.time_s = max(self.time_s, until_s)

    def now_s(self) -> float:
        return self.time_s

    def wall_s(self) -> float:
        return FIRST_WALL_S + self.time_s + self.set_s

    def read_boot_time_ns(self) -> int:
        return round(self.time_s * 1e9)

    def read_boot_id(self) -> str:
        return "00000000-0000-4000-8000-000000000001"

    def sleep(self, seconds: float) -> None:
        self.advance(self.time_s + seconds)

    def wait_readable(self, connection: socket.socket, seconds: float) -> bool:
        raise RuntimeError("nothing in this program can make the connection readable")


class ImpatientClock(VirtualClock):
    """A clock without sleep: time advances at once; answers of other threads are awaited in real time."""

    def wait_readable(self, connection: socket.socket, seconds: float) -> bool:
        return Clock.wait_readable(self, connection, seconds)


class ProcessKilled(BaseException):
    """Raised by any call of a killed process."""


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop on a virtual clock: instead of waiting, the clock advances; worker threads are plain calls.

    Signal handlers are called by ``send_signal`` only. Once ``dead``, the loop has no further effect.
    """

    def __init__(self, clock: VirtualClock | None = None) -> None:
        self.clock = clock or VirtualClock()
        super().__init__(_AdvancingSelector(self.clock))
        self._handlers: dict[int, Callable[[], object]] = {}
        self.dead = False

    def time(self) -> float:
        """Return the virtual time, s."""
        return self.clock.now_s()

    def monotonic_ns(self) -> int:
        """Replace ``time.monotonic_ns``."""
        return round(self.clock.now_s() * 1e9)

    def run_in_executor(self, executor: Any, call: Callable[..., Any], *given: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        """Run the call now, in this thread."""
        done = self.create_future()
        try:
            if self.dead:
                raise ProcessKilled
            done.set_result(call(*given))
        except StopIteration as error:
            done.set_exception(RuntimeError(repr(error)))
        except (Exception, ProcessKilled) as error:  # noqa: BLE001 - whatever it is, the waiting coroutine gets it
            done.set_exception(error)
        return done

    async def subprocess_exec(self, protocol_factory: Any, *arguments: Any, **_named: Any) -> Any:
        """Run the program check, the only module started as a process, in this process."""
        if self.dead or arguments[1:] != ("-m", program_check.__name__):
            raise OSError(11, f"{arguments} cannot be started on virtual time")
        protocol = protocol_factory()
        transport = _CheckInProcess(self, protocol)
        protocol.connection_made(transport)
        return transport, protocol

    def add_signal_handler(self, sig: int, callback: Callable[..., Any], *args: Any) -> None:  # type: ignore[override]
        self._handlers[sig] = lambda: callback(*args)

    def remove_signal_handler(self, sig: int) -> bool:
        return self._handlers.pop(sig, None) is not None

    def send_signal(self, number: int = signal.SIGTERM) -> None:
        """Call the handler of a signal."""
        self._handlers[number]()


class _CheckInProcess(asyncio.SubprocessTransport):
    """The program check as a process that answers at once; it is its own pipe to stdin."""

    def __init__(self, loop: VirtualLoop, protocol: asyncio.SubprocessProtocol) -> None:
        super().__init__()
        self._loop, self._protocol, self._ended = loop, protocol, asyncio.Event()
        self._code: int | None = None

    def get_pid(self) -> int:
        return NO_PROCESS

    def get_returncode(self) -> int | None:
        return self._code

    def get_pipe_transport(self, fd: int) -> Any:
        return self

    def write(self, data: bytes) -> None:
        def report_result(answer: Mapping[str, Any]) -> None:
            line = json.dumps(answer).encode() + b"\n"
            self._loop.call_soon(self._protocol.pipe_data_received, 1, line)

        program_check.answer_request(json.loads(data), report_result)
        self._loop.call_soon(self._finish)

    def _finish(self) -> None:
        self._code = 0
        self._ended.set()
        self._protocol.pipe_connection_lost(1, None)
        self._protocol.process_exited()

    async def _wait(self) -> int:
        await self._ended.wait()
        return self._code or 0

    def pause_reading(self) -> None:
        """Do nothing: all output is in memory already."""

    resume_reading = close = pause_reading

    def is_closing(self) -> bool:
        return self._code is not None


class _AdvancingSelector(selectors.DefaultSelector):
    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0)
        if ready or timeout is None or timeout <= 0:
            return ready
        self._clock.advance(self._clock.now_s() + timeout)
        return super().select(0)


def run_virtual(main: Coroutine[Any, Any, Any], loop: VirtualLoop) -> Any:
    try:
        return loop.run_until_complete(main)
    finally:
        loop.close()
