"""Builds the answers of a simulated Modbus unit, over TCP and serial lines alike, and applies their faults. Pure.

Source: MODBUS application protocol V1.1b3, 6.3, 6.4, 6.6, 6.12 and 7.
"""

import struct
from collections.abc import Callable, Mapping
from random import Random

from fdhil.sim.wire.register_maps import RegisterMap
from fdhil.sim.wire.sensor_faults import SensorFaults

_READS, _WRITE, _WRITE_SEVERAL = (3, 4), 6, 16
_MOST_REGISTERS = 125
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3

Seal = Callable[[int, bytes], bytes]
"""Return the frame of a unit's answer on the wire."""


def answer_request(registers: RegisterMap, faults: SensorFaults, body: bytes) -> bytes:
    """Return function and data of the answer to a request's function and data."""
    function = body[0]
    if faults.exception:
        return _build_exception(function, faults.exception)
    if function not in (*_READS, _WRITE, _WRITE_SEVERAL):
        return _build_exception(function, _ILLEGAL_FUNCTION)
    if len(body) < 5:
        return _build_exception(function, _ILLEGAL_VALUE)
    address, value = struct.unpack(">HH", body[1:5])
    if function in _READS:
        return _answer_read(registers, function, address, value)
    if address != registers.trigger or (function == _WRITE_SEVERAL and value != 1):
        return _build_exception(function, _ILLEGAL_ADDRESS)
    if body[-2:] != b"\0\1":
        return _build_exception(function, _ILLEGAL_VALUE)
    registers.latch_samples()
    return body[:5]


def _answer_read(registers: RegisterMap, function: int, address: int, count: int) -> bytes:
    if not 1 <= count <= _MOST_REGISTERS:
        return _build_exception(function, _ILLEGAL_VALUE)
    words = registers.list_words()
    if any(at not in words for at in range(address, address + count)):
        return _build_exception(function, _ILLEGAL_ADDRESS)
    wanted = [words[at] for at in range(address, address + count)]
    return struct.pack(f">BB{count}H", function, 2 * count, *wanted)


def _build_exception(function: int, code: int) -> bytes:
    return bytes([function | 0x80, code])


def apply_answer_faults(faults: SensorFaults, seal: Seal, unit: int, body: bytes) -> list[bytes]:
    """Return the pieces of an answer, to be sent with a pause between them; [] for no answer."""
    before, faults.before = faults.before, (seal, unit, body)
    if faults.silent:
        return []
    kinds = [kind for kind, percent in faults.answers.items() if 100 * faults.draw.random() < percent]
    for kind in (kind for kind in kinds if kind in _CONTENT):
        unit, body = _CONTENT[kind](unit, body, before[2] if before else body)
    pieces = [seal(unit, body)]
    for kind in (kind for kind in kinds if kind in _FRAME):
        pieces = [*pieces[:-1], *_FRAME[kind](pieces[-1], faults.draw)]
    if before is not None and "stale" in kinds:
        seal_before, unit_before, body_before = before
        pieces = [seal_before(unit_before, body_before), *pieces]
    return pieces


def _tear_answer(unit: int, body: bytes, before: bytes) -> tuple[int, bytes]:
    """Take every second register from the previous answer: the words of a number are of two instants."""
    if body[0] not in _READS or len(before) != len(body):
        return unit, body
    words = [before[at : at + 2] if at // 2 % 2 else body[at : at + 2] for at in range(2, len(body), 2)]
    return unit, body[:2] + b"".join(words)


def _add_register(unit: int, body: bytes, _before: bytes) -> tuple[int, bytes]:
    return (unit, bytes([body[0], body[1] + 2]) + body[2:] + b"\0\1") if body[0] in _READS else (unit, body)


def _flip_bit(frame: bytes, draw: Random) -> list[bytes]:
    bit = draw.randrange(8 * len(frame))
    return [bytes(byte ^ (1 << bit % 8 if at == bit // 8 else 0) for at, byte in enumerate(frame))]


_CONTENT: Mapping[str, Callable[[int, bytes, bytes], tuple[int, bytes]]] = {
    "wrong_unit": lambda unit, body, _before: (unit % 247 + 1, body),
    "torn": _tear_answer,
    "too_many": _add_register,
}
_FRAME: Mapping[str, Callable[[bytes, Random], list[bytes]]] = {
    "flipped": _flip_bit,
    "short": lambda frame, _draw: [frame[:-3]],
    "noisy": lambda frame, draw: [draw.randbytes(draw.randint(1, 6)) + frame],
    "split": lambda frame, _draw: [frame[: len(frame) // 2], frame[len(frame) // 2 :]],
}
ANSWER_FAULTS = (*_CONTENT, *_FRAME, "stale")
"""The faults of answers by name."""
