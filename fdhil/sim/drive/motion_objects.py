"""Lists the objects of the drive's own motion: velocity, torque and homing modes, windows, limits, motor type.

Profile speeds are in increments/s and accelerations in increments/s2, as everywhere in this drive; 0x6080 is in rpm.
"""

import math

from fdhil.config import Axis
from fdhil.sim.drive.object_dictionary import (
    ARRAY,
    I8,
    I16,
    I32,
    U8,
    U16,
    U32,
    DataType,
    DictionaryObject,
    Entry,
    create_record,
    create_var,
)

NO_WINDOW = 0xFFFFFFFF
HERE = 37  # homing method: the current position
_WINDOW_MM, _WINDOW_MS = 0.01, 10
_SPEED_WINDOW_RAD_S = 1.0
_REST_MS = 5
_HEADROOM = 2.0  # of the speed limit over the axis' speed, of the acceleration limit over the quick stop's
_TORQUE_SLOPE = 10_000  # 0.1 %/s


def list_motion_objects(axis: Axis, increments_per_mm: float) -> list[DictionaryObject]:
    """Return the objects of one axis' drive with their power-on values."""
    return [
        *_list_window_objects(axis, increments_per_mm),
        *_list_limit_objects(axis, increments_per_mm),
        *_list_homing_objects(axis, increments_per_mm),
    ]


def _list_window_objects(axis: Axis, increments_per_mm: float) -> list[DictionaryObject]:
    speed = round(_SPEED_WINDOW_RAD_S * axis.drive.increments_per_rev / (2 * math.pi))
    return [
        create_var(0x605D, "Halt option code", I16, "rw", 1, low=1, high=2),
        create_var(0x6067, "Position window", U32, "rw", max(1, round(_WINDOW_MM * increments_per_mm))),
        create_var(0x6068, "Position window time", U16, "rw", _WINDOW_MS),
        create_var(0x606D, "Velocity window", U16, "rw", min(speed, 0xFFFF)),
        create_var(0x606E, "Velocity window time", U16, "rw", _REST_MS),
        create_var(0x606F, "Velocity threshold", U16, "rw", min(speed, 0xFFFF)),
        create_var(0x6070, "Velocity threshold time", U16, "rw", _REST_MS),
    ]


def compute_current_limit(axis: Axis) -> int:
    """Return the configured current limit in 0.1 % of the rated current, rounded up."""
    return min(math.ceil(axis.regulators.current_limit_a / axis.drive.rated_current_a * 1e3), 0xFFFF)


def _list_limit_objects(axis: Axis, increments_per_mm: float) -> list[DictionaryObject]:
    speed_mm_s = _HEADROOM * axis.top_speed_mm_s
    highest = min(round(2 * _HEADROOM * axis.max_acceleration_mm_s2 * increments_per_mm), NO_WINDOW)
    current = compute_current_limit(axis)
    return [
        create_var(0x6072, "Max torque", U16, "rww", current, mappable=True),
        create_var(0x6073, "Max current", U16, "rw", current),
        create_var(0x6074, "Torque demand", I16, "ro", mappable=True),
        create_var(0x607E, "Polarity", U8, "rw", 0, low=0, high=0),
        create_var(0x607F, "Max profile velocity", U32, "rw", min(round(speed_mm_s * increments_per_mm), NO_WINDOW)),
        create_var(0x6080, "Max motor speed", U32, "rw", math.ceil(60 * speed_mm_s / axis.screw_pitch_mm)),
        create_var(0x6086, "Motion profile type", I16, "rw", 0, low=0, high=0),
        create_var(0x6087, "Torque slope", U32, "rww", _TORQUE_SLOPE, mappable=True),
        create_var(0x6088, "Torque profile type", I16, "rw", 0, low=0, high=0),
        create_var(0x60C5, "Max acceleration", U32, "rw", highest),
        create_var(0x60C6, "Max deceleration", U32, "rw", highest),
        create_record(
            0x60FE,
            "Digital outputs",
            Entry(0x60FE, 1, "Physical outputs", U32, "rww", mappable=True),
            Entry(0x60FE, 2, "Bit mask", U32, "rw"),
            kind=ARRAY,
        ),
        create_var(0x60FF, "Target velocity", I32, "rww", mappable=True),
        create_var(0x6402, "Motor type", U16, "rw", 10, low=10, high=10),  # sinusoidal PM BL motor
        create_var(0x6504, "Drive manufacturer", DataType.VISIBLE_STRING, "const", b"fdhil"),
        create_var(0x67FF, "Single device type", U32, "ro", 0x00020192),
    ]


def _list_homing_objects(axis: Axis, increments_per_mm: float) -> list[DictionaryObject]:
    fast = round(axis.top_speed_mm_s / 10 * increments_per_mm)
    return [
        create_var(0x607C, "Home offset", I32, "rw"),
        create_var(0x6098, "Homing method", I8, "rw", HERE),
        create_record(
            0x6099,
            "Homing speeds",
            Entry(0x6099, 1, "Speed during search for switch", U32, "rw", max(1, fast), low=1),
            Entry(0x6099, 2, "Speed during search for zero", U32, "rw", max(1, fast // 10), low=1),
            kind=ARRAY,
        ),
        create_var(
            0x609A, "Homing acceleration", U32, "rw", round(axis.max_acceleration_mm_s2 / 4 * increments_per_mm), low=1
        ),
    ]
