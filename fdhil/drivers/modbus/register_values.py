"""Decodes numbers in 16-bit registers. Pure."""

import itertools
import math
import struct
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fdhil.config import TableEncoder, Thermometer, Voltage
from fdhil.records import Float

WordOrder = Literal["big", "little"]
RegisterSensor = Voltage | Thermometer | TableEncoder
ORDERS: tuple[WordOrder, ...] = ("big", "little")
SMALLEST = 1e-30  # smaller floats have wrong words or type
LIKELY = (1e-6, 1e6)  # range of instruments, in their own unit
CODES = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f", "float64": ">d"}


def count_registers(kind: str) -> int:
    """Return the number of registers of one number.

    >>> count_registers("float64")
    4
    """
    return struct.calcsize(CODES[kind]) // 2


def decode_numbers(
    registers: Sequence[int], kind: str, word_order: WordOrder = "big", byte_order: WordOrder = "big"
) -> Float:
    """Decode consecutive numbers (n,) of this type.

    >>> float(decode_numbers([0x0000, 0x4248], "float32", "little")[0])
    50.0
    >>> float(decode_numbers([0x4842, 0x0000], "float32", byte_order="little")[0])
    50.0
    """
    words = np.array(registers, ">u2").reshape(-1, count_registers(kind))
    if byte_order == "little":
        words = words.byteswap()
    if word_order == "little":
        words = words[:, ::-1]
    return np.frombuffer(words.tobytes(), np.dtype(CODES[kind])).astype(np.float64)


def decode_float32(registers: Sequence[int], at: int = 0) -> float:
    """Decode the float32 in two registers, high word first.

    >>> decode_float32([0x4248, 0x0000])
    50.0
    """
    return float(decode_numbers(registers[at : at + 2], "float32")[0])


def decode_uint32(registers: Sequence[int], at: int = 0) -> int:
    """Decode the unsigned integer in two registers, high word first."""
    return registers[at] << 16 | registers[at + 1]


def describe_other_orders(registers: Sequence[int], kind: str, where: RegisterSensor, most: float = LIKELY[1]) -> str:
    """Describe, for a message, the first value in other word and byte orders.

    Only plausible values are named: 0, or between ``LIKELY[0]`` and ``most``, scaled.
    """
    found = []
    first = registers[: count_registers(kind)]
    for word_order, byte_order in itertools.product(ORDERS if count_registers(kind) > 1 else ORDERS[:1], ORDERS):
        if (word_order, byte_order) == (where.word_order, where.byte_order) or not first:
            continue
        raw = float(decode_numbers(first, kind, word_order, byte_order)[0])
        value = where.scale * raw + where.offset
        if math.isfinite(raw) and (raw == 0 or LIKELY[0] < abs(raw)) and abs(value) < most:
            given = ("word_order", word_order, where.word_order), ("byte_order", byte_order, where.byte_order)
            keys = " and ".join(f"{key} = {order!r}" for key, order, now in given if order != now)
            found.append(f"with {keys} it would be {value:g}")
    return f" ({', '.join(found)})" if found else ""
