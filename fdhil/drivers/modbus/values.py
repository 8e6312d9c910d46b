"""Numbers in 16 bit registers. Pure."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fdhil.records import Float

WordOrder = Literal["big", "little"]
CODES = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f", "float64": ">d"}


def registers_of(kind: str) -> int:
    """Return how many registers one number takes.

    >>> registers_of("float64")
    4
    """
    return struct.calcsize(CODES[kind]) // 2


def numbers(registers: Sequence[int], kind: str, order: WordOrder = "big") -> Float:
    """Return the numbers (n,) of this type that the registers hold one after the other.

    >>> float(numbers([0x0000, 0x4248], "float32", "little")[0])
    50.0
    """
    words = np.array(registers, ">u2").reshape(-1, registers_of(kind))
    if order == "little":
        words = words[:, ::-1]
    return np.frombuffer(words.tobytes(), np.dtype(CODES[kind])).astype(np.float64)


def float32(registers: Sequence[int], at: int = 0) -> float:
    """Return the float32 in two registers, high word first.

    >>> float32([0x4248, 0x0000])
    50.0
    """
    return float(numbers(registers[at : at + 2], "float32")[0])


def uint32(registers: Sequence[int], at: int = 0) -> int:
    """Return the unsigned integer in two registers, high word first."""
    return registers[at] << 16 | registers[at + 1]
