"""The interface of a line to one or more Modbus units: requests, answers and faults."""

from collections import Counter
from collections.abc import MutableSet
from dataclasses import dataclass
from typing import Protocol

from fdhil.drivers.modbus.rtu_frames import WRITE_REGISTER
from fdhil.errors import DeviceTimeout, ProtocolError

BUSY = 6
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
ADVICE = {
    **dict.fromkeys((1, 2, 3), "compare the register map with the config"),
    **dict.fromkeys((5, 6), "poll it less often"),
    10: "check the gateway's own settings",
    11: "check unit, and the line behind the gateway",
}


class ModbusRefused(ProtocolError):
    """The unit answered with an exception; ``code`` is its number."""

    def __init__(self, device: str, address: int, code: int) -> None:
        self.code = code
        what = EXCEPTIONS.get(code, f"exception {code}")
        advice = ADVICE.get(code, "check the device itself")
        super().__init__(device, f"register {address} is refused ({what}); {advice}")


class DamagedAnswer(ProtocolError):
    """An invalid answer; ``kind`` is the notice code."""

    def __init__(self, device: str, kind: str, text: str) -> None:
        self.kind = kind
        super().__init__(device, text)


@dataclass(frozen=True, slots=True)
class ModbusRequest:
    """``value`` bits (functions 1, 2) or registers (3, 4) to read from ``address`` on, or the value to write (6)."""

    name: str
    unit: int
    function: int
    address: int
    value: int
    timeout_s: float

    @property
    def count(self) -> int:
        """Number of bits or registers in the answer."""
        return 0 if self.function == WRITE_REGISTER else self.value


@dataclass(frozen=True, slots=True)
class ModbusAnswer:
    """The registers of an answer, or its bits (0 or 1), read by the unit between ``asked_ns`` and ``answered_ns``
    (host-monotonic)."""

    registers: tuple[int, ...]
    asked_ns: int
    answered_ns: int


def make_timeout(request: ModbusRequest, advice: str = "check the device and its line") -> DeviceTimeout:
    """Return the error of a unit that did not answer."""
    text = f"register {request.address} was not answered within {request.timeout_s:g} s; {advice}"
    return DeviceTimeout(request.name, text)


class ModbusLine(Protocol):
    """A line to units: one request at a time, for any number of clients. ``users`` are the units that need the line;
    ``fault_counts`` counts recovered faults by code."""

    place: str
    users: MutableSet[object]
    fault_counts: Counter[str]

    @property
    def is_connected(self) -> bool:
        """Whether it is established."""

    async def connect(self, name: str, timeout_s: float) -> None:
        """Connect if not yet connected; ConnectError names the sensor ``name``."""

    async def send_request(self, request: ModbusRequest) -> ModbusAnswer:
        """Wait for the line, send the request and return the answer; DeviceError."""

    def close(self) -> None:
        """End the connection."""
