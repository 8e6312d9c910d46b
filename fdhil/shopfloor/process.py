"""Runs one process of a network: until SIGTERM or Ctrl-C, with a line and a word to systemd when it is ready."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import Awaitable, Callable
from typing import TypeVar

from fdhil.daemon import heap, journal
from fdhil.daemon.notify import notify

C = TypeVar("C")


def run(publisher: Callable[[C], Awaitable[None]], config: C) -> None:
    """Publish until it is told to stop. FdhilError when it cannot start."""
    heap.keep_small()
    asyncio.run(_until_told_to_stop(publisher, config))


async def _until_told_to_stop(publisher: Callable[[C], Awaitable[None]], config: C) -> None:
    publishing = asyncio.ensure_future(publisher(config))
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, publishing.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await publishing


def say_ready(text: str) -> None:
    """Tell the log and systemd that it serves; ``text`` says what and where, the address last."""
    journal.write_line(text)
    notify(f"READY=1\nSTATUS={text}")
