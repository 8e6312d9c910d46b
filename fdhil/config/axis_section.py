"""[axis.X]: one feed axis, its data sheet, its drive and its sensors."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, field_validator, model_validator

from fdhil import tables
from fdhil.cia402 import Scaling
from fdhil.config.axis_tables import compute_mm_per_degree, convert_key_to_degrees
from fdhil.config.regulators import Regulators
from fdhil.config.section import Finite, NotNegative, Positive, Section, require_one_of
from fdhil.config.sensor_sections import Thermometer, Voltage
from fdhil.config.table_sensor_sections import Accelerometer, TableEncoder

# built-in ceilings of all offsets; a config can only lower them
MOST_FILE_BYTES = 4 << 20  # larger than any EDS or profile
CEILING_OFFSET_UM = 250.0
CEILING_SPEED_MM_S = 20.0
CEILING_ACCELERATION_MM_S2 = 2000.0


HAL_INCREMENTS = 1_000_000
"""Increments per revolution in which the bridge counts the positions of HAL's pins, unless the file has another."""

SpeedUnit = Literal["increments_per_s", "rpm", "millirpm"]
"""What a drive's speed object can count in."""


class Nominal(Section):
    """[axis.X.nominal]: the data sheet's values, used until validated ones exist."""

    R: Positive = Field(ge=1e-4, le=1e6, description="resistance, ohm")
    L: Positive = Field(ge=1e-7, le=1e6, description="inductance, H")
    K: Positive = Field(ge=1e-5, le=1e6, description="torque constant = back-EMF constant, N.m/A")
    Jt: Positive = Field(ge=1e-9, le=1e6, description="total inertia on the motor shaft, kg.m2")
    ft: NotNegative = Field(le=1e6, description="viscous friction, N.m.s")
    Cd: NotNegative = Field(le=1e6, description="dry friction torque, N.m")


class CorrectionLimits(Section):
    """[axis.X.correction]: limits of the offsets at the guard. Without this section no offset is sent."""

    max_offset_um: Positive = Field(50.0, le=CEILING_OFFSET_UM, description="largest offset")
    max_speed_mm_s: Positive = Field(2.0, le=CEILING_SPEED_MM_S, description="largest rate of the offset")
    max_acceleration_mm_s2: Positive = Field(
        250.0, le=CEILING_ACCELERATION_MM_S2, description="its largest acceleration"
    )


class SetPointLimits(Section):
    """[axis.X.setpoints]: limits of the set-points of fdhil play. Without this section it sends none."""

    travel_mm: tuple[Finite, Finite] = Field(description="lowest and highest position, braking included")
    max_speed_mm_s: Positive | None = Field(None, description="largest speed; left out: the axis maximum")
    max_acceleration_mm_s2: Positive | None = Field(
        None, ge=1e-2, le=1e6, description="largest acceleration, also for stopping; left out: that of G0"
    )

    @field_validator("travel_mm")
    @classmethod
    def _check_travel_order(cls, travel_mm: tuple[float, float]) -> tuple[float, float]:
        if not travel_mm[0] < travel_mm[1]:
            raise ValueError("the lowest position must come first")
        return travel_mm


class FeedforwardLimits(Section):
    """[axis.X.feedforward]: limits of the on-line feed-forward at the guard. Without this section it is off."""

    max_torque_nm: Positive = Field(40.0, description="largest torque offset (0x60B2)")
    max_torque_rate_nm_s: Positive = Field(20e3, description="largest rate of the torque offset")
    max_speed_rad_s: Positive = Field(5.0, description="largest speed offset (0x60B1), of the motor")
    max_speed_rate_rad_s2: Positive = Field(5e3, description="largest rate of the speed offset")


HalPin = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.:-]{1,127}$")]
HalScale = Finite


