"""Threads that run one at a time, on their own clock: a test of several threads is repeatable.

``virtual_threads`` controls the test and all threads that it starts. One of them runs until it sleeps or waits; then
the ready thread that has waited longest runs. The clock stands still while one runs; if all wait, it advances to the
first deadline. So a busy host changes nothing, and a wait costs no time.
"""

from __future__ import annotations

import math
import queue
import random
import select
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import can.bus
import pytest

from fdhil.system_clock import SYSTEM_CLOCK, Clock

FIRST_S = 1000.0
FIRST_WALL_S = 1_790_000_000.0
OUTSIDE_S = 0.001  # polling period for outside events if no thread has a deadline
UNWOUND_S = 10.0
ROUNDING_S = 1e-9  # a computed remaining time-out is then zero

_sleep, _monotonic, _wall_s = time.sleep, time.monotonic, time.time
_start, _join, _wait = threading.Thread.start, threading.Thread.join, threading.Condition.wait
_select, _wait_readable = selectors.DefaultSelector.select, Clock.wait_readable


class _WaitingThread:
    """A thread that waits until ``ready``, or until ``until_s``; ``go`` is released when it may run."""

    def __init__(self, ready: Callable[[], bool], until_s: float = math.inf) -> None:
        self.ready, self.until_s = ready, until_s
        self.go = threading.Lock()
        self.go.acquire()


class _ThreadMark(threading.local):
    takes_turns = False


