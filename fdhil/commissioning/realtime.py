"""Asks the kernel for what keeps a cycle in time: a real-time priority for the thread, memory that is not paged out."""

from __future__ import annotations

import contextlib
import ctypes
import os

CYCLE = 50  # as the interrupt threads of a real-time kernel have it, above all ordinary work
BESIDE = 45  # the other threads of its process: the cycle waits for one that holds the interpreter and may not run
_MCL_CURRENT, _MCL_FUTURE = 1, 2


def prioritise(priority: int) -> str:
    """Give the calling thread, and those that it starts, a real-time priority; return how it is scheduled now."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return f"SCHED_FIFO {priority}"
    return "SCHED_OTHER"


def lock_memory() -> bool:
    """Keep the process' memory, also what it will have, from being paged out; whether the kernel does."""
    libc = ctypes.CDLL(None, use_errno=True)
    return bool(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0)
