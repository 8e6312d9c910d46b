"""Keeps the heap of a long-running process small: freed memory is returned to the system (glibc only).

By default glibc reacts to each freed large block by placing the next ones of that size among the small ones, where one
remaining small block pins all memory before it, and gives each thread a heap of its own.
"""

import ctypes
from contextlib import suppress

# numbers of mallopt(3), and glibc's initial sizes
MALLOPT = {"M_TRIM_THRESHOLD": (-1, 128 << 10), "M_MMAP_THRESHOLD": (-3, 128 << 10), "M_ARENA_MAX": (-8, 2)}


def limit_heap_growth() -> None:
    """Allocate large blocks separately, and limit all threads to two heaps; call before threads start."""
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        for name, value in MALLOPT.values():
            mallopt(name, value)


def trim_heap() -> None:
    """Return every free page between used blocks; takes some milliseconds, without Python's lock."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
