"""Keep a cycle on time: real-time priority for its thread, locked memory, no garbage collection."""

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator

CYCLE_PRIORITY = 50  # that of a real-time kernel's interrupt threads, above all ordinary work
BESIDE = 45  # the process's other threads: one that holds the interpreter lock must be able to run
SWITCH_INTERVAL_S = 0.0002  # the cycle must not wait the default 5 ms for an observing thread
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # on fault: untouched reservations use no memory


def set_realtime_priority(priority: int) -> str:
    """Give the calling thread, and those that it starts, a real-time priority; return the resulting scheduling."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return f"SCHED_FIFO {priority}"
    return "SCHED_OTHER"


@contextlib.contextmanager
def lock_realtime_resources() -> Iterator[None]:
    """Avoid delays by other processes, paging and garbage collection while this lasts.

    Existing objects stay in memory and are not scanned by the collector; new threads have a real-time priority and get
    the interpreter quickly.
    """
    libc, interval_s = ctypes.CDLL(None, use_errno=True), sys.getswitchinterval()
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    gc.collect()
    gc.freeze()
    libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    set_realtime_priority(BESIDE)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, policy, parameter)
        sys.setswitchinterval(interval_s)
        libc.munlockall()