class HalPins(Section):
    """[axis.X.drive.hal]: the HAL pins of an axis, for source = "hal". A negative scale reverses the sign."""

    position_command: HalPin = Field(description="joint's commanded position, as joint.0.motor-pos-cmd")
    position_feedback: HalPin = Field(description="measured position, before any offset is subtracted")
    speed: HalPin | None = Field(None, description="measured speed; left out: differences of the measured position")
    current: HalPin | None = Field(None, description="motor current, or the current command of an analogue drive")
    torque: HalPin | None = Field(None, description="where there is no current: motor torque, divided by nominal.K")
    voltage: HalPin | None = Field(None, description="motor voltage, or the duty of the PWM; left out: without voltage")
    enabled: HalPin | None = Field(None, description="true while the drive is enabled; left out: motion.motion-enabled")
    position_mm_per_unit: Positive = Field(1.0, description="of command and feedback: 25.4 where they are in inch")
    speed_mm_s_per_unit: HalScale = Field(1.0, description="speed of the table per unit of the pin")
    current_a_per_unit: HalScale = Field(1.0, description="current per unit of the pin")
    torque_nm_per_unit: HalScale = Field(1.0, description="torque per unit of the pin")
    voltage_v_per_unit: HalScale = Field(1.0, description="voltage per unit of the pin; of a duty: the bus voltage")
    voltage_is: Literal["measured", "commanded"] = Field(
        "measured", description="measured: the mean of the previous cycle; commanded: acts in the next cycle"
    )

    @model_validator(mode="after")
    def _check_pins(self) -> HalPins:
        if self.current is None and self.torque is None:
            raise ValueError("neither current nor torque has a pin, so nothing can be identified; name one of them")
        for key in ("speed", "current", "torque", "voltage"):
            if not any(k.startswith(f"{key}_") and getattr(self, k) == 0 for k in type(self).model_fields):
                continue
            raise ValueError(f"the scale of {key} is 0, so every value would be 0; give the unit of one count")
        return self


def _read_file_bytes(path: Path) -> bytes:
    """Read at most as many bytes as a profile or an EDS may have; a larger file is refused when it is parsed."""
    with path.open("rb") as file:
        return file.read(MOST_FILE_BYTES)


