"""Asks a Modbus TCP unit through pymodbus: one request at a time, our own deadline, one error per fault.

pymodbus repeats a request by itself (12 s of silence by default), logs every fault at ERROR and closes the line after
a few silent requests; none of it suits a sensor that is asked 20 times a second, so ``retries`` is 0 and its logger is
quiet, and what an answer must be is checked here.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import Awaitable, Sequence

from pymodbus import ModbusException
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.pdu import ModbusPDU

from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError

PLAUSIBLE_C = (-50.0, 150.0)  # of a slide-way; NaN is outside, too
BUSY = 6
CONNECT_S = 2.0  # beyond the time an answer may take: the library has one time-out for both, and ours is the shorter
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal register address",
    3: "illegal value",
    4: "device failure",
    5: "acknowledge",
    6: "busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not answer",
}

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class ModbusRefused(ProtocolError):
    """The unit answered with an exception; ``code`` is its number."""

    def __init__(self, device: str, message: str, code: int) -> None:
        self.code = code
        super().__init__(device, message)


def float32(registers: Sequence[int], at: int = 0) -> float:
    """Return the big-endian float32 in two registers.

    >>> float32([0x4248, 0x0000])
    50.0
    """
    return float(struct.unpack(">f", struct.pack(">HH", *registers[at : at + 2]))[0])


def uint32(registers: Sequence[int], at: int = 0) -> int:
    """Return the big-endian unsigned integer in two registers."""
    return registers[at] << 16 | registers[at + 1]


class ModbusLink:
    """A connection to one unit; ``name`` is used in messages."""

    wire = "modbus"

    def __init__(self, name: str, host: str, port: int, unit: int, timeout_s: float) -> None:
        self.name = name
        self._host, self._port = host, port
        self._where = f"{host}:{port}"
        self.place = f"Modbus {host}:{port}"
        self._unit = unit
        self._timeout_s = timeout_s
        self._client: AsyncModbusTcpClient | None = None

    async def connect(self) -> None:
        """Connect anew; ConnectError when nobody answers there."""
        self.close()
        connected = False
        self._client = AsyncModbusTcpClient(
            self._host, port=self._port, timeout=self._timeout_s + CONNECT_S, retries=0, reconnect_delay=0
        )
        try:
            async with asyncio.timeout(self._timeout_s + CONNECT_S):
                connected = await self._client.connect()
        except TimeoutError:
            pass
        if not connected:
            text = f"the Modbus sensor {self._where} cannot be reached; check its supply, host and port"
            raise ConnectError(self.name, text)

    @property
    def connected(self) -> bool:
        """Whether the TCP connection stands."""
        return self._client is not None and bool(self._client.connected)

    def _open(self) -> AsyncModbusTcpClient:
        if self._client is None:
            raise ConnectError(self.name, f"the Modbus sensor {self._where} is not connected; connect first")
        return self._client

    async def read_input(self, address: int, count: int) -> list[int]:
        """Read ``count`` <= 125 input registers with one request (so that no value is torn between two)."""
        answer = await self._request(
            self._open().read_input_registers(address, count=count, device_id=self._unit), address
        )
        registers = list(answer.registers)
        if len(registers) != count:
            text = f"{len(registers)} registers came for {count} asked; check that one client asks at a time"
            raise ProtocolError(self.name, text)
        return registers

    async def write(self, address: int, value: int) -> None:
        """Write one holding register."""
        await self._request(self._open().write_register(address, value, device_id=self._unit), address)

    async def _request(self, call: Awaitable[ModbusPDU], address: int) -> ModbusPDU:
        try:
            async with asyncio.timeout(self._timeout_s):
                answer = await call
        except TimeoutError:
            raise self._silent(address) from None
        except ModbusException as error:
            if not self.connected:
                text = f"the connection to the Modbus sensor {self._where} is gone; check its supply and cable"
                raise ConnectError(self.name, text) from error
            raise self._silent(address) from error
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            # the library waits by wait_for, which in Python 3.11 forgets a cancellation that meets the answer
            raise asyncio.CancelledError
        if answer.isError():
            code = int(answer.exception_code)
            what = EXCEPTIONS.get(code, f"exception {code}")
            raise ModbusRefused(
                self.name, f"register {address} is refused ({what}); compare the register map with the config", code
            )
        return answer

    def fault_code(self, error: DeviceError) -> str | None:
        """Return the class under which ``error`` is told; None for a unit that is only busy."""
        if isinstance(error, ModbusRefused):
            return None if error.code == BUSY else "ModbusException"
        if isinstance(error, DeviceTimeout):
            return "ModbusTimeout"
        return "ModbusPortGone" if isinstance(error, ConnectError) else "ModbusShape"

    def _silent(self, address: int) -> DeviceError:
        # a late answer must not be taken for the next one's: the connection is made anew
        self.close()
        return DeviceTimeout(
            self.name,
            f"register {address} was not answered within {self._timeout_s:g} s; check the sensor and its line",
        )

    def close(self) -> None:
        """End the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None
