"""[axis.X.table], [axis.X.accelerometer]: sensors at the table, which measure what the motor's encoder cannot."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from fdhil.config.section import Finite, Positive
from fdhil.config.sensor_sections import LinearScale, ModbusDevice, ModbusValue, SerialDevice, ValueType

IN_A_FRAME = {"int16": 16, "uint16": 16, "int32": 32, "uint32": 32}  # bits


class TableEncoder(LinearScale, ModbusValue, ModbusDevice):
    """[axis.X.table]: an encoder at the table. Without this section the errors of the screw are not measured.

    In a TPDO of the axis' bus that is sent after every SYNC it measures the table's oscillation; polled over Modbus, a
    few times a second, it measures the table's position.
    """

    source: Literal["canopen", "modbus"] = Field(
        "canopen", description="canopen: a synchronous TPDO on the drive's bus; modbus: a module that is polled"
    )
    cob_id: int | None = Field(
        None,
        ge=0x181,
        le=0x57F,
        description="canopen: COB-ID of the TPDO with the table's position; usually 0x180 + node-ID for a "
        "node's first one",
    )
    byte: int = Field(0, ge=0, le=6, description="canopen: first byte of the position in that TPDO")
    type: ValueType = Field("int32", description="canopen: int16, uint16, int32, uint32; modbus: also float32, float64")
    scale: Finite = Field(1e-3, description="mm per count; negative where it counts in the opposite direction")
    offset: Finite = Field(0.0, description="mm added after scaling")
    period_s: Positive = Field(0.05, ge=1e-3, le=60, description="modbus: how often it is polled")

    @model_validator(mode="after")
    def _check_encoder(self) -> TableEncoder:
        if self.scale == 0:
            raise ValueError("scale: must not be 0; give mm per count")
        if self.source != "canopen":
            return self
        if self.cob_id is None:
            raise ValueError("cob_id: is missing: give the COB-ID of the TPDO with the table's position")
        if self.type not in IN_A_FRAME:
            raise ValueError(f"type: a TPDO carries {', '.join(IN_A_FRAME)}, not {self.type}")
        if 8 * self.byte + IN_A_FRAME[self.type] > 64:
            raise ValueError(f"byte: {self.type} from byte {self.byte} on exceeds the frame's 8 bytes")
        return self


class Accelerometer(SerialDevice):
    """[axis.X.accelerometer]: an accelerometer at the table that streams a line of text per sample.

    ADXL345 boards of 3D printers do this; the defaults fit one that sends ``count,x,y,z`` in counts of 3.9 mg.
    """

    device: str = Field(min_length=1, description="the serial device, as /dev/ttyACM0 or /dev/serial/by-id/...")
    baud_rate: int = Field(
        115200, ge=1200, le=4_000_000, description="serial: bits per second; no effect on a USB port"
    )
    parity: Literal["even", "odd", "none"] = Field("none", description="serial: parity")
    rate_hz: Positive = Field(800.0, ge=50, le=5000, description="nominal samples per second")
    column: int = Field(2, ge=1, le=16, description="column of the acceleration along the axis in a line")
    count_column: int = Field(1, ge=0, le=16, description="column of the sample count; 0: none, losses undetected")
    scale: Finite = Field(0.03825, description="m/s2 per count; negative where it points in the opposite direction")
    late_s: float = Field(0.0, ge=0.0, le=0.1, description="delay of its filter and transmission")

    @model_validator(mode="after")
    def _check_columns(self) -> Accelerometer:
        if self.scale == 0:
            raise ValueError("scale: must not be 0; give m/s2 per count")
        if self.column == self.count_column:
            raise ValueError("column: is the sample count; give the column of the acceleration")
        return self
