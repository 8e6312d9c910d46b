"""Communicates with one Modbus unit, over TCP or over the serial line that it shares with others."""

from collections.abc import Mapping

from fdhil.config.sensors import ModbusPlace
from fdhil.drivers.modbus.line import BUSY, Answer, DamagedAnswer, Line, ModbusRefused, Request
from fdhil.drivers.modbus.lines import line_to
from fdhil.drivers.modbus.rtu import READ_INPUT, WRITE_REGISTER
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout

PLAUSIBLE_C = (-50.0, 150.0)  # of a slide-way; NaN fails the comparison, too


class ModbusLink:
    """A connection to one unit; ``name`` is used in messages. ``line`` is shared with others on the same device.

    ``asked_ns`` and ``answered_ns`` enclose the time at which the unit last read its registers.
    """

    wire = "modbus"

    def __init__(self, name: str, place: ModbusPlace) -> None:
        self.name = name
        self.line: Line = line_to(place)
        self.place = f"{self.line.place}, unit {place.unit}" if place.device else self.line.place
        self._unit = place.unit
        self._timeout_s = place.timeout_s
        self.asked_ns = self.answered_ns = 0

    @property
    def counted(self) -> Mapping[str, int]:
        """Recovered faults of the line by code, for all its users."""
        return self.line.counted

    async def connect(self) -> None:
        self.line.users.add(self)
        await self.line.connect(self.name, self._timeout_s)

    @property
    def connected(self) -> bool:
        return self in self.line.users and self.line.connected

    async def read_input(self, address: int, count: int) -> list[int]:
        """Read ``count`` <= 125 input registers with one request (so that no value is torn between two)."""
        return await self.read(READ_INPUT, address, count)

    async def read(self, function: int, address: int, count: int) -> list[int]:
        """Read ``count`` <= 125 registers with one request: input registers by function 4, holding ones by 3.

        Or ``count`` <= 2000 bits, each 0 or 1: coils by function 1, discrete inputs by 2.
        """
        return list((await self._ask(function, address, count)).registers)

    async def write(self, address: int, value: int) -> None:
        await self._ask(WRITE_REGISTER, address, value)

    async def _ask(self, function: int, address: int, value: int) -> Answer:
        request = Request(self.name, self._unit, function, address, value, self._timeout_s)
        answer = await self.line.ask(request)
        self.asked_ns, self.answered_ns = answer.asked_ns, answer.answered_ns
        return answer

    def fault_code(self, error: DeviceError) -> str | None:
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
