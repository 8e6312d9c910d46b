"""Asks the kernel for what keeps a cycle in time: a real-time priority for the thread, memory that is not paged out."""

from __future__ import annotations

import contextlib
import ctypes
import os

PRIORITY = 50  # below the kernel's own interrupt threads of a real-time kernel, above all ordinary work
_MCL_CURRENT, _MCL_FUTURE = 1, 2


def prioritise() -> str:
    """Give the calling thread a real-time priority and return how it is scheduled now."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        return f"SCHED_FIFO {PRIORITY}"
    return "SCHED_OTHER"


def lock_memory() -> bool:
    """Keep the process' memory, also what it will have, from being paged out; whether the kernel does."""
    libc = ctypes.CDLL(None, use_errno=True)
    return bool(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0)
