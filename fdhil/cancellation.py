"""Ends tasks reliably, whatever they raise or swallow while they are cancelled.

A cancellation can get lost: a context manager raises its own error while closing, ``except*`` and the ``wait_for`` of
Python 3.11 drop it when a failure comes at the same moment, and a task group leaves ``cancelling()`` incremented. So a
loop that catches failures and retries never awaits what may fail in its own task.
"""

import asyncio
import time
from collections.abc import Coroutine, Iterable
from typing import Any, TypeVar

from fdhil.errors import DeviceError

END_S = 5.0
CANCEL_AGAIN_S = 2.5

Result = TypeVar("Result")


class GivenUp(DeviceError):
    """A library cancelled its own task, without any request to do so."""


async def run_attempt(device: str, work: Coroutine[Any, Any, Result], end_s: float = END_S) -> Result:
    """Return the result of ``work`` or raise its error; always raises CancelledError when the caller is cancelled.

    ``work`` runs in its own task, which has ``end_s`` to end. GivenUp when something other than the caller cancelled
    it.
    """
    attempt = asyncio.create_task(work, name=f"attempt at {device}")
    try:
        await asyncio.wait([attempt])
    except asyncio.CancelledError:
        await end_tasks([attempt], end_s)
        raise
    if attempt.cancelled():
        raise GivenUp(device, "the library closed the connection; see the peer's log")
    return attempt.result()


def find_first_error(error: BaseException) -> BaseException:
    """Return the first error inside nested exception groups."""
    return find_first_error(error.exceptions[0]) if isinstance(error, BaseExceptionGroup) else error


async def end_tasks(
    tasks: Iterable[asyncio.Task[Any]], within_s: float, again_s: float = CANCEL_AGAIN_S
) -> set[asyncio.Task[Any]]:
    """Cancel tasks every ``again_s`` until they have ended; return those that still run after ``within_s``.

    Their exceptions are ignored. A cancellation of the caller is raised afterwards.
    """
    given = left = set(tasks)
    cancelled = False
    deadline_s = time.monotonic() + within_s
    while left and (left_s := deadline_s - time.monotonic()) > 0:
        for task in left:
            task.cancel()
        try:
            _, left = await asyncio.wait(left, timeout=min(again_s, left_s))
        except asyncio.CancelledError:
            cancelled = True
            left = {task for task in left if not task.done()}
    for task in given - left:
        if not task.cancelled():
            task.exception()  # asyncio would log it as never retrieved
    if cancelled:
        raise asyncio.CancelledError
    return left
