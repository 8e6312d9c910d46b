"""Runs one publisher process until SIGTERM or Ctrl-C, and reports readiness to the log and systemd."""

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from fdhil.cancellation import end_tasks
from fdhil.daemon import Shutdown, limit_heap_growth, notify_systemd, write_line

C = TypeVar("C")
PUBLISHER_S = 12.0  # to close connections to peers that do not answer
STOP_S = 18.0  # below the TimeoutStopSec of the units


def run_publisher(publisher: Callable[[C], Coroutine[Any, Any, None]], config: C) -> None:
    """Publish until stopped. FdhilError when it cannot start."""
    limit_heap_growth()
    shutdown = Shutdown(STOP_S, os._exit)
    try:
        asyncio.run(_publish_until_stopped(publisher(config), shutdown))
    finally:
        shutdown.cancel_deadline()


async def _publish_until_stopped(publisher: Coroutine[Any, Any, None], shutdown: Shutdown) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    publishing, stopping = asyncio.create_task(publisher), asyncio.create_task(stop.wait())
    await asyncio.wait([publishing, stopping], return_when=asyncio.FIRST_COMPLETED)
    shutdown.start_deadline()
    if publishing.done():
        stopping.cancel()
        publishing.result()
    elif await end_tasks([publishing], PUBLISHER_S):
        write_line(f"stopping: the connection is not closed after {PUBLISHER_S:g} s and is abandoned", "minor")


def report_ready(text: str) -> None:
    """Report to the log and systemd that it serves; ``text`` names what and where, the address last."""
    write_line(text)
    notify_systemd(f"READY=1\nSTATUS={text}")
