"""Pure CiA 402: states, transitions, control and status words, object map, scaling.

No I/O, no clock, no numpy: bytes and integers in, values out. Sources: CiA 301 (COB-IDs, NMT, SYNC, EMCY),
CiA 402-2 (state machine, objects), CiA 402-3 (mode bits). Used by the drivers and by the guard.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum

# COB-IDs of the predefined connection set (CiA 301, table 39)
COB_NMT = 0x000
COB_SYNC = 0x080
COB_EMCY = 0x080
COB_TPDO = (0x180, 0x280, 0x380, 0x480)
COB_RPDO = (0x200, 0x300, 0x400, 0x500)
COB_SDO_RESPONSE = 0x580
COB_SDO_REQUEST = 0x600
COB_HEARTBEAT = 0x700


class Nmt(IntEnum):
    """NMT state as a heartbeat shows it (CiA 301, 7.2.8.3.2.2)."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(IntEnum):
    """Command specifier of an NMT message (CiA 301, 7.2.8.3.1)."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class Mode(IntEnum):
    """Modes of operation, 0x6060 and 0x6061 (CiA 402-2)."""

    NONE = 0
    PROFILE_POSITION = 1
    CYCLIC_SYNC_POSITION = 8
    CYCLIC_SYNC_VELOCITY = 9
    CYCLIC_SYNC_TORQUE = 10


class Object(IntEnum):
    """Indices of the objects that fdhil reads or writes (CiA 301 and CiA 402-2)."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    DEVICE_NAME = 0x1008
    HARDWARE_VERSION = 0x1009
    SOFTWARE_VERSION = 0x100A
    CONSUMER_HEARTBEAT = 0x1016
    PRODUCER_HEARTBEAT = 0x1017
    IDENTITY = 0x1018
    SYNC_COUNTER_OVERFLOW = 0x1019
    RPDO_PARAMETER = 0x1400
    RPDO_MAPPING = 0x1600
    TPDO_PARAMETER = 0x1800
    TPDO_MAPPING = 0x1A00
    ABORT_CONNECTION_OPTION = 0x6007
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    QUICK_STOP_OPTION = 0x605A
    FAULT_REACTION_OPTION = 0x605E
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION_DEMAND = 0x6062
    POSITION_ACTUAL = 0x6064
    FOLLOWING_ERROR_WINDOW = 0x6065
    FOLLOWING_ERROR_TIMEOUT = 0x6066
    VELOCITY_DEMAND = 0x606B
    VELOCITY_ACTUAL = 0x606C
    RATED_CURRENT = 0x6075
    RATED_TORQUE = 0x6076
    TORQUE_ACTUAL = 0x6077
    CURRENT_ACTUAL = 0x6078
    TARGET_POSITION = 0x607A
    QUICK_STOP_DECELERATION = 0x6085
    POSITION_ENCODER_RESOLUTION = 0x608F
    GEAR_RATIO = 0x6091
    FEED_CONSTANT = 0x6092
    POSITION_OFFSET = 0x60B0
    VELOCITY_OFFSET = 0x60B1
    TORQUE_OFFSET = 0x60B2
    INTERPOLATION_PERIOD = 0x60C2
    VELOCITY_UNIT = 0x60A9
    FOLLOWING_ERROR = 0x60F4
    DIGITAL_INPUTS = 0x60FD
    SUPPORTED_MODES = 0x6502


LOGICAL_AXIS_STEP = 0x800
"""Index distance of the objects of two axes of one device (CiA 402-2; 0x6000 to 0x67FF are the first axis')."""
LOGICAL_AXES = range(1, 9)


def get_first_axis_index(index: int) -> int:
    """Return the index of the same object on the first axis of its device.

    >>> hex(get_first_axis_index(0x68B0))
    '0x60b0'
    """
    return 0x6000 + (index - 0x6000) % LOGICAL_AXIS_STEP if 0x6000 <= index < 0xA000 else index


class PowerState(Enum):
    """States of the CiA 402 power state machine."""

    NOT_READY = "Not ready to switch on"
    SWITCH_ON_DISABLED = "Switch on disabled"
    READY = "Ready to switch on"
    SWITCHED_ON = "Switched on"
    OPERATION_ENABLED = "Operation enabled"
    QUICK_STOP_ACTIVE = "Quick stop active"
    FAULT_REACTION_ACTIVE = "Fault reaction active"
    FAULT = "Fault"


# (mask, value) of the statusword for each state, CiA 402-2 table 30
STATUS_PATTERN: tuple[tuple[int, int, PowerState], ...] = (
    (0x4F, 0x00, PowerState.NOT_READY),
    (0x4F, 0x40, PowerState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, PowerState.READY),
    (0x6F, 0x23, PowerState.SWITCHED_ON),
    (0x6F, 0x27, PowerState.OPERATION_ENABLED),
    (0x6F, 0x07, PowerState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, PowerState.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, PowerState.FAULT),
)

STATUS_INTERNAL_LIMIT = 1 << 11
STATUS_FOLLOWS_DEMAND = 1 << 12  # in CSP: the drive follows the demand value
STATUS_FOLLOWING_ERROR = 1 << 13

CONTROL_SHUTDOWN = 0x06
CONTROL_SWITCH_ON = 0x07
CONTROL_ENABLE_OPERATION = 0x0F
CONTROL_QUICK_STOP = 0x02
CONTROL_DISABLE_VOLTAGE = 0x00
CONTROL_FAULT_RESET = 0x80

