"""Runs a blocking call in a thread of its own.

All threads of asyncio's pool may be waiting for a disk, and a disarm must not wait for them.
"""

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


async def run_in_dedicated_thread(
    call: Callable[Arguments, Result], *given: Arguments.args, **named: Arguments.kwargs
) -> Result:
    """Return the result of a call; the call continues if this is cancelled."""
    thread = ThreadPoolExecutor(1, "call")
    try:
        return await asyncio.get_running_loop().run_in_executor(thread, functools.partial(call, *given, **named))
    finally:
        thread.shutdown(wait=False)
