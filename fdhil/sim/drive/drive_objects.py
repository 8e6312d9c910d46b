"""Lists the objects of the simulated drive: communication (CiA 301), drive profile (CiA 402-2), vendor objects.

Position objects are in increments of the encoder, speeds in increments/s, currents in 0.1 % of 0x6075, torques in 0.1 %
of 0x6076, the vendor's terminal voltage (0x2101) in 0.02 V: the mean over the SYNC period that ended.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from fdhil.config import Axis, MachineConfig
from fdhil.sim.drive.motion_objects import NO_WINDOW, list_motion_objects
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
from fdhil.sim.drive.operation_modes import SUPPORTED_MODES
from fdhil.sim.drive.service_objects import list_service_objects

VENDOR_ID = 0x46444849
PRODUCT_CODE = 0x0402
REVISION = 0x00010000
DEVICE_NAME = b"fdhil twin drive"
VOLTAGE_V_PER_COUNT = 0.02
ERROR_HISTORY = 8
HEARTBEAT_CONSUMERS = 4
PDO_ENTRIES = 8
INVALID = 1 << 31
NO_RTR = 1 << 30

PdoMapping = tuple[tuple[int, int, int], ...]  # entries (index, sub, bits)

# default PDOs: (COB-ID base, valid, transmission type, mapping)
RPDO_DEFAULTS: tuple[tuple[int, bool, int, PdoMapping], ...] = (
    (0x200, True, 1, ((0x6040, 0, 16), (0x607A, 0, 32))),
    (0x300, True, 1, ((0x60B0, 0, 32),)),
    (0x400, False, 1, ((0x60B1, 0, 32), (0x60B2, 0, 16))),
    (0x500, False, 255, ()),
)
TPDO_DEFAULTS: tuple[tuple[int, bool, int, PdoMapping], ...] = (
    (0x180, True, 1, ((0x6064, 0, 32), (0x606C, 0, 32))),
    (0x280, True, 1, ((0x6041, 0, 16), (0x6078, 0, 16), (0x2101, 0, 16))),
    (0x380, True, 10, ((0x6062, 0, 32), (0x60B0, 0, 32))),
    (0x480, True, 10, ((0x60FD, 0, 32), (0x6061, 0, 8), (0x6077, 0, 16))),
)


@dataclass(frozen=True, slots=True)
class DriveRatings:
    """The settings of one axis' drive, in its own units."""

    node_id: int
    sync_period_s: float
    increments_per_rev: int
    increments_per_mm: float
    sign: int
    rated_current_a: float
    rated_torque_nm: float

    @classmethod
    def read_from_config(cls, config: MachineConfig, axis: str) -> DriveRatings:
        section = config.axis[axis]
        return cls(
            node_id=config.get_node_id(axis),
            sync_period_s=config.machine.sync_period_s,
            increments_per_rev=section.drive.increments_per_rev,
            increments_per_mm=section.drive.increments_per_rev / section.screw_pitch_mm,
            sign=section.drive.sign,
            rated_current_a=section.drive.rated_current_a,
            rated_torque_nm=section.nominal.K * section.drive.rated_current_a,
        )


def list_drive_objects(config: MachineConfig, axis: str) -> tuple[DictionaryObject, ...]:
    """Return all objects of one axis' drive with their power-on values."""
    ratings = DriveRatings.read_from_config(config, axis)
    objects = (
        *_list_communication_objects(config, axis, ratings),
        *_list_pdo_objects(ratings.node_id),
        *_list_vendor_objects(),
        *_list_state_objects(),
        *_list_position_objects(config.axis[axis], ratings),
        *_list_motor_objects(config.axis[axis], ratings),
        *list_service_objects(),
        *list_motion_objects(config.axis[axis], ratings.increments_per_mm),
    )
    return tuple(sorted(objects, key=lambda item: item.index))


def compute_serial_number(config: MachineConfig, axis: str) -> int:
    """Return a stable serial number (0x1018:04) that differs between machines of different names."""
    return zlib.crc32(f"{config.machine.name}/{axis}".encode()) or 1


