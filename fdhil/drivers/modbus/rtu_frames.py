"""Builds and recognises Modbus RTU frames. Pure.

Source: MODBUS over serial line, specification and implementation guide V1.02, 2.5.1.
"""

import struct

from pymodbus.framer import FramerRTU

READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT, WRITE_REGISTER = 1, 2, 3, 4, 6
ERROR = 0x80
BIT_READS = (READ_COILS, READ_DISCRETE)
_READS = (*BIT_READS, READ_HOLDING, READ_INPUT)
_ECHO_BYTES, _EXCEPTION_BYTES, _LEAST_BYTES = 8, 5, 5


def compute_crc16(data: bytes) -> int:
    """Return the checksum, its low byte in the upper half; over a frame with its checksum it is 0.

    >>> hex(compute_crc16(bytes.fromhex("01 04 00 00 00 02")))
    '0x71cb'
    """
    return FramerRTU.compute_CRC(data)


def build_frame(unit: int, body: bytes) -> bytes:
    """Return a frame: unit, function and data, checksum with its low byte first."""
    frame = bytes([unit]) + body
    return frame + struct.pack(">H", compute_crc16(frame))


def count_data_bytes(function: int, count: int) -> int:
    """Return the bytes that ``count`` bits or registers take in an answer.

    >>> count_data_bytes(READ_COILS, 9), count_data_bytes(READ_INPUT, 9)
    (2, 18)
    """
    return (count + 7) // 8 if function in BIT_READS else 2 * count


def unpack_values(data: bytes, function: int, count: int) -> tuple[int, ...]:
    """Unpack the bits (0 or 1) or the registers of an answer's data.

    >>> unpack_values(bytes([0b101]), READ_COILS, 3)
    (1, 0, 1)
    """
    if function in BIT_READS:
        return tuple(data[place // 8] >> place % 8 & 1 for place in range(count))
    return struct.unpack(f">{count}H", data)


def count_answer_bytes(function: int, count: int) -> int:
    """Return the length of the answer to a request for ``count`` bits or registers, or to a write."""
    return 5 + count_data_bytes(function, count) if function in _READS else _ECHO_BYTES


def find_answer(data: bytes, unit: int, function: int, count: int) -> bytes | None:
    """Return function and data of the unit's answer, wherever it begins; None while it is incomplete.

    It may follow the echo of the request, or the noise of a driver that is switched on.
    """
    wanted = count_answer_bytes(function, count)
    at = -1
    while 0 <= (at := data.find(unit, at + 1)) <= len(data) - _EXCEPTION_BYTES:
        refused = data[at : at + _EXCEPTION_BYTES]
        if refused[1] == function | ERROR and not compute_crc16(refused):
            return refused[1:-2]
        frame = data[at : at + wanted]
        fits = function not in _READS or frame[2] == count_data_bytes(function, count)
        if len(frame) == wanted and frame[1] == function and fits and not compute_crc16(frame):
            return frame[1:-2]
    return None


def is_damaged(data: bytes, unit: int, function: int, count: int) -> bool:
    """Return whether bytes without an answer are a damaged one, so that no other will come.

    Less than a whole frame may be noise, with the answer still to come.
    """
    if _is_whole_frame(data):
        return data[0] == unit
    begin = bytes([unit, function, count_data_bytes(function, count)] if function in _READS else [unit, function])
    return data.startswith(begin) and len(data) >= count_answer_bytes(function, count)


def classify_fault(data: bytes, unit: int, function: int, count: int) -> tuple[str, str]:
    """Return notice code and description of the fault in bytes without an answer."""
    whole = _is_whole_frame(data)
    if whole and data[0] != unit:
        return "ModbusUnit", describe_foreign_unit(data[0], unit)
    wanted = count_data_bytes(function, count)
    if whole and data[1] == function and function in _READS and data[2] != wanted:
        return "ModbusShape", f"{data[2]} bytes came instead of {wanted}; check that only one client sends requests"
    if len(data) >= count_answer_bytes(function, count) and data[:2] == bytes([unit, function]):
        return "ModbusCrc", "a damaged answer came; check shield, termination and the baud rate of the line"
    text = (
        f"{len(data)} bytes came that are not an answer; check baud rate, parity and that only one client "
        "sends requests"
    )
    return "ModbusShape", text


def describe_foreign_unit(answering: int, asked: int) -> str:
    text = f"unit {answering} answered instead of unit {asked}; set unit = {answering}"
    return f"{text} if that is the device, or check that no two have the same number"


def _is_whole_frame(data: bytes) -> bool:
    if len(data) < _LEAST_BYTES:
        return False
    size = 5 + data[2] if data[1] in _READS else _EXCEPTION_BYTES if data[1] & ERROR else _ECHO_BYTES
    return len(data) == size and not compute_crc16(data)
