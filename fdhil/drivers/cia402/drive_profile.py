"""Describes a drive model as data: its PDOs, the objects of its signals, and their units.

A new vendor is a TOML file with the names of :class:`DriveProfile` (``drive_profile_file`` reads it). An object that no
PDO of the profile carries is not used: without ``offset`` (0x60B0) the drive is recorded but never corrected on line;
without ``voltage`` a separate sensor is needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from fdhil.cia402 import LOGICAL_AXIS_STEP, Mode, Object, PdoEntry, compute_pdo_length
from fdhil.config import Axis, SpeedUnit

ObjectKey = tuple[int, int]
"""Index and sub-index."""
LOGICAL_AXIS_PDOS = 64
"""Distance between the PDO numbers of two axes of one device (CiA 402-3)."""


@dataclass(frozen=True, slots=True)
class PdoSpec:
    """One PDO: its COB-ID is ``cob_base`` + node-ID; it comes with every ``every_sync``-th SYNC.

    ``number`` is its position in the communication parameters (1 -> 0x1400/0x1800), in a profile's file the digits at
    the end of its name ("RPDO1"). ``valid`` is False when bit 31 of the default COB-ID is set: mapped, but not
    exchanged.
    """

    name: str
    number: int
    cob_base: int
    entries: tuple[PdoEntry, ...]
    every_sync: int = 1
    valid: bool = True

    @property
    def length(self) -> int:
        """Bytes of a complete frame."""
        return compute_pdo_length(self.entries)

    def find_entry(self, key: ObjectKey) -> PdoEntry | None:
        """Return the entry that maps ``key``, or None."""
        return next((e for e in self.entries if (e.index, e.sub) == key), None)


@dataclass(frozen=True, slots=True)
class DriveProfile:
    """A drive model: mapping, signals and units.

    ``speed_unit`` and ``current_unit`` are the units of the speed and the current object, ``speed_factor`` and
    ``current_factor`` how many of these one count is. ``voltage`` is the TPDO object of the terminal voltage:
    ``voltage_v_per_count`` is its scale, or, where it is the duty of the PWM, ``duty_per_count`` is its scale in shares
    of the DC link, which is in a TPDO (``dc_link``, ``dc_link_v_per_count``) or else in the configuration
    (``drive.dc_link_v``). ``voltage_magnitude``: it is unsigned, and gets the sign of R i + K w. ``mode`` is the one in
    which set-points are streamed to ``target``. ``strict_abort_options`` are the values of 0x6007 that stop the drive
    when communication is lost. ``vendor_id`` and ``product_code`` None: any. ``logical_axis`` is the axis of a device
    with several of them. ``notes`` are shown when the profile is chosen.
    """

    name: str
    rpdos: tuple[PdoSpec, ...]
    tpdos: tuple[PdoSpec, ...]
    title: str = ""
    notes: tuple[str, ...] = ()
    controlword: ObjectKey = (0x6040, 0)
    target: ObjectKey = (0x607A, 0)
    offset: ObjectKey = (0x60B0, 0)
    speed_offset: ObjectKey = (0x60B1, 0)
    torque_offset: ObjectKey = (0x60B2, 0)
    position: ObjectKey = (0x6064, 0)
    speed: ObjectKey = (0x606C, 0)
    current: ObjectKey = (0x6078, 0)
    statusword: ObjectKey = (0x6041, 0)
    mode: int = Mode.CYCLIC_SYNC_POSITION
    position_demand: ObjectKey = (0x6062, 0)
    digital_inputs: ObjectKey = (0x60FD, 0)
    voltage: ObjectKey | None = None
    voltage_v_per_count: float = 0.0
    duty_per_count: float = 0.0
    voltage_magnitude: bool = False
    dc_link: ObjectKey | None = None
    dc_link_v_per_count: float = 0.0
    speed_unit: SpeedUnit = "increments_per_s"
    speed_factor: float = 1.0
    current_unit: Literal["permille_of_rated", "share_of_rated", "permille_of_rated_torque", "mA"] = "permille_of_rated"
    current_factor: float = 1.0
    strict_abort_options: tuple[int, ...] = (1, 3)
    vendor_id: int | None = None
    product_code: int | None = None
    logical_axis: int = 1

    @property
    def missing_signals(self) -> tuple[str, ...]:
        """The signals that must come in a valid TPDO with every SYNC, and do not."""
        names = ("position", "speed", "current", "statusword")
        found = {name: self.find_tpdo(getattr(self, name)) for name in names}
        return tuple(name for name, at in found.items() if at is None or not at[0].valid or at[0].every_sync != 1)

    @property
    def can_take_offset(self) -> bool:
        """Whether an offset can be sent and read back; otherwise a correction can only go through the NC."""
        found = self.find_rpdo(self.offset)
        return found is not None and found[0].valid and not self.unmapped_read_backs

    @property
    def unmapped_read_backs(self) -> tuple[ObjectKey, ...]:
        """Those of offset, mode and demand that no TPDO carries: nothing is sent whose effect cannot be read back."""
        keys = (self.offset, (self.shift_object_index(Object.MODE_DISPLAY), 0), self.position_demand)
        return tuple(key for key in keys if self.find_tpdo(key) is None)

    def find_tpdo(self, key: ObjectKey) -> tuple[PdoSpec, PdoEntry] | None:
        """Return the TPDO and entry that carry ``key``, or None."""
        return _find_entry(self.tpdos, key)

    def find_rpdo(self, key: ObjectKey) -> tuple[PdoSpec, PdoEntry] | None:
        """Return the RPDO and entry that carry ``key``, or None."""
        return _find_entry(self.rpdos, key)

    def shift_object_index(self, index: int) -> int:
        """Return the index of CiA 402's object ``index`` on this axis of its device."""
        return index + (self.logical_axis - 1) * LOGICAL_AXIS_STEP if 0x6000 <= index < 0x6800 else index

    def enable_feedforward(self) -> DriveProfile:
        """Return the profile with the RPDO of speed and torque offset enabled."""
        found = self.find_rpdo(self.speed_offset)
        rpdos = tuple(replace(spec, valid=True) if found and spec is found[0] else spec for spec in self.rpdos)
        return replace(self, rpdos=rpdos)

    def compute_speed_scale(self, axis: Axis) -> float:
        """Return the scale of the speed object, including the axis' sign."""
        per_unit = {
            "increments_per_s": 2 * math.pi / axis.drive.increments_per_rev,
            "rpm": 2 * math.pi / 60,
            "millirpm": 2 * math.pi / 60_000,
        }[axis.drive.speed_unit or self.speed_unit]
        return axis.drive.sign * self.speed_factor * per_unit

    def compute_current_scale(self, axis: Axis) -> float:
        """Return the scale of the current object, with the axis' sign; a torque is divided by the data sheet's K."""
        per_unit = {
            "permille_of_rated": axis.drive.rated_current_a / 1000,
            "share_of_rated": axis.drive.rated_current_a,
            "permille_of_rated_torque": axis.drive.rated_torque_nm / axis.nominal.K / 1000,
            "mA": 1e-3,
        }[self.current_unit]
        return axis.drive.sign * self.current_factor * per_unit

    def compute_voltage_scale(self, axis: Axis) -> float:
        """Return the scale of the voltage object, including the axis' sign; 0 where the drive does not send its
        voltage.

        Where a TPDO carries the DC link it is the scale of the product of both objects' counts.
        """
        if not self.voltage_objects:
            return 0.0
        link_v = self.dc_link_v_per_count if self._has_dc_link_tpdo else axis.drive.dc_link_v or 0.0
        return axis.drive.sign * (self.voltage_v_per_count or self.duty_per_count * link_v)

    @property
    def voltage_objects(self) -> tuple[ObjectKey, ...]:
        """The TPDO objects whose product is the terminal voltage; empty where the drive does not send it."""
        if self.voltage is None or self.find_tpdo(self.voltage) is None:
            return ()
        return (self.voltage, self.dc_link) if self.dc_link is not None and self._has_dc_link_tpdo else (self.voltage,)

    @property
    def _has_dc_link_tpdo(self) -> bool:
        return self.duty_per_count > 0 and self.dc_link is not None and self.find_tpdo(self.dc_link) is not None


def decode_speed_unit(word: int | None) -> SpeedUnit | None:
    """Decode the unit in 0x60A9: prefix, numerator and denominator of CiA 303-2; None for any other.

    >>> decode_speed_unit(0x00B44700), decode_speed_unit(0xFDB44700), decode_speed_unit(0x00B50300)
    ('rpm', 'millirpm', 'increments_per_s')
    """
    units: dict[int | None, SpeedUnit] = {0x00B44700: "rpm", 0xFDB44700: "millirpm", 0x00B50300: "increments_per_s"}
    return units.get(word)


def _find_entry(pdos: Sequence[PdoSpec], key: ObjectKey) -> tuple[PdoSpec, PdoEntry] | None:
    for spec in pdos:
        entry = spec.find_entry(key)
        if entry is not None:
            return spec, entry
    return None
