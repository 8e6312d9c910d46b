"""Reads an instrument that sends its value in lines of text over a serial line: on request, or by itself."""

import re
import time

from fdhil.config import MachineConfig, SerialDevice, Thermometer, Voltage
from fdhil.drivers.meter_voltage import MeterVoltage
from fdhil.drivers.serial.serial_port import SerialPort
from fdhil.drivers.serial.text_lines import LineReader
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError

FIRST_NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
SHOWN = 40  # characters of a line in a message


class InstrumentLine:
    """The serial line to one device; ``name`` is used in messages."""

    wire = "serial"
    timeout_code = "SerialTimeout"

    def __init__(self, name: str, place: SerialDevice) -> None:
        self.name = name
        self.place = f"serial line {place.device}"
        self.port = SerialPort(place)

    @property
    def is_connected(self) -> bool:
        return self.port.is_open

    async def connect(self) -> None:
        self.port.open(self.name)

    def classify_fault(self, error: DeviceError) -> str | None:
        if isinstance(error, DeviceTimeout):
            return self.timeout_code
        return "SerialPortGone" if isinstance(error, ConnectError) else "SerialShape"

    def close(self) -> None:
        self.port.close()


class TextMeter:
    """One number of an instrument's line."""

    def __init__(self, name: str, settings: Voltage | Thermometer) -> None:
        self.name = name
        self.link = InstrumentLine(name, settings)
        self._lines = LineReader(self.link.port, name)
        self._text = settings
        self._number = re.compile(settings.pattern or FIRST_NUMBER)
        self.is_free_running = not settings.query
        self._wait_s = settings.timeout_s + (settings.period_s if self.is_free_running else 0.0)
        self.asked_ns = self.answered_ns = 0
        self._line = ""

    async def read_value(self) -> float:
        """Return the next number, scaled; DeviceTimeout, ConnectError, ProtocolError for a line without one."""
        asked_ns = self._send_query() if self._text.query else 0
        line = await self._lines.read_line(time.monotonic_ns() + round(self._wait_s * 1e9))
        if line is None:
            what = f"{self._text.query.strip()!r} was not answered" if self._text.query else "no line came"
            text = f"{what} within {self._wait_s:g} s; check the instrument, the baud rate and the line's end"
            raise DeviceTimeout(self.name, text)
        self.answered_ns = line.t_ns - self.link.port.compute_wire_ns(len(line.text) + 1)
        self.asked_ns = min(asked_ns or self.answered_ns, self.answered_ns)
        return self._parse_number(line.text)

    def _send_query(self) -> int:
        """Send the query and return when it was through; an answer that came too late is discarded before."""
        query = self._text.query.encode()
        self._lines.discard_lines()
        return self.link.port.send(self.name, query) + self.link.port.compute_wire_ns(len(query))

    def _parse_number(self, line: str) -> float:
        self._line = line
        found = self._number.search(line)
        try:
            raw = float(found[1]) if found else None
        except (ValueError, TypeError):
            raw = None
        if raw is None:
            text = f"the line {line[:SHOWN]!r} has no number where pattern looks for it; compare pattern and baud_rate"
            raise ProtocolError(self.name, text)
        return self._text.scale * raw + self._text.offset

    def describe_implausible(self, shown: str) -> str:
        return f"the line {self._line[:SHOWN]!r} gives {shown}; compare pattern, scale and unit with the instrument"


def create_serial_voltage(axis: str, config: MachineConfig) -> MeterVoltage:
    return MeterVoltage(axis, config, TextMeter(f"voltage sensor {axis}", config.axis[axis].voltage))
