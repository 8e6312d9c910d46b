"""Compiles kernels with numba: cached on disk between starts, run without the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compile_kernel(kernel: Kernel) -> Kernel:
    """Compile a function of plain numbers and arrays; it divides by zero as arrays do. ``py_func`` is its Python."""
    return cast(Kernel, njit(cache=True, nogil=True, error_model="numpy")(kernel))


def compile_inline_kernel(kernel: Kernel) -> Kernel:
    """Compile a function that is inlined into each kernel that calls it."""
    return cast(Kernel, njit(cache=True, nogil=True, error_model="numpy", inline="always")(kernel))