class VirtualThreads:
    """Runs its own thread and those that it starts; ``now_s`` is their monotonic time.

    ``seed``: the next of the ready threads is selected at random, if given.
    """

    def __init__(self, seed: int | None = None) -> None:
        self._chance = None if seed is None else random.Random(seed)
        self.now_s = FIRST_S
        self._waiting: list[_WaitingThread] = []
        self._ended: list[threading.Thread] = []
        self._released = False
        self._thread = _ThreadMark()
        self._thread.takes_turns = True

    def wait(self, ready: Callable[[], bool], seconds: float | None) -> bool:
        """Let others run until ``ready``, at most for the given time; return whether it is."""
        turn = _WaitingThread(ready, math.inf if seconds is None else self.now_s + seconds + ROUNDING_S)
        self._waiting.append(turn)
        self._run_next_thread(turn)
        return ready()

    def _run_next_thread(self, own: _WaitingThread | None = None) -> None:
        if self._released:
            return
        following = self._select_next()
        if following is not own:
            following.go.release()
            if own is not None:
                self._await_turn(own)

    def _select_next(self) -> _WaitingThread:
        while True:
            may_run = (turn for turn in self._waiting if turn.until_s <= self.now_s or turn.ready())
            first = next(may_run, None)
            if first is not None:
                turn = first if self._chance is None else self._chance.choice([first, *may_run])
                self._waiting.remove(turn)
                return turn
            first_s = min(turn.until_s for turn in self._waiting)
            if first_s < math.inf:
                self.now_s = first_s
            else:
                _sleep(OUTSIDE_S)

    def _await_turn(self, turn: _WaitingThread) -> None:
        try:
            turn.go.acquire()
        except BaseException:  # a signal's handler has raised it
            turn.until_s = 0.0
            turn.go.acquire(timeout=UNWOUND_S)
            raise
        while self._ended:
            _join(self._ended.pop())

    # replacements of standard-library functions ---------------------------------------------------------------------

    def monotonic(self) -> float:
        return self.now_s if self._thread.takes_turns else _monotonic()

    def wall_s(self) -> float:
        return FIRST_WALL_S + self.now_s if self._thread.takes_turns else _wall_s()

    def sleep(self, seconds: float) -> None:
        if self._thread.takes_turns:
            self.wait(lambda: False, seconds)
        else:
            _sleep(seconds)

    def wait_condition(self, condition: Any, timeout: float | None = None) -> bool:
        """Replace ``Condition.wait``; its ``notify`` releases the lock."""
        if not self._thread.takes_turns:
            return _wait(condition, timeout)
        waiter = threading.Lock()
        waiter.acquire()
        condition._waiters.append(waiter)
        saved = condition._release_save()
        try:
            notified = self.wait(lambda: not waiter.locked(), timeout)
        finally:
            condition._acquire_restore(saved)
        if not notified:
            condition._waiters.remove(waiter)
        return notified

    def start(self, thread: threading.Thread) -> None:
        if not self._thread.takes_turns:
            _start(thread)
            return
        turn, run = _WaitingThread(lambda: True), thread.run

        def run_in_turn() -> None:
            self._await_turn(turn)
            self._thread.takes_turns = True
            try:
                run()
            finally:
                self._thread.takes_turns = False
                self._ended.append(thread)
                self._run_next_thread()

        thread.run = run_in_turn  # type: ignore[method-assign]
        self._thread.takes_turns = False  # the new thread reports its start before it waits for its turn
        try:
            _start(thread)
        finally:
            self._thread.takes_turns = True
        self._waiting.append(turn)

    def join(self, thread: threading.Thread, timeout: float | None = None) -> None:
        if self._thread.takes_turns and thread.is_alive():
            self.wait(lambda: thread in self._ended or not thread.is_alive(), timeout)
        else:
            _join(thread, timeout)

    def select(self, selector: Any, timeout: float | None = None) -> Any:
        if not self._thread.takes_turns:
            return _select(selector, timeout)
        found: list[Any] = []

        def ready() -> bool:
            found[:] = found or _select(selector, 0)
            return bool(found)

        self.wait(ready, timeout)
        return found

    def wait_readable(self, clock: Clock, connection: socket.socket, seconds: float | None) -> bool:
        if not self._thread.takes_turns:
            return _wait_readable(clock, connection, seconds or 0.0)
        poll = select.poll()
        poll.register(connection, select.POLLIN)
        return self.wait(lambda: bool(poll.poll(0)), seconds)

    def wrap_when_readable(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return a socket call that lets others run until there is data to read."""

        def wait_then_call(connection: socket.socket, *given: Any) -> Any:
            blocks = connection.gettimeout() != 0 and connection.fileno() >= 0
            if (
                self._thread.takes_turns
                and blocks
                and not self.wait_readable(SYSTEM_CLOCK, connection, connection.gettimeout())
            ):
                raise TimeoutError("timed out")
            return call(connection, *given)

        return wait_then_call

    def install_patches(self, patch: pytest.MonkeyPatch) -> None:
        """Replace the waiting functions of threads, and the clocks; a thread pool waits by a queue made of these."""
        # python-can measures its waiting time by the wall clock
        for module, name in ((time, "monotonic"), (threading, "_time"), (queue, "time"), (can.bus, "time")):
            patch.setattr(module, name, self.monotonic)
        patch.setattr(time, "time", self.wall_s)
        patch.setattr(time, "monotonic_ns", lambda: round(self.monotonic() * 1e9))
        patch.setattr(time, "time_ns", lambda: round(self.wall_s() * 1e9))
        patch.setattr(time, "sleep", self.sleep)
        for name in ("accept", "recv", "recvmsg"):
            patch.setattr(socket.socket, name, self.wrap_when_readable(getattr(socket.socket, name)))
        patch.setattr(Clock, "wait_readable", lambda *given: self.wait_readable(*given))
        patch.setattr(queue, "SimpleQueue", queue._PySimpleQueue)  # type: ignore[attr-defined]
        patch.setattr(threading.Condition, "wait", lambda *given: self.wait_condition(*given))
        patch.setattr(threading.Thread, "start", lambda thread: self.start(thread))
        patch.setattr(threading.Thread, "join", lambda *given, **named: self.join(*given, **named))
        patch.setattr(selectors.DefaultSelector, "select", lambda *given: self.select(*given))

    def release_all(self) -> None:
        """Let every thread run freely."""
        self._thread.takes_turns, self._released = False, True
        while self._waiting:
            self._waiting.pop().go.release()


@pytest.fixture
def virtual_threads(request: pytest.FixtureRequest) -> Iterator[VirtualThreads]:
    """Run the test and its threads one at a time on virtual time; its parameter is a seed."""
    threads = VirtualThreads(getattr(request, "param", None))
    with pytest.MonkeyPatch.context() as patch:
        threads.install_patches(patch)
        yield threads
    threads.release_all()
