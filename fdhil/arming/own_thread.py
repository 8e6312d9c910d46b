"""Calls what blocks in a thread of its own.

Those of asyncio's pool may all wait for a disk, and a disarm must not wait behind them.
"""

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Said = TypeVar("Said")


async def in_own_thread(call: Callable[Given, Said], *given: Given.args, **named: Given.kwargs) -> Said:
    """Return what a call returns; it goes on where this is cancelled."""
    thread = ThreadPoolExecutor(1, "call")
    try:
        return await asyncio.get_running_loop().run_in_executor(thread, functools.partial(call, *given, **named))
    finally:
        thread.shutdown(wait=False)
