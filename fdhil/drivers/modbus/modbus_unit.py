"""Communicates with one Modbus unit, over TCP or over the serial line that it shares with others."""

from collections.abc import Mapping

from fdhil.config import ModbusDevice
from fdhil.drivers.modbus.line_registry import get_line
from fdhil.drivers.modbus.modbus_line import BUSY, DamagedAnswer, ModbusAnswer, ModbusLine, ModbusRefused, ModbusRequest
from fdhil.drivers.modbus.rtu_frames import READ_INPUT, WRITE_REGISTER
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout

PLAUSIBLE_C = (-50.0, 150.0)  # of a slide-way; NaN fails the comparison, too


class ModbusUnit:
    """A connection to one unit; ``name`` is used in messages. ``line`` is shared with others on the same device.

    ``asked_ns`` and ``answered_ns`` enclose the time at which the unit last read its registers.
    """

    wire = "modbus"

    def __init__(self, name: str, place: ModbusDevice) -> None:
        self.name = name
        self.line: ModbusLine = get_line(place)
        self.place = f"{self.line.place}, unit {place.unit}" if place.device else self.line.place
        self._unit = place.unit
        self._timeout_s = place.timeout_s
        self.asked_ns = self.answered_ns = 0

    @property
    def fault_counts(self) -> Mapping[str, int]:
        """Recovered faults of the line by code, for all its users."""
        return self.line.fault_counts

    async def connect(self) -> None:
        self.line.users.add(self)
        await self.line.connect(self.name, self._timeout_s)

    @property
    def is_connected(self) -> bool:
        return self in self.line.users and self.line.is_connected

    async def read_input_registers(self, address: int, count: int) -> list[int]:
        """Read ``count`` <= 125 input registers with one request (so that no value is torn between two)."""
        return await self.read_registers(READ_INPUT, address, count)

    async def read_registers(self, function: int, address: int, count: int) -> list[int]:
        """Read ``count`` <= 125 registers with one request: input registers by function 4, holding ones by 3.

        Or ``count`` <= 2000 bits, each 0 or 1: coils by function 1, discrete inputs by 2.
        """
        return list((await self._send_request(function, address, count)).registers)

    async def write_register(self, address: int, value: int) -> None:
        await self._send_request(WRITE_REGISTER, address, value)

    async def _send_request(self, function: int, address: int, value: int) -> ModbusAnswer:
        request = ModbusRequest(self.name, self._unit, function, address, value, self._timeout_s)
        answer = await self.line.send_request(request)
        self.asked_ns, self.answered_ns = answer.asked_ns, answer.answered_ns
        return answer

    def classify_fault(self, error: DeviceError) -> str | None:
        """Return the notice code of ``error``; None for a unit that is only busy."""
        if isinstance(error, ModbusRefused):
            return None if error.code == BUSY else "ModbusException"
        if isinstance(error, DamagedAnswer):
            return error.kind
        if isinstance(error, DeviceTimeout):
            return "ModbusTimeout"
        return "ModbusPortGone" if isinstance(error, ConnectError) else "ModbusShape"

    def close(self) -> None:
        """Close the connection, where no other sensor uses the line."""
        self.line.users.discard(self)
        if not self.line.users:
            self.line.close()
