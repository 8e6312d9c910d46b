"""[axis.X.voltage], [axis.X.temperature]: sensors of their own, on Modbus (TCP or RTU) or on a serial line.

What two kinds of sensor have in common is a class here: where a device is, and how its value is read.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from fdhil import tables
from fdhil.config.section import Finite, Positive, Section, one_of

BAUD_RATES = (1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200, 230400, 460800, 921600)
ValueType = Literal["int16", "uint16", "int32", "uint32", "float32", "float64"]
NO_DEVICE = ""


def _of_a_line(rate: int) -> int:
    if rate not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return rate


def _regular(pattern: str) -> str:
    try:
        groups = re.compile(pattern).groups
    except re.error as error:
        raise ValueError(f"is no regular expression ({error})") from None
    if groups != 1:
        raise ValueError("must have one group, around the number, as in 'U=([-+.0-9]+)'")
    return pattern


class SerialPlace(Section):
    """A serial line, and how it is set."""

    device: str = Field(NO_DEVICE, description="the serial device, as /dev/ttyUSB0 or /dev/serial/by-id/...")
    baud_rate: Annotated[int, AfterValidator(_of_a_line)] = Field(19200, description="serial: bits per second")
    parity: Literal["even", "odd", "none"] = Field(
        "even", description="serial: even is what Modbus devices have, none what others have"
    )
    stop_bits: Literal[1, 2] = Field(1, description="serial: stop bits; Modbus has 2 where there is no parity")
    timeout_s: Positive = Field(0.5, ge=1e-3, le=60, description="how long an answer may take")


class ModbusPlace(SerialPlace):
    """A Modbus unit: RTU on a serial device, else TCP."""

    device: str = Field(
        NO_DEVICE, description="serial: the device, as /dev/ttyUSB0 (Modbus RTU); left out: host and port (Modbus TCP)"
    )
    host: str = Field("127.0.0.1", description="modbus: address of the device")
    port: int = Field(0, ge=0, le=65535, description="modbus: TCP port; 0 lets the simulator choose one")
    unit: int = Field(1, ge=0, le=255, description="modbus: unit identifier; on a serial device 1 to 247")

    @model_validator(mode="after")
    def _answers(self) -> ModbusPlace:
        if self.device and not 1 <= self.unit <= 247:
            raise ValueError("unit: a unit on a serial line has a number from 1 to 247")
        return self


class ModbusValue(Section):
    """A value in the registers of a Modbus unit."""

    function: Literal[3, 4] = Field(4, description="modbus: 4 reads input registers, 3 holding registers")
    address: int = Field(
        0, ge=0, le=65535, description="modbus: first register, counted from 0 (register 30001 or 40001 is 0)"
    )
    type: ValueType = Field("float32", description="modbus: int16, uint16, int32, uint32, float32, float64")
    word_order: Literal["big", "little"] = Field(
        "big", description="modbus: big has the high word of a value in its first register, little the low word"
    )
    scale: Finite = Field(1.0, description="of the value as it is read; negative where the sensor is wired backwards")
    offset: Finite = Field(0.0, description="what is added then")


class Voltage(ModbusPlace):
    """[axis.X.voltage]: where the motor's terminal voltage comes from."""

    source: Annotated[str, one_of(tables.VOLTAGE_SOURCES)] = Field(
        tables.DRIVE_VOLTAGE,
        description=f"{', '.join(tables.VOLTAGE_SOURCES)}; drive: a vendor object in a TPDO, else a separate sensor",
    )
    sampling: Literal["interval_mean", "instant"] = Field(
        "interval_mean", description="the drive's value is the mean since the last sample, or an instant"
    )

    @property
    def separate(self) -> bool:
        """Whether a sensor of its own tells the voltage; else the drive does, with its other samples."""
        return self.source != tables.DRIVE_VOLTAGE


class Thermometer(ModbusPlace):
    """[axis.X.temperature]: the slide-way's thermometer (Modbus). Without this section drift is told by time alone."""

    port: int = Field(502, ge=1, le=65535, description="modbus: TCP port")
    address: int = Field(8, ge=0, le=65534, description="first of its two input registers (float32, high word first)")
    period_s: Positive = Field(1.0, ge=1e-2, le=3600, description="how often it is asked")
