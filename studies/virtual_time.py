"""Time that passes only by being waited for: days of time-outs are heard out in minutes, to the same bits."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop whose clock jumps to whatever is waited for next; nothing in it may wait for the outside."""

    def __init__(self) -> None:
        super().__init__(_Jumping(self))
        self.now_s = 1000.0

    def time(self) -> float:
        """The virtual time, s."""
        return self.now_s

    def monotonic_ns(self) -> int:
        """Stand in for ``time.monotonic_ns``."""
        return round(self.now_s * 1e9)


class _Jumping(selectors.DefaultSelector):
    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> Any:
        self._loop.now_s += max(timeout or 0.0, 0.0)
        return super().select(0)


def run(main: Coroutine[Any, Any, Any], loop: VirtualLoop) -> Any:
    """Run a coroutine to its end in virtual time."""
    try:
        return loop.run_until_complete(main)
    finally:
        loop.close()
