"""A retry loop ends when cancelled, whatever its attempt does with the cancellation."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from fdhil.cancellation import GivenUp, end_tasks, run_attempt
from fdhil.errors import ConnectError, DeviceError


class Attempt:
    """Waits until it is cancelled, and then acts as ``ends`` says."""

    def __init__(self, ends: str) -> None:
        self.ends, self.begun, self.release = ends, asyncio.Event(), asyncio.Event()
        self.cancellations = 0

    async def __call__(self) -> None:
        self.begun.set()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(asyncio.Event().wait())
        except asyncio.CancelledError:
            self.cancellations += 1
            if self.ends == "raises":
                raise ConnectError("can0", "went away") from None
            if self.ends == "os error":
                raise OSError("bad descriptor") from None
            if self.ends == "deaf once":
                await asyncio.shield(asyncio.Event().wait())
            while self.ends == "deaf" and not self.release.is_set():
                try:
                    await self.release.wait()
                except asyncio.CancelledError:
                    self.cancellations += 1
        if self.ends == "orderly":
            raise asyncio.CancelledError


async def retry_loop(attempt: Callable[[], Coroutine[Any, Any, None]], end_s: float) -> None:
    while True:
        try:
            await run_attempt("can0", attempt(), end_s)
        except (DeviceError, OSError):
            await asyncio.sleep(0)


@pytest.mark.parametrize("ends", ["orderly", "raises", "os error", "returns"])
async def test_loop_ends_at_first_cancellation_whatever_attempt_raises(ends: str) -> None:
    attempt = Attempt(ends)
    loop = asyncio.create_task(retry_loop(attempt, 60.0))
    await attempt.begun.wait()
    loop.cancel()
    await asyncio.wait([loop])
    assert (loop.cancelled(), attempt.cancellations) == (True, 1)


@pytest.mark.parametrize("ends", ["deaf once", "deaf"])
async def test_loop_ends_when_attempt_swallows_cancellation(ends: str) -> None:
    attempt = Attempt(ends)
    loop = asyncio.create_task(retry_loop(attempt, 0.02))
    await attempt.begun.wait()
    loop.cancel()
    await asyncio.wait([loop])
    assert loop.cancelled()
    attempt.release.set()


async def test_task_group_failure_is_not_a_cancellation() -> None:
    async def raise_failure() -> None:
        raise ConnectError("can0", "went away")

    async def run_group() -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(raise_failure())

    for _ in range(2):  # the first leaves the count of cancellations raised in Python 3.11
        with pytest.raises(ExceptionGroup):
            await run_attempt("can0", run_group())


async def test_attempt_cancelled_by_library_is_retried() -> None:
    async def cancel_itself() -> None:
        raise asyncio.CancelledError

    with pytest.raises(GivenUp, match="library closed the connection"):
        await run_attempt("can0", cancel_itself())


async def test_result_is_returned_and_errors_are_raised_unchanged() -> None:
    async def return_result(error: Exception | None = None) -> int:
        if error:
            raise error
        return 7

    assert await run_attempt("can0", return_result()) == 7
    with pytest.raises(ConnectError):
        await run_attempt("can0", return_result(ConnectError("can0", "went away")))


async def test_task_that_ignores_cancellation_is_cancelled_again() -> None:
    attempt = Attempt("deaf once")
    task = asyncio.create_task(attempt())
    await attempt.begun.wait()
    assert await end_tasks([task], 60.0, 0.01) == set()
    assert task.cancelled()


async def test_unfinished_tasks_are_returned() -> None:
    attempt = Attempt("deaf")
    task = asyncio.create_task(attempt())
    await attempt.begun.wait()
    assert await end_tasks([task], 0.02, 0.01) == {task}
    attempt.release.set()
    await asyncio.wait([task])


async def test_second_cancellation_does_not_end_the_wait_for_the_first() -> None:
    attempt = Attempt("deaf")
    loop = asyncio.create_task(retry_loop(attempt, 60.0))
    await attempt.begun.wait()
    for _ in range(2):
        loop.cancel()
        await asyncio.sleep(0.01)
    assert not loop.done()
    attempt.release.set()
    await asyncio.wait([loop])
    assert loop.cancelled()