def _list_communication_objects(config: MachineConfig, axis: str, ratings: DriveRatings) -> list[DictionaryObject]:
    node = ratings.node_id
    return [
        create_var(0x1000, "Device type", U32, "ro", 0x00020192),
        create_var(0x1001, "Error register", U8, "ro", mappable=True),
        create_record(
            0x1003,
            "Pre-defined error field",
            *(Entry(0x1003, n, f"Error field {n}", U32, "ro") for n in range(1, ERROR_HISTORY + 1)),
            kind=ARRAY,
            count=Entry(0x1003, 0, "Number of errors", U8, "rw", 0, low=0, high=0),
        ),
        create_var(0x1005, "COB-ID SYNC message", U32, "rw", 0x80),
        create_var(0x1006, "Communication cycle period", U32, "rw", round(ratings.sync_period_s * 1e6)),
        create_var(0x1008, "Manufacturer device name", DataType.VISIBLE_STRING, "const", DEVICE_NAME),
        create_var(0x1009, "Manufacturer hardware version", DataType.VISIBLE_STRING, "const", b"simulated"),
        create_var(0x100A, "Manufacturer software version", DataType.VISIBLE_STRING, "const", b"1.0"),
        create_record(0x1010, "Store parameters", Entry(0x1010, 1, "Save all parameters", U32, "rw", 1), kind=ARRAY),
        create_record(0x1011, "Restore default parameters", Entry(0x1011, 1, "Restore all", U32, "rw", 1), kind=ARRAY),
        create_var(0x1014, "COB-ID emergency message", U32, "rw", 0x80 + node, node_relative=True),
        create_record(
            0x1016,
            "Consumer heartbeat time",
            *(Entry(0x1016, n, f"Consumer heartbeat time {n}", U32, "rw") for n in range(1, HEARTBEAT_CONSUMERS + 1)),
            kind=ARRAY,
        ),
        create_var(0x1017, "Producer heartbeat time", U16, "rw", 100),
        create_record(
            0x1018,
            "Identity object",
            Entry(0x1018, 1, "Vendor-ID", U32, "ro", VENDOR_ID),
            Entry(0x1018, 2, "Product code", U32, "ro", PRODUCT_CODE),
            Entry(0x1018, 3, "Revision number", U32, "ro", REVISION),
            Entry(0x1018, 4, "Serial number", U32, "ro", compute_serial_number(config, axis)),
        ),
        create_var(0x1019, "Synchronous counter overflow value", U8, "rw", 240 if config.sim.nc else 0),
        create_record(
            0x1200,
            "SDO server parameter",
            Entry(0x1200, 1, "COB-ID client to server", U32, "ro", 0x600 + node, node_relative=True),
            Entry(0x1200, 2, "COB-ID server to client", U32, "ro", 0x580 + node, node_relative=True),
        ),
    ]


def _list_pdo_objects(node_id: int) -> list[DictionaryObject]:
    objects = []
    for direction, first, flags, defaults in (
        ("RPDO", 0x1400, 0, RPDO_DEFAULTS),
        ("TPDO", 0x1800, NO_RTR, TPDO_DEFAULTS),
    ):
        for n, (base, valid, kind, mapped) in enumerate(defaults):
            name, cob_id = f"{direction} {n + 1}", base + node_id + flags + (0 if valid else INVALID)
            objects.append(_create_pdo_communication(first + n, name, cob_id, kind))
            objects.append(_create_pdo_mapping(first + 0x200 + n, name, mapped))
    return objects


def _create_pdo_communication(index: int, name: str, cob_id: int, kind: int) -> DictionaryObject:
    entries = [
        Entry(index, 1, "COB-ID", U32, "rw", cob_id, node_relative=True),
        Entry(index, 2, "Transmission type", U8, "rw", kind),
        Entry(index, 3, "Inhibit time", U16, "rw"),
        Entry(index, 5, "Event timer", U16, "rw"),
        Entry(index, 6, "SYNC start value", U8, "rw", 0, low=0, high=240),
    ]
    if index < 0x1800:  # an RPDO has no inhibit time and no SYNC start value
        entries = [entry for entry in entries if entry.sub not in (3, 6)]
    return create_record(index, f"{name} communication parameter", *entries)


def _create_pdo_mapping(index: int, name: str, mapped: PdoMapping) -> DictionaryObject:
    words = [i << 16 | s << 8 | bits for i, s, bits in mapped] + [0] * (PDO_ENTRIES - len(mapped))
    entries = (Entry(index, n, f"Mapped object {n}", U32, "rw", word) for n, word in enumerate(words, 1))
    count = Entry(index, 0, "Number of mapped objects", U8, "rw", len(mapped))
    return create_record(index, f"{name} mapping parameter", *entries, count=count)


def _list_vendor_objects() -> list[DictionaryObject]:
    return [
        create_var(0x2101, "Terminal voltage, mean of the SYNC period", I16, "ro", mappable=True),
        create_record(
            0x2110, "Temperatures", Entry(0x2110, 1, "Slide-way temperature", I16, "ro", 2000, mappable=True)
        ),
        create_var(0x2120, "Trace buffer", DataType.DOMAIN, "ro", b""),
        create_var(0x2121, "Trace buffer clear", U8, "wo", 1, low=1, high=1),
    ]


