"""Ends a process step by step: each step has a time limit, an overdue one is reported and abandoned.

Nothing waits for ever: a device that does not close, a disk that does not answer or a library that swallows its
cancellation delays the end but cannot prevent it. The guard then ramps any applied offset to zero by itself.
"""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine
from dataclasses import astuple, dataclass
from typing import Any

from fdhil.daemon import service_log

EXIT_CODE = 3
TEARDOWN_S = 2.0  # of the event loop, after the last step


@dataclass(frozen=True, slots=True)
class StepBudgets:
    """Time limit of each step, s; systemd's TimeoutStopSec is above ``total_s``."""

    zero_s: float = 20.0  # the guard answers at a SYNC, or when it has missed it for 10 s; then it ramps
    source_s: float = 6.0
    analysis_s: float = 8.0
    audit_s: float = 3.0
    store_s: float = 5.0

    @property
    def total_s(self) -> float:
        """Time after which the process ends in any case."""
        return float(sum(astuple(self))) + TEARDOWN_S


class Shutdown:
    """The end of one process, after ``total_s`` at the latest.

    ``leave`` ends it at once (``os._exit``); without it, an overdue step is only reported.
    """

    def __init__(self, total_s: float, leave: Callable[[int], object] | None = None) -> None:
        self.total_s = total_s
        self.overrun: list[str] = []
        self._leave = leave
        self._deadlines_s: dict[str, float] = {}
        self._limit: threading.Timer | None = None

    def start_deadline(self) -> None:
        """End the process after ``total_s``, whatever is still running."""
        if self._limit is None and self._leave is not None:
            self._limit = threading.Timer(self.total_s, self._exit_now)
            self._limit.daemon = True
            self._limit.start()

    async def run_step(self, what: str, work: Coroutine[Any, Any, Any], within_s: float, effect: str) -> None:
        """Run one step within its time, counted from its first start; else report it with its ``effect``."""
        now_s = asyncio.get_running_loop().time()
        deadline_s = self._deadlines_s.setdefault(what, now_s + within_s)
        task = asyncio.create_task(work, name=what)
        try:
            done, _ = await asyncio.wait([task], timeout=max(0.0, deadline_s - now_s))
        finally:
            task.cancel()
        if done:
            task.result()
        elif what not in self.overrun:
            self.overrun.append(what)
            service_log.write_line(
                f"stopping: {what} is not finished after {within_s:g} s and is abandoned; {effect}", "MAJOR"
            )

    def leave_overrun(self) -> None:
        """End the process now if a step was abandoned: its thread or task would block the event loop's end."""
        if self.overrun and self._leave is not None:
            self._leave(EXIT_CODE)

    def cancel_deadline(self) -> None:
        """Cancel the limit."""
        if self._limit is not None:
            self._limit.cancel()

    def _exit_now(self) -> None:
        with contextlib.suppress(Exception):  # nothing may prevent the exit
            service_log.write_line(f"not stopped after {self.total_s:g} s: the process ends now", "MAJOR")
        assert self._leave is not None
        self._leave(EXIT_CODE)
