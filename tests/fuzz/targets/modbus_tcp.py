"""Answers of a Modbus TCP device: the requested values, or one declared error."""

from __future__ import annotations

import asyncio
from typing import Any

from pymodbus.client import AsyncModbusTcpClient

from fdhil.drivers.modbus.modbus_line import ModbusRequest
from fdhil.drivers.modbus.rtu_frames import READ_COILS, READ_HOLDING, READ_INPUT, WRITE_REGISTER
from fdhil.drivers.modbus.tcp_line import LIBRARYS_OWN_S, TcpLine, _end_wait_at_unreadable_bytes
from fdhil.errors import DeviceError
from tests.fuzz.input_assessment import Target

FUNCTIONS = (READ_INPUT, READ_HOLDING, READ_COILS, WRITE_REGISTER)
_LOOP = asyncio.new_event_loop()
_RAISED: list[Exception] = []
_LOOP.set_exception_handler(lambda _loop, told: _RAISED.append(told["exception"]))


class _Wire:
    """Stands in for the transport: every request is answered with these bytes."""

    def __init__(self, client: AsyncModbusTcpClient, answer: bytes) -> None:
        self._client, self._answer = client, answer

    def write(self, _data: bytes) -> None:
        cut = len(self._answer) // 2 if len(self._answer) % 3 == 0 else len(self._answer)
        for piece in (self._answer[:cut], self._answer[cut:]):
            if piece:
                asyncio.get_running_loop().call_soon(self._client.ctx.data_received, piece)

    def close(self) -> None:
        pass

    abort = close

    def get_extra_info(self, _name: str) -> Any:
        return None

    def is_closing(self) -> bool:
        return False


async def _send_request(data: bytes) -> None:
    kind, count = (*data[:2], 0, 0)[:2]
    request = ModbusRequest("sensor", 1, FUNCTIONS[kind % 4], 100, 1 + count % 9, 0.0)
    line = TcpLine("127.0.0.1", 502)
    client = AsyncModbusTcpClient("127.0.0.1", port=502, timeout=LIBRARYS_OWN_S, retries=0, reconnect_delay=0)
    client.ctx.transport = _Wire(client, data[2:])  # type: ignore[assignment] # stands for it
    _end_wait_at_unreadable_bytes(client)
    line._client = client
    try:
        answer = await line.send_request(request)
    except DeviceError as error:
        assert len(str(error)) < 500
    else:
        assert len(answer.registers) == request.count
        assert all(0 <= value <= 0xFFFF for value in answer.registers)
    line.close()


def taste(data: bytes) -> None:
    """Send the request in the first two bytes and receive the rest; exceptions of callbacks are in the log."""
    _RAISED.clear()
    _LOOP.run_until_complete(_send_request(data))
    if _RAISED:
        raise _RAISED[0]


def target() -> Target:
    head = b"\x00\x01\x00\x00"
    seeds = [
        b"\0\0" + head + b"\x00\x05\x01\x04\x02\x01\x00",
        b"\1\1" + head + b"\x00\x07\x01\x03\x04" + bytes(4),
        b"\2\7" + head + b"\x00\x04\x01\x01\x01\x55",
        b"\3\0" + head + b"\x00\x06\x01\x06\x00\x64\x00\x01",
        b"\0\0" + head + b"\x00\x03\x01\x84\x02",
        b"\0\0" + b"\x00\x09\x00\x00\x00\x03\x01\x84\x02" + head + b"\x00\x05\x01\x04\x02\x01\x00",
    ]
    return Target("modbus_tcp", seeds, taste, [head, b"\x01\x04", b"\x01\x84", b"\x00\x05"], 300)