def _list_state_objects() -> list[DictionaryObject]:
    return [
        create_var(0x6007, "Abort connection option code", I16, "rw", 1, low=0, high=3),
        create_var(0x603F, "Error code", U16, "ro", mappable=True),
        create_var(0x6040, "Controlword", U16, "rww", mappable=True),
        create_var(0x6041, "Statusword", U16, "ro", mappable=True),
        create_var(0x605A, "Quick stop option code", I16, "rw", 2),
        create_var(0x605B, "Shutdown option code", I16, "rw", 0, low=0, high=1),
        create_var(0x605C, "Disable operation option code", I16, "rw", 1, low=0, high=1),
        create_var(0x605E, "Fault reaction option code", I16, "rw", 2, low=0, high=2),
        create_var(0x6060, "Modes of operation", I8, "rww", mappable=True),
        create_var(0x6061, "Modes of operation display", I8, "ro", mappable=True),
        create_var(0x60FD, "Digital inputs", U32, "ro", mappable=True),
        create_var(0x6502, "Supported drive modes", U32, "ro", SUPPORTED_MODES),
    ]


def _list_position_objects(axis: Axis, ratings: DriveRatings) -> list[DictionaryObject]:
    per_mm = ratings.increments_per_mm
    acceleration = round(axis.max_acceleration_mm_s2 * per_mm)
    speed = round((axis.drive.speed_limit_mm_s or axis.rapid_speed_mm_s) * per_mm)
    window = min(round(axis.drive.following_error_window_mm * per_mm), NO_WINDOW - 1)
    return [
        create_var(0x6062, "Position demand value", I32, "ro", mappable=True),
        create_var(0x6063, "Position actual internal value", I32, "ro", mappable=True),
        create_var(0x6064, "Position actual value", I32, "ro", mappable=True),
        create_var(0x6065, "Following error window", U32, "rw", window),
        create_var(0x6066, "Following error time out", U16, "rw", 10),
        create_var(0x606B, "Velocity demand value", I32, "ro", mappable=True),
        create_var(0x606C, "Velocity actual value", I32, "ro", mappable=True),
        create_var(0x607A, "Target position", I32, "rww", mappable=True),
        create_record(
            0x607D,
            "Software position limit",
            Entry(0x607D, 1, "Min position limit", I32, "rw", -(2**31)),
            Entry(0x607D, 2, "Max position limit", I32, "rw", 2**31 - 1),
        ),
        create_var(0x6081, "Profile velocity", U32, "rww", speed, mappable=True),
        create_var(0x6083, "Profile acceleration", U32, "rww", acceleration, mappable=True, low=1),
        create_var(0x6084, "Profile deceleration", U32, "rww", acceleration, mappable=True, low=1),
        create_var(0x6085, "Quick stop deceleration", U32, "rww", 2 * acceleration, mappable=True, low=1),
        _create_ratio(
            0x608F, "Position encoder resolution", "Increments", ratings.increments_per_rev, "Motor revolutions"
        ),
        _create_ratio(0x6091, "Gear ratio", "Motor revolutions", 1, "Shaft revolutions"),
        _create_ratio(0x6092, "Feed constant", "Feed, increments", ratings.increments_per_rev, "Shaft revolutions"),
        create_var(0x60B0, "Position offset", I32, "rw", mappable=True),
        _create_interpolation_time(ratings.sync_period_s),
        create_var(0x60F4, "Following error actual value", I32, "ro", mappable=True),
        create_var(0x60FC, "Position demand internal value", I32, "ro", mappable=True),
    ]


def _create_ratio(index: int, name: str, upper: str, value: int, lower: str) -> DictionaryObject:
    first = Entry(index, 1, upper, U32, "rw", value, low=1)
    return create_record(index, name, first, Entry(index, 2, lower, U32, "rw", 1, low=1))


def _create_interpolation_time(sync_period_s: float) -> DictionaryObject:
    """Return 0x60C2 for the machine's SYNC period: value x 10^exponent seconds."""
    exponent = -3
    while exponent > -6 and abs(sync_period_s / 10**exponent - round(sync_period_s / 10**exponent)) > 1e-9:
        exponent -= 1
    value = round(sync_period_s / 10**exponent)
    return create_record(
        0x60C2,
        "Interpolation time period",
        Entry(0x60C2, 1, "Interpolation time period value", U8, "rw", value, low=1),
        Entry(0x60C2, 2, "Interpolation time index", I8, "rw", exponent, low=exponent, high=exponent),
    )


def _list_motor_objects(axis: Axis, ratings: DriveRatings) -> list[DictionaryObject]:
    return [
        create_var(0x6071, "Target torque", I16, "rww", mappable=True),
        create_var(0x6075, "Motor rated current", U32, "ro", round(ratings.rated_current_a * 1e3)),
        create_var(0x6076, "Motor rated torque", U32, "ro", round(ratings.rated_torque_nm * 1e3)),
        create_var(0x6077, "Torque actual value", I16, "ro", mappable=True),
        create_var(0x6078, "Current actual value", I16, "ro", mappable=True),
        create_var(
            0x6079, "DC link circuit voltage", U32, "ro", round(axis.regulators.voltage_limit_v * 1e3), mappable=True
        ),
        create_var(0x60B1, "Velocity offset", I32, "rw", mappable=True),
        create_var(0x60B2, "Torque offset", I16, "rw", mappable=True),
    ]