# the next controlword on the way from a state to Operation enabled
_TOWARD_ENABLED = {
    PowerState.FAULT: CONTROL_FAULT_RESET,
    PowerState.SWITCH_ON_DISABLED: CONTROL_SHUTDOWN,
    PowerState.READY: CONTROL_SWITCH_ON,
    PowerState.SWITCHED_ON: CONTROL_ENABLE_OPERATION,
    PowerState.OPERATION_ENABLED: CONTROL_ENABLE_OPERATION,
    PowerState.QUICK_STOP_ACTIVE: CONTROL_DISABLE_VOLTAGE,
}


def decode_power_state(statusword: int) -> PowerState:
    """Return the power state that a 16 bit ``statusword`` shows.

    >>> decode_power_state(0x1237).value
    'Operation enabled'
    """
    for mask, value, state in STATUS_PATTERN:
        if statusword & mask == value:
            return state
    return PowerState.NOT_READY


def choose_enabling_controlword(state: PowerState) -> int | None:
    """Return the controlword that brings ``state`` one step nearer to Operation enabled; None: wait for the drive."""
    return _TOWARD_ENABLED.get(state)


@dataclass(frozen=True, slots=True)
class PdoEntry:
    """One mapped object of a PDO: index, sub-index, length in bits, signed or not, and its position in the frame."""

    index: int
    sub: int
    bits: int
    signed: bool
    bit_offset: int = 0

    @property
    def mapping(self) -> int:
        """The 32 bit value of a mapping object 0x16xx/0x1Axx: index << 16 | sub << 8 | bits."""
        return self.index << 16 | self.sub << 8 | self.bits


def lay_out(entries: Sequence[tuple[int, int, int, bool]]) -> tuple[PdoEntry, ...]:
    """Place (index, sub, bits, signed) one behind the other; ValueError when they exceed 64 bits."""
    placed, offset = [], 0
    for index, sub, bits, signed in entries:
        placed.append(PdoEntry(index, sub, bits, signed, offset))
        offset += bits
    if offset > 64:
        raise ValueError(f"a PDO holds 64 bits, not {offset}")
    return tuple(placed)


def compute_pdo_length(entries: Sequence[PdoEntry]) -> int:
    """Return the number of data bytes of a PDO with these entries."""
    return (sum(entry.bits for entry in entries) + 7) // 8


def unpack_pdo(entries: Sequence[PdoEntry], data: bytes) -> tuple[int, ...]:
    """Decode the mapped integers of one frame (little-endian, CiA 301 7.1.4); ValueError when it is too short."""
    if len(data) < compute_pdo_length(entries):
        raise ValueError(f"the PDO has {len(data)} bytes, its mapping needs {compute_pdo_length(entries)}")
    whole = int.from_bytes(data, "little")
    values = []
    for entry in entries:
        value = whole >> entry.bit_offset & (1 << entry.bits) - 1
        if entry.signed and value >> (entry.bits - 1):
            value -= 1 << entry.bits
        values.append(value)
    return tuple(values)


def pack_pdo(entries: Sequence[PdoEntry], values: Sequence[int]) -> bytes:
    """Encode integers into one frame; ValueError when a value is no integer or does not fit its entry."""
    whole = 0
    for entry, value in zip(entries, values, strict=True):
        low, high = (-(1 << entry.bits - 1), (1 << entry.bits - 1) - 1) if entry.signed else (0, (1 << entry.bits) - 1)
        if type(value) is not int or not low <= value <= high:  # a float or numpy integer would be cut silently
            raise ValueError(f"{value!r} does not fit the {entry.bits} bit object {entry.index:04X}:{entry.sub:02X}")
        whole |= (value & (1 << entry.bits) - 1) << entry.bit_offset
    return whole.to_bytes(compute_pdo_length(entries), "little")


INTEGER32 = (-(1 << 31), (1 << 31) - 1)


def compute_target_range(offset: int) -> tuple[int, int]:
    """Return the lowest and the highest target (0x607A) whose sum with an offset of either sign is an INTEGER32."""
    low, high = INTEGER32
    return low + offset, high - offset


@dataclass(frozen=True, slots=True)
class Scaling:
    """Between an axis' millimetres and its drive's position increments.

    ``sign`` is -1 where the drive counts in the opposite direction.
    """

    increments_per_rev: int
    screw_pitch_mm: float
    sign: int = 1

    @property
    def increments_per_mm(self) -> float:
        """Increments per millimetre of table travel."""
        return self.increments_per_rev / self.screw_pitch_mm

    def convert_to_increments(self, position_mm: float) -> int:
        """Round a position or offset in mm to drive increments; ValueError for NaN and infinities."""
        if not math.isfinite(position_mm):
            raise ValueError(f"{position_mm} mm is not a valid position")
        return round(self.sign * position_mm * self.increments_per_mm)

    def convert_to_mm(self, increments: float) -> float:
        """Return the position or offset in mm of a number of drive increments."""
        return self.sign * increments / self.increments_per_mm


# error classes of CiA 301, 7.2.7.1
_EMCY_CLASS = {
    0x10: "generic error",
    0x20: "current",
    0x30: "voltage",
    0x40: "temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x80: "monitoring",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
_EMCY_TEXT = {
    0x8110: "CAN overrun",
    0x8120: "CAN in error passive mode",
    0x8130: "heartbeat or life guarding lost",
    0x8140: "recovered from bus-off",
    0x8150: "COB-ID collision",
    0x8210: "PDO not processed, too short",
    0x8220: "PDO too long",
    0x8611: "following error",
}


def describe_emergency(code: int) -> str:
    """Return what an EMCY code means (CiA 301, table 26).

    >>> describe_emergency(0x8611)
    'following error'
    """
    if code in _EMCY_TEXT:
        return _EMCY_TEXT[code]
    high = code >> 8
    return _EMCY_CLASS.get(high, _EMCY_CLASS.get(high & 0xF0, "unknown"))
