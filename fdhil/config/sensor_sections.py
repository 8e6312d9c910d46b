"""[axis.X.voltage], [axis.X.temperature]: separate sensors on Modbus (TCP or RTU) or on a serial line."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from fdhil import tables
from fdhil.config.section import Finite, NotNegative, Positive, Section, require_one_of

BAUD_RATES = (1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200, 230400, 460800, 921600)
ValueType = Literal["int16", "uint16", "int32", "uint32", "float32", "float64"]
NO_DEVICE = ""
LAST_UNIT = 247  # "MODBUS over serial line" 2.2; 248 to 255 are reserved


def _check_baud_rate(rate: int) -> int:
    if rate not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return rate


def _check_pattern(pattern: str) -> str:
    if not pattern:
        return pattern
    try:
        groups = re.compile(pattern).groups
    except re.error as error:
        raise ValueError(f"is not a regular expression ({error})") from None
    if groups != 1:
        raise ValueError("must have one group, around the number, as in 'U=([-+.0-9]+)'")
    return pattern


class SensorSource(Section):
    """The kind of sensor."""

    source: str = Field("modbus", description="modbus, serial")


class SerialDevice(Section):
    """A serial line and its settings."""

    device: str = Field(NO_DEVICE, description="the serial device, as /dev/ttyUSB0 or /dev/serial/by-id/...")
    baud_rate: Annotated[int, AfterValidator(_check_baud_rate)] = Field(
        19200, ge=BAUD_RATES[0], le=BAUD_RATES[-1], description="serial: bits per second"
    )
    parity: Literal["even", "odd", "none"] = Field(
        "even", description="serial: even for most Modbus devices, else none"
    )
    stop_bits: Literal[1, 2] = Field(1, description="serial: stop bits; Modbus uses 2 without parity")
    timeout_s: Positive = Field(0.5, ge=1e-3, le=60, description="longest time for an answer")


class ModbusDevice(SerialDevice):
    """A Modbus unit: RTU on a serial device, else TCP."""

    device: str = Field(NO_DEVICE, description="serial: device, as /dev/ttyUSB0, for RTU or text; left out: Modbus TCP")
    host: str = Field("127.0.0.1", description="modbus: address of the device")
    port: int = Field(0, ge=0, le=65535, description="modbus: TCP port; 0 lets the simulator choose one")
    framing: Literal["tcp", "rtu"] = Field(
        "tcp", description="modbus: rtu for a serial server that passes RTU frames over TCP"
    )
    unit: int = Field(1, ge=0, le=255, description="modbus: unit identifier; on a serial line 1 to 247")

    @property
    def is_rtu(self) -> bool:
        """Whether the units are on a serial line, also behind a serial server."""
        return bool(self.device) or self.framing == "rtu"

    @model_validator(mode="after")
    def _check_unit(self) -> ModbusDevice:
        if self.is_rtu and self.unit == 0:
            raise ValueError("unit: must be from 1 to 247 on a serial line; 0 is the broadcast, which no unit answers")
        return self


def describe_reserved_unit(path: str, place: ModbusDevice) -> str:
    """Return a sentence about a unit number that the standard reserves; empty for any other."""
    if not place.is_rtu or place.unit <= LAST_UNIT:
        return ""
    text = (
        f"{path}.unit = {place.unit} is outside 1 to {LAST_UNIT}, the numbers of units on a serial line: keep it only"
    )
    return f"{text} where the device's manual names it, and the device is alone on its line (as a PZEM-017 at 248)"


class ModbusValue(Section):
    """A value in the registers of a Modbus unit."""

    function: Literal[3, 4] = Field(4, description="modbus: 4 reads input registers, 3 holding registers")
    address: int = Field(0, ge=0, le=65535, description="modbus: first register, from 0 (register 30001 or 40001)")
    type: ValueType = Field("float32", description="modbus: int16, uint16, int32, uint32, float32, float64")
    word_order: Literal["big", "little"] = Field("big", description="modbus: big has the high word of a value first")
    byte_order: Literal["big", "little"] = Field(
        "big", description="modbus: order of the two bytes of each register; big is the standard, little is swapped"
    )


class TextValue(Section):
    """A number in a line of text of an instrument on a serial line."""

    query: str = Field(
        "", max_length=200, description="serial: query, as 'READ?\\n'; left out: it sends lines by itself"
    )
    pattern: Annotated[str, AfterValidator(_check_pattern)] = Field(
        "", description="serial: position of the value in a line, as 'U=([-+.0-9]+)'; left out: its first number"
    )


class LinearScale(Section):
    """Linear conversion from a reading to the unit of the key."""

    scale: Finite = Field(1.0, description="factor of the reading; negative where the wires are swapped")
    offset: Finite = Field(0.0, description="added after scaling")


def _check_scale(value: LinearScale) -> None:
    if value.scale == 0:
        raise ValueError("scale: must not be 0; give the amount of one count in the key's unit")


class VoltageBlock(Section):
    """[axis.X.voltage.block]: where a Modbus device keeps its newest samples by number: voltage.address is the first
    sample, voltage.type the type of each. Without this section a device shows one value, its newest."""

    samples: int = Field(32, ge=1, le=124, description="samples in the block")
    rate_hz: Positive = Field(1000.0, ge=0.1, le=1e6, description="samples per second")
    counter_address: int = Field(40, ge=0, le=65534, description="register of the sample count, near the block")
    counter_type: Literal["uint16", "uint32"] = Field("uint32", description="type of that count: uint16, uint32")
    counter_of: Literal["newest", "oldest"] = Field(
        "newest", description="newest: the count is the number of the block's newest sample; oldest: of its oldest"
    )
    count_address: int | None = Field(
        None, ge=0, le=65535, description="register of the number of samples; left out: always full"
    )
    newest_first: bool = Field(False, description="true if the block's first sample is its newest")
    trigger_address: int | None = Field(
        None, ge=0, le=65535, description="write 1 here to fill the block with new samples"
    )


_SAYS_WHERE = ("function", "address", "word_order", "byte_order", "block")


class Voltage(LinearScale, TextValue, ModbusValue, ModbusDevice, SensorSource):
    """[axis.X.voltage]: where the motor's terminal voltage comes from."""

    source: Annotated[str, require_one_of(tables.VOLTAGE_SOURCES)] = Field(
        tables.DRIVE_VOLTAGE,
        description=f"{', '.join(tables.VOLTAGE_SOURCES)}; drive: a vendor object in a TPDO, else a separate sensor",
    )
    sampling: Literal["interval_mean", "instant"] = Field(
        "interval_mean",
        description="a value is the mean since the last one, or instantaneous; left out for a single value: instant",
    )
    type: ValueType | None = Field(  # type: ignore[assignment]
        None,
        description="modbus: int16, uint16, int32, uint32, float32, float64; left out: float32 (int16 in a block) "
        "where function, address, word_order, byte_order or a block is given, else the registers of fdhil's "
        "simulated sensor",
    )
    period_s: Positive = Field(
        0.02, ge=1e-3, le=10.0, description="how often a single-value sensor is polled, or sends"
    )
    delay_s: NotNegative = Field(0.0, le=10.0, description="delay of that value by its filter")
    renewed_s: NotNegative = Field(0.0, le=10.0, description="how often the sensor updates it; 0: at each poll")
    block: VoltageBlock | None = None

    @model_validator(mode="before")
    @classmethod
    def _fill_defaults(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        filled = dict(given)
        if any(key in given for key in _SAYS_WHERE):
            filled.setdefault("type", "int16" if given.get("block") is not None else "float32")
        one_value = given.get("source") == "serial" or filled.get("type") is not None
        if one_value and given.get("block") is None:
            filled.setdefault("sampling", "instant")
        return filled

    @model_validator(mode="after")
    def _check_voltage(self) -> Voltage:
        _check_scale(self)
        if self.source == "serial" and not self.device:
            raise ValueError("device: is missing: name the sensor's serial device, as device = '/dev/ttyUSB0'")
        if self.block is not None and compute_block_registers(self)[1] > MOST_REGISTERS:
            raise ValueError(
                "block: samples and count span more than 125 registers, the most that one request reads; move "
                "them together"
            )
        return self

    @property
    def is_separate(self) -> bool:
        """Whether a separate sensor measures the voltage; otherwise the drive sends it with its samples."""
        return self.source != tables.DRIVE_VOLTAGE


class Thermometer(LinearScale, TextValue, ModbusValue, ModbusDevice, SensorSource):
    """[axis.X.temperature]: the slide-way's thermometer. Without this section drift is tracked over time only."""

    source: Literal["modbus", "serial"] = Field("modbus", description="modbus, serial")
    port: int = Field(502, ge=1, le=65535, description="modbus: TCP port")
    address: int = Field(8, ge=0, le=65535, description="modbus: first register, counted from 0")
    period_s: Positive = Field(1.0, ge=1e-2, le=3600, description="how often it is polled")

    @model_validator(mode="after")
    def _check_thermometer(self) -> Thermometer:
        _check_scale(self)
        if self.source == "serial" and not self.device:
            raise ValueError("device: is missing: name the thermometer's serial device, as device = '/dev/ttyUSB0'")
        return self


WORDS = {"int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "float32": 2, "float64": 4}
MOST_REGISTERS = 125  # of one request


def compute_block_registers(voltage: Voltage) -> tuple[int, int]:
    """Return first register and number of registers of the request that reads a device's block."""
    block, kind = voltage.block, voltage.type
    assert block is not None
    assert kind is not None
    places = [(voltage.address, block.samples * WORDS[kind]), (block.counter_address, WORDS[block.counter_type])]
    if block.count_address is not None:
        places.append((block.count_address, 1))
    first = min(address for address, _ in places)
    return first, max(address + words for address, words in places) - first


@dataclass(frozen=True, slots=True)
class SerialLineUser:
    """A sensor on a serial device; ``registers`` are read every ``period_s``, 0 where it is not polled for a value.

    ``alone``: it sends lines of text and cannot share its device.
    """

    path: str
    place: SerialDevice
    registers: int
    period_s: float
    alone: bool

    @property
    def time_share(self) -> float:
        """Share of its line's time that it takes."""
        bits = 1 + 8 + (self.place.parity != "none") + self.place.stop_bits
        characters = _REQUEST_CHARACTERS + _ANSWER_CHARACTERS + 2 * self.registers + _SILENT_CHARACTERS
        return characters * bits / self.place.baud_rate / self.period_s if self.registers else 0.0


def find_line_user(path: str, sensor: Voltage | Thermometer) -> SerialLineUser | None:
    """Return a sensor's use of a serial device; None where it has none."""
    if not sensor.device or sensor.source == tables.DRIVE_VOLTAGE:
        return None
    asked = sensor.source == "modbus" and getattr(sensor, "block", None) is None and sensor.type is not None
    registers = WORDS[sensor.type] if asked and sensor.type is not None else 0
    return SerialLineUser(path, sensor, registers, sensor.period_s, sensor.source == "serial")


_LINE_KEYS = ("baud_rate", "parity", "stop_bits")
_REQUEST_CHARACTERS, _ANSWER_CHARACTERS, _SILENT_CHARACTERS = 8, 5, 7.0


def find_line_faults(users: Iterable[SerialLineUser]) -> Iterator[str]:
    """Yield conflicts of sensors on one serial device: different settings, text next to others, too much polling."""
    lines: dict[str, list[SerialLineUser]] = {}
    for user in users:
        lines.setdefault(user.place.device, []).append(user)
    for device, members in lines.items():
        first = members[0]
        for other in members[1:]:
            for key in _LINE_KEYS:
                wanted = getattr(first.place, key)
                if getattr(other.place, key) != wanted:
                    yield f"{other.path}.{key}: {first.path} sets the same device {device} to {wanted}"
            if first.alone or other.alone:
                text = f"{first.path} has {device}, and a text instrument cannot share its device; give it another one"
                yield f"{other.path}.device: {text}"
        share = sum(user.time_share for user in members)
        if share > 1.0:
            text = f"{', '.join(user.path for user in members)} take {share:.0%} of the time of {device}"
            yield f"{first.path}.period_s: {text} at {first.place.baud_rate} baud; poll less often or raise baud_rate"
