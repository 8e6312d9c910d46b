"""A bounded child process: its reports are received, and it never outlives its caller."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import pytest

from fdhil.bounded_process import BoundedProcess

pytestmark = pytest.mark.usefixtures("processes")
CHILD = "tests.echo_process"


def has_ended(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


async def test_documents_are_passed_on_and_exit_code_returned() -> None:
    taken: list[dict[str, Any]] = []
    assert await BoundedProcess(CHILD).run({"then": "end"}, taken.append) == 0
    assert [told["request"] for told in taken] == [{"then": "end"}]


async def test_partial_line_of_failed_process_is_discarded() -> None:
    taken: list[dict[str, Any]] = []
    assert await BoundedProcess(CHILD).run({"then": "break off"}, taken.append) == 3
    assert len(taken) == 1


async def test_cancelled_run_ends_process() -> None:
    pids: list[int] = []
    begun = asyncio.Event()

    def receive_document(told: dict[str, Any]) -> None:
        pids.append(told["pid"])
        begun.set()

    running = asyncio.create_task(BoundedProcess(CHILD).run({"then": "hang"}, receive_document))
    await begun.wait()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    assert has_ended(pids[0])


async def test_process_killed_before_it_starts_does_not_run() -> None:
    process = BoundedProcess(CHILD)
    process.kill()
    assert await process.run({"then": "hang"}, lambda _: None) == -signal.SIGKILL


async def test_error_in_document_handler_ends_process() -> None:
    process = BoundedProcess(CHILD)

    def raise_error(told: dict[str, Any]) -> None:
        raise LookupError(told["pid"])

    with pytest.raises(LookupError):
        await process.run({"then": "hang"}, raise_error)
    assert process.pid is None
