"""Compiles kernels on their first call and keeps them in numba's cache; their types stay what they say."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Return the kernel compiled: without the interpreter's lock, and dividing by zero as arrays do."""
    return cast("Kernel", njit(cache=True, nogil=True, error_model="numpy")(function))