class Drive(Section):
    """[axis.X.drive]: how the drive is reached and scaled."""

    _files: str = PrivateAttr("")

    def resolve_paths(self, folder: Path) -> Drive:
        """Return a copy with its file paths resolved against ``folder``, and the digest of these files."""
        own = [] if self.profile in tables.DRIVE_PROFILES else [folder / self.profile]
        eds = [] if self.eds is None else [folder / self.eds]
        changes: dict[str, Any] = {"profile": str(own[0]) if own else self.profile, "eds": eds[0] if eds else None}
        drive = self.model_copy(update=changes)
        content = b"".join(_read_file_bytes(path) for path in (*own, *eds) if path.is_file())
        drive._files = hashlib.sha256(content).hexdigest() if own or eds else ""
        return drive

    @model_validator(mode="before")
    @classmethod
    def _fill_hal_defaults(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("source", "hal" if "hal" in given else "") == "hal":
            return {
                "source": "hal",
                "profile": "hal",
                "setpoint_delay_cycles": 0,
                "increments_per_rev": HAL_INCREMENTS,
                **given,
            }
        return given

    @model_validator(mode="after")
    def _check_hal_pins(self) -> Drive:
        if self.source == "hal" and self.hal is None:
            raise ValueError('source = "hal" needs the table drive.hal with its pins')
        if self.source == "hal" and self.profile != "hal":
            raise ValueError(f'source = "hal" has profile "hal", not {self.profile}')
        return self

    @property
    def files_digest(self) -> str:
        """SHA-256 of the drive's own profile and EDS, part of the configuration's digest; empty without such files."""
        return self._files

    source: Literal["canopen", "hal"] = Field(
        "canopen", description="hal: LinuxCNC's HAL pins (drive.hal), through its bridge"
    )
    hal: HalPins | None = None
    bus: str = Field("can0", description="name of its [bus.*]")
    node_id: int | None = Field(
        None, ge=1, le=127, description="node-ID; left out: 1 for the first axis, 2 for the next"
    )
    profile: Annotated[str, require_one_of(tables.DRIVE_PROFILES, or_suffix=".toml")] = Field(
        "fdhil_twin",
        description=f"the drive's profile: {', '.join(tables.DRIVE_PROFILES)}, "
        "or the path of a TOML file, from this file's folder",
    )
    eds: Path | None = Field(None, description="the drive's EDS or DCF file, from this file's folder")
    logical_axis: int = Field(1, ge=1, le=8, description="axis of a device with several: 0x800 higher objects for each")
    increments_per_rev: int = Field(
        65536, ge=4, le=2**31 - 1, description="increments per revolution, of encoder and set-point"
    )
    speed_unit: SpeedUnit | None = Field(None, description="unit of 0x606C, where it is not the profile's (0x60A9)")
    sign: Literal[1, -1] = Field(1, description="-1 where the drive counts in the opposite direction")
    rated_current_a: Positive = Field(50.0, ge=1e-3, le=1e5, description="0x6075; 0x6078 counts in 0.1 % of it")
    rated_torque_nm: Positive = Field(
        1.0, ge=1e-4, le=1e6, description="0x6076, where current is derived from torque (0x6077)"
    )
    dc_link_v: Positive | None = Field(
        None, ge=1.0, le=2000.0, description="where the profile derives the voltage from the duty"
    )
    setpoint_delay_cycles: int = Field(2, ge=0, le=16, description="SYNC cycles by which it delays its set-point")
    following_error_window_mm: Positive = Field(10.0, ge=1e-3, le=1e4, description="0x6065: beyond it the drive faults")
    speed_limit_mm_s: Positive | None = Field(
        None, ge=1e-3, le=1e5, description="axis maximum; left out: the rapid speed"
    )


class Axis(Section):
    """[axis.X]; [axis.X2] is the second drive of a gantry axis and inherits the keys of [axis.X] that it does not set.

    A rotary axis is written in degrees, as rapid_speed_deg_s for rapid_speed_mm_s; its um are measured at radius_mm.
    """

    unit: Literal["mm", "deg"] = Field("mm", description="deg: a rotary axis, whose keys have deg in place of mm")
    radius_mm: Positive | None = Field(
        None, ge=10.0, le=1e4, description="rotary axis: radius at which angles count as path error"
    )
    screw_pitch_mm: Positive = Field(ge=1e-3, le=1e4, description="table travel per motor revolution")
    rapid_speed_mm_s: Positive = Field(ge=1e-3, le=1e5, description="speed of G0")
    max_acceleration_mm_s2: Positive = Field(ge=1e-2, le=1e6, description="acceleration of G0")
    max_jerk_mm_s3: Positive | None = Field(
        None,
        ge=1.0,
        le=1e9,
        description="largest jerk of profile jerk_limited; left out: the acceleration is reached in 25 ms",
    )
    resonance_hz: Positive | None = Field(
        None,
        ge=5.0,
        le=2000.0,
        description="resonance of motor against table with the motor free to turn, as in the drive's frequency "
        "response; left out: searched for where replayed rapids leave large residuals, else the table is assumed rigid",
    )
    resonance_damping: NotNegative = Field(0.03, le=0.7, description="damping ratio of that resonance")
    max_difference_um: Positive | None = Field(
        None, le=1e4, description="gantry: largest difference of its drives; left out: 500"
    )
    guessed: tuple[Literal["R", "L", "K", "Jt", "ft", "Cd"], ...] = Field(
        (), description="keys of nominal that are guesses: identified values are not compared with them"
    )
    nominal: Nominal
    regulators: Regulators
    correction: CorrectionLimits | None = None
    feedforward: FeedforwardLimits | None = None
    setpoints: SetPointLimits | None = None
    drive: Drive = Drive()
    voltage: Voltage = Voltage()
    temperature: Thermometer | None = None
    table: TableEncoder | None = None
    accelerometer: Accelerometer | None = None

    @property
    def largest_difference_um(self) -> float:
        return self.max_difference_um or 500.0

    @property
    def mm_per_unit(self) -> float:
        """Millimetres per unit of the axis: 1, or the length of arc of one degree at ``radius_mm``."""
        return 1.0 if self.radius_mm is None or self.unit == "mm" else compute_mm_per_degree(self.radius_mm)

    def format_in_unit(self, mm: float, per: str = "", form: str = ".4g") -> str:
        """Format a position, speed ("/s") or acceleration ("/s2") in the axis' unit."""
        return f"{mm / self.mm_per_unit:{form}} {self.unit}{per}"

    def format_key(self, key: str) -> str:
        """Return the name of a key as it is written for this axis."""
        return convert_key_to_degrees(key) if self.unit == "deg" else key

    @property
    def jerk_mm_s3(self) -> float:
        return self.max_jerk_mm_s3 or self.max_acceleration_mm_s2 / 0.025

    @property
    def scaling(self) -> Scaling:
        """Conversion between millimetres and the drive's increments."""
        return Scaling(self.drive.increments_per_rev, self.screw_pitch_mm, self.drive.sign)

    @property
    def top_speed_mm_s(self) -> float:
        return self.drive.speed_limit_mm_s or self.rapid_speed_mm_s

    @property
    def rapid_speed_rad_s(self) -> float:
        """Shaft speed of G0."""
        return self.rapid_speed_mm_s / self.screw_pitch_mm * 2 * math.pi
