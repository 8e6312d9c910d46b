"""Bytes on a serial line with Modbus RTU units: an answer or a declared error, never another unit's value."""

from __future__ import annotations

import time
from collections.abc import Coroutine, Sequence

from fdhil.config.sensor_sections import ModbusDevice
from fdhil.drivers.modbus.modbus_line import ModbusAnswer, ModbusRequest
from fdhil.drivers.modbus.rtu_frames import READ_COILS, READ_HOLDING, READ_INPUT, WRITE_REGISTER, build_frame
from fdhil.drivers.modbus.rtu_line import RtuLine
from fdhil.drivers.serial.byte_stream import Chunk
from fdhil.errors import DeviceError
from tests.fuzz.input_assessment import Target

FUNCTIONS = (READ_INPUT, READ_HOLDING, READ_COILS, WRITE_REGISTER)
PLACE = ModbusDevice(device="/dev/none")


class _Port:
    """Stands in for the port: delivers these pieces, then is silent."""

    is_open, last_ns, character_s = True, 0, 1e-4

    def __init__(self, pieces: Sequence[bytes]) -> None:
        self._pieces = list(pieces)

    def discard_input(self) -> bool:
        return False

    def compute_wire_ns(self, _count: int) -> int:
        return 0

    def send(self, _name: str, _data: bytes) -> int:
        return time.monotonic_ns()

    async def receive_chunk(self, _name: str, _until_ns: int) -> Chunk | None:
        return Chunk(self._pieces.pop(0), time.monotonic_ns()) if self._pieces else None


def _run_without_loop(asking: Coroutine[None, None, ModbusAnswer]) -> ModbusAnswer:
    """Run a coroutine that never waits, without a loop."""
    try:
        asking.send(None)
    except StopIteration as end:
        assert isinstance(end.value, ModbusAnswer)
        return end.value
    raise AssertionError("it waits, though all has come")


def taste(data: bytes) -> None:
    """Send the request in the first two bytes; receive the rest in pieces of the length in the third."""
    kind, count, size = (*data[:3], 0, 0, 0)[:3]
    request = ModbusRequest("sensor", 1 + kind % 3, FUNCTIONS[kind % 4], 100, 1 + count % 9, 0.0)
    came, size = data[3:], 1 + size
    line = RtuLine(PLACE)
    line._port, line.silence_s = _Port([came[k : k + size] for k in range(0, len(came), size)]), 0.0  # type: ignore[assignment] # stands for it
    try:
        answer = _run_without_loop(line.send_request(request))
    except DeviceError as error:
        assert len(str(error)) < 500
        return
    assert len(answer.registers) == request.count
    assert any(_contains_frame(came[k:], request.unit) for k in range(len(came)))


def _contains_frame(data: bytes, unit: int) -> bool:
    """Return whether some of the first 64 bytes are a frame, by the checksum of Modbus over serial line V1.02 6.2.2."""
    crc = 0xFFFF
    for size, byte in enumerate(data[:64] if data[0] == unit else b"", 1):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
        if crc == 0 and size >= 5:
            return True
    return False


def target() -> Target:
    read = build_frame(1, b"\x04\x02\x01\x00")
    seeds = [
        b"\0\0\xff" + read,
        b"\0\0\2" + b"\xff\xff" + read,
        b"\1\1\xff" + build_frame(2, b"\x03\x04" + bytes(4)),
        b"\2\7\xff" + build_frame(3, b"\x01\x01\x55"),
        b"\3\0\xff" + build_frame(1, b"\x06\x00\x64\x00\x01"),
        b"\0\0\xff" + build_frame(1, b"\x84\x02"),
        b"\0\0\xff" + build_frame(2, b"\x04\x02\x01\x00") + read,
    ]
    return Target("modbus_rtu", seeds, taste, [read, read[-2:], b"\x84\x02", b"\x01\x04"], 300)
