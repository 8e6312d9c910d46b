"""Asks the kernel for what keeps a cycle in time: a real-time priority for the thread, memory that is not paged out."""

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator

CYCLE = 50  # as the interrupt threads of a real-time kernel have it, above all ordinary work
BESIDE = 45  # the other threads of its process: the cycle waits for one that holds the interpreter and may not run
SWITCH_INTERVAL_S = 0.0002  # the cycle must not wait 5 ms for a thread that only looks on
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # on fault: what is reserved and never touched takes no memory


def prioritise(priority: int) -> str:
    """Give the calling thread, and those that it starts, a real-time priority; return how it is scheduled now."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return f"SCHED_FIFO {priority}"
    return "SCHED_OTHER"


@contextlib.contextmanager
def before_other_work() -> Iterator[None]:
    """For as long as it lasts nothing waits that need not: not for other processes, memory, or the collector.

    What is there now stays in memory and is not looked at by the collector; threads that are started have a real-time
    priority, and get the interpreter soon.
    """
    libc, interval_s = ctypes.CDLL(None, use_errno=True), sys.getswitchinterval()
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    gc.collect()
    gc.freeze()
    libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    prioritise(BESIDE)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, policy, parameter)
        sys.setswitchinterval(interval_s)
        libc.munlockall()
