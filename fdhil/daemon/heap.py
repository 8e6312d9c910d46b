"""Keeps the heap of a process that runs for months small: freed memory goes back to the computer (glibc; else nothing).

By itself glibc takes each large block that was freed as a reason to lay the next ones of that size among the small
ones, where a small one that stays holds all before it, and gives each thread a heap of its own.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress

# what mallopt(3) calls them; the sizes are those that a process of glibc begins with
MALLOPT = {"M_TRIM_THRESHOLD": (-1, 128 << 10), "M_MMAP_THRESHOLD": (-3, 128 << 10), "M_ARENA_MAX": (-8, 2)}


def keep_small() -> None:
    """Lay large blocks apart, and all threads' blocks in two heaps; to be called before there are threads."""
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        for name, value in MALLOPT.values():
            mallopt(name, value)


def give_back() -> None:
    """Give back each page that lies free between blocks that are used; some milliseconds, without Python's lock."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
