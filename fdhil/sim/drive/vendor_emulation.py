"""Emulates a vendor's drive from its EDS: objects, types, access, defaults, PDOs, identity and units.

The EDS defines the objects; everything else does not exist. Which vendor objects report current, voltage or duty cycle,
and in which units, is not part of an EDS: the tables in ``vendor_drives`` define it by vendor number. They were written
from the vendors' documents, not from the profiles that the drivers read.
"""

import tomllib
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

from fdhil.config import MachineConfig, SimAxis
from fdhil.sim.drive.drive_objects import (
    DEVICE_NAME,
    PRODUCT_CODE,
    REVISION,
    VENDOR_ID,
    DriveRatings,
    compute_serial_number,
    list_drive_objects,
)
from fdhil.sim.drive.eds_file import EdsFile, read_eds_file
from fdhil.sim.drive.object_dictionary import DataType, DictionaryObject, Entry, ObjectDictionary, Value
from fdhil.sim.drive.operation_modes import CYCLIC, CYCLIC_POSITION, SUPPORTED_MODES

_MODES, _TARGET, _INTERPOLATION, _SPEED_UNIT = 0x650200, 0x607A00, 0x60C101, 0x60A900
_INTERPOLATED = 7
_VENDORS, _PROFILE, _AXIS_STEP = range(0x2000, 0x6000), range(0x6000, 0x6800), 0x800
_APART = 1 << 24  # storage of the vendor's values, separate from the simulator's own vendor objects
# A drive without these objects has no heartbeat and no SYNC counter. One without 0x6007 goes to Fault when it loses its
# master, like most drives: an EDS does not define it.
_NO_SERVICE = {0x101700: 0, 0x101900: 0}
# machine-specific objects: preset from the configuration, as no default of a file fits
_SET_UP = frozenset(
    index << 8 | sub
    for indices, subs in (
        (
            (0x1006, 0x6065, 0x6067, 0x606D, 0x606F, 0x6072, 0x6073, 0x6075, 0x6076, 0x607F, 0x6080, 0x6081, 0x6083),
            (0,),
        ),
        ((0x6084, 0x6085, 0x6087, 0x609A, 0x60C5, 0x60C6), (0,)),
        ((0x607D, 0x608F, 0x6091, 0x6092, 0x6099, 0x60C2), (1, 2)),
    )
    for index in indices
    for sub in subs
)
# speeds and accelerations share a unit: the speed unit, and that per second
_SPEEDS = frozenset(
    {
        0x606B, 0x606C, 0x606D, 0x606F, 0x607F, 0x6081, 0x6083, 0x6084, 0x6085, 0x6099, 0x609A, 0x60B1, 0x60C5, 0x60C6,
        0x60FF,
    }
)  # fmt: skip
# revolutions/s and increments/s to a count; a millisecond's increments come as 16.16 fixed-point numbers
_SPEED_UNITS = {"increments_per_s": (0.0, 1.0), "rpm": (1 / 60, 0.0), "increments_per_ms_16": (0.0, 1e3 / 65536)}
# unit codes of 0x60A9 (CiA 303-2): revolutions, increments; seconds, minutes
_REVOLUTIONS, _INCREMENTS, _PER = 0xB4, 0xB5, {0x03: 1.0, 0x47: 1 / 60}
_UNITS = {"current_a": "A", "current_share": "", "voltage_v": "V", "dc_link_v": "V", "duty": ""}


@dataclass(frozen=True, slots=True)
class VendorSignal:
    """An object that reports a signal (of ``_UNITS``), ``per_count`` of its unit; ``magnitude``: without its sign."""

    entry: Entry
    signal: str
    per_count: float
    magnitude: bool = False

    def convert_to_counts(self, value: float) -> int:
        return self.entry.convert_to_counts(round((abs(value) if self.magnitude else value) / self.per_count))

    def select_unit(self, sign: int) -> tuple[str, float]:
        """Return unit and amount per count in the direction of an axis with this sign."""
        sided = not self.magnitude and self.signal != "dc_link_v"
        return _UNITS[self.signal], sign * self.per_count if sided else self.per_count


@dataclass(frozen=True, slots=True)
class VendorEmulation:
    """The drive as visible on the wire; without an EDS its own objects.

    ``within``: entries that the drive uses and does not expose. ``gauges``: objects that report a signal in the
    vendor's units. ``mode``: the mode for set-points at every SYNC; it has the vendor's number where there is no cyclic
    synchronous position. ``mode_index``: the object to write it to.
    """

    objects: tuple[DictionaryObject, ...]
    vendor: int = VENDOR_ID
    product: int = PRODUCT_CODE
    revision: int = REVISION
    name: str = DEVICE_NAME.decode()
    within: tuple[Entry, ...] = ()
    gauges: tuple[VendorSignal, ...] = ()
    mode: int = CYCLIC_POSITION
    mode_index: int = 0x6060


@dataclass(frozen=True, slots=True)
class VendorTable:
    """A file of ``vendor_drives``: a vendor's units, and the objects that report measured signals.

    ``rated_torque_nm``: unit of 0x6076. ``rated_current``: the vendor's own object for it. ``setpoint``: object and
    mode of cyclic set-points of drives without cyclic synchronous position.
    """

    vendor: int = 0
    speed: str = "increments_per_s"
    rated_torque_nm: float = 1e-3
    measured: tuple[Mapping[str, Any], ...] = ()
    rated_current: Mapping[str, Any] | None = None
    setpoint: Mapping[str, Any] | None = None


def emulate_vendor(config: MachineConfig, axis: str) -> VendorEmulation:
    """Return the emulation for the axis' drive; EdsError when its EDS cannot be read."""
    own = list_drive_objects(config, axis)
    path = config.sim.axis.get(axis, SimAxis()).eds
    if path is None:
        return VendorEmulation(own)
    ratings = DriveRatings.read_from_config(config, axis)
    exchange = _AxisShift(_AXIS_STEP * (config.axis[axis].drive.logical_axis - 1))
    sheet = exchange.shift_eds(read_eds_file(path, ratings.node_id))
    tailor = _ObjectAdapter(sheet, own, ratings, load_vendor_table(sheet.vendor), compute_serial_number(config, axis))
    return exchange.restore_indices(tailor.adapt_objects())


@cache
def load_vendor_table(vendor: int) -> VendorTable:
    """Return the table of a vendor; plain CiA 402 for a vendor without one."""
    for file in sorted(files("fdhil.sim.drive").joinpath("vendor_drives").iterdir(), key=lambda file: file.name):
        if file.name.endswith(".toml"):
            message = tomllib.loads(file.read_text("utf-8"))
            if message["vendor"] == vendor:
                return VendorTable(**{**message, "measured": tuple(message.get("measured", ()))})
    return VendorTable()


def convert_speed_unit(unit: Value, cut: VendorTable, ratings: DriveRatings) -> float:
    """Return the unit of the drive's speeds: from 0x60A9 where it is set, else the vendor's."""
    revolutions, increments = _SPEED_UNITS[cut.speed]
    word = unit if isinstance(unit, int) else 0
    kind, per, power = word >> 16 & 0xFF, word >> 8 & 0xFF, (word >> 24 ^ 0x80) - 0x80
    if kind in (_REVOLUTIONS, _INCREMENTS) and per in _PER:
        share = _PER[per] * 10.0**power
        revolutions, increments = (share, 0.0) if kind == _REVOLUTIONS else (0.0, share)
    return revolutions * ratings.increments_per_rev + increments


def track_speed_unit(dictionary: ObjectDictionary, worn: VendorEmulation, ratings: DriveRatings) -> None:
    """Rescale the speeds whenever 0x60A9 is written or restored."""
    if not any(entry.storage_key == _SPEED_UNIT for entry in dictionary.entries.values()):
        return

    def rescale_speeds(_unit: int = 0) -> None:
        scale = convert_speed_unit(dictionary.numbers[_SPEED_UNIT], load_vendor_table(worn.vendor), ratings)
        for key, entry in dictionary.entries.items():
            if entry.storage_key >> 8 in _SPEEDS and not _is_sub_index_count(entry, dictionary.entries):
                assert isinstance(entry.default, int)
                default = replace(entry, scale=scale).convert_to_counts(entry.convert_from_counts(entry.default))
                dictionary.entries[key] = replace(entry, scale=scale, default=default)

    dictionary.write_hooks[_SPEED_UNIT] = rescale_speeds
    dictionary.restore_hooks.append(rescale_speeds)


@dataclass(frozen=True, slots=True)
class _AxisShift:
    """Swaps the objects of another axis of the device, ``step`` higher, with those of the first."""

    step: int

    def _shift_index(self, index: int) -> int:
        if _PROFILE.start <= index - self.step < _PROFILE.stop:
            return index - self.step
        return index + self.step if index in _PROFILE else index

    def shift_eds(self, sheet: EdsFile) -> EdsFile:
        objects = [
            replace(item, index=at, entries=tuple(replace(entry, index=at) for entry in item.entries))
            for item in sheet.objects
            for at in (self._shift_index(item.index),)
        ]
        given = frozenset(self._shift_index(key >> 8) << 8 | key & 0xFF for key in sheet.given)
        return replace(sheet, objects=tuple(sorted(objects, key=lambda item: item.index)), given=given)

    def restore_indices(self, worn: VendorEmulation) -> VendorEmulation:
        """Return the emulation under the indices of its axis; the drive's own values stay in place."""
        if not self.step:
            return worn
        objects = [
            replace(item, index=self._shift_index(item.index), entries=tuple(map(self._restore_entry, item.entries)))
            for item in worn.objects
        ]
        gauges = tuple(replace(gauge, entry=self._restore_entry(gauge.entry)) for gauge in worn.gauges)
        objects.sort(key=lambda item: item.index)
        return replace(worn, objects=tuple(objects), gauges=gauges, mode_index=self._shift_index(worn.mode_index))

    def _restore_entry(self, entry: Entry) -> Entry:
        return replace(entry, index=self._shift_index(entry.index), home=entry.storage_key)


class _ObjectAdapter:
    def __init__(
        self, sheet: EdsFile, own: tuple[DictionaryObject, ...], ratings: DriveRatings, cut: VendorTable, serial: int
    ) -> None:
        self._sheet, self._ratings, self._cut = sheet, ratings, cut
        self._own = {entry.key: entry for item in own for entry in item.entries}
        self._identity = {0x101801: sheet.vendor, 0x101802: sheet.product, 0x101803: sheet.revision, 0x101804: serial}
        self._entries = {entry.key: entry for item in sheet.objects for entry in item.entries}
        unit = self._entries[_SPEED_UNIT].default if _SPEED_UNIT in sheet.given else 0
        self._speed = convert_speed_unit(unit, cut, ratings)
        self._setpoint, self._mode = self._find_cyclic_setpoint()
        self._modes = self._list_mode_bits()

    def _find_cyclic_setpoint(self) -> tuple[int | None, int]:
        """Return the object of cyclic set-points where it is not 0x607A, and their mode."""
        message = self._cut.setpoint
        if message is not None and (message["object"][0] << 8 | message["object"][1]) in self._entries:
            return message["object"][0] << 8 | message["object"][1], message["mode"]
        bits = self._entries[_MODES].default if _MODES in self._sheet.given else 1 << CYCLIC_POSITION - 1
        assert isinstance(bits, int)
        interpolated = bits >> _INTERPOLATED - 1 & 1 and not bits >> CYCLIC_POSITION - 1 & 1
        return (_INTERPOLATION, _INTERPOLATED) if interpolated and _INTERPOLATION in self._entries else (None, 8)

    def _list_mode_bits(self) -> int:
        """Return the mode bits of 0x6502: those of the file, else those of the simulated drive."""
        if _MODES in self._sheet.given:
            bits = self._entries[_MODES].default
            assert isinstance(bits, int)
            return bits
        if self._setpoint is None:
            return SUPPORTED_MODES
        own = SUPPORTED_MODES & ~sum(1 << mode - 1 for mode in CYCLIC)
        return own | (1 << self._mode - 1 if self._mode > 0 else 0)

    def adapt_objects(self) -> VendorEmulation:
        objects = tuple(
            replace(item, entries=tuple(map(self._adapt_entry, item.entries))) for item in self._sheet.objects
        )
        worn = {entry.storage_key for item in objects for entry in item.entries}
        entries = {entry.key: entry for item in objects for entry in item.entries}
        return VendorEmulation(
            objects, self._sheet.vendor, self._sheet.product, self._sheet.revision, self._sheet.name,
            tuple(self._hide_entry(entry) for key, entry in self._own.items() if key not in worn),
            tuple(self._find_vendor_signals(entries)), self._mode,
        )  # fmt: skip

    def _adapt_entry(self, entry: Entry) -> Entry:
        if entry.key == self._setpoint:
            return replace(entry, home=_TARGET, default=0, low=None, high=None)
        own = self._own.get(entry.key)
        if entry.index in _VENDORS or (own is not None and not _has_compatible_type(entry, own)):
            return self._adapt_vendor_entry(entry)
        if entry.key in (0x606000, 0x606100):
            entry = self._adapt_mode(entry)
        if entry.key == _MODES and self._mode != CYCLIC_POSITION:
            entry = replace(entry, renamed=(self._modes, self._modes | 1 << CYCLIC_POSITION - 1))
        scale = self._choose_scale(entry) if own is not None else 1.0
        entry = replace(entry, scale=scale, default=self._choose_default(entry, own, scale))
        if entry.key in _SET_UP:
            return replace(entry, low=None, high=None)
        # CiA 301 objects keep the standard's limits; real files forbid values that their devices must accept
        return replace(entry, low=own.low, high=own.high) if own is not None and entry.index < 0x2000 else entry

    def _adapt_mode(self, entry: Entry) -> Entry:
        """Restrict the modes to those of the EDS; its cyclic mode maps to cyclic synchronous position."""
        modes = {mode for mode in range(1, 33) if self._modes & SUPPORTED_MODES >> mode - 1 & 1}
        renamed = None if self._mode == CYCLIC_POSITION else (self._mode, CYCLIC_POSITION)
        return replace(entry, choice=frozenset(modes | {0} | ({self._mode} if renamed else set())), renamed=renamed)

    def _adapt_vendor_entry(self, entry: Entry) -> Entry:
        entry = replace(entry, home=entry.key | _APART)
        rated = self._cut.rated_current
        if rated is None or rated["object"] != [entry.index, entry.sub]:
            return entry
        return replace(entry, default=round(self._ratings.rated_current_a / rated["per_count"]), low=None, high=None)

    def _choose_default(self, entry: Entry, own: Entry | None, scale: float) -> Value:
        given = entry.key in self._sheet.given
        if entry.key == _MODES:
            return self._modes
        if entry.key in self._identity and not (given and entry.default):
            return self._identity[entry.key]
        if entry.index == 0x1008 and not given:
            return self._sheet.name.encode("latin-1", "replace")
        if entry.index in range(0x1600, 0x1800) or entry.index in range(0x1A00, 0x1C00):
            return entry.default if given or entry.sub else self._count_mapped_objects(entry.index)
        if own is None:
            return entry.default
        if given and entry.key not in _SET_UP:
            return entry.default
        if isinstance(own.default, int):
            return replace(entry, scale=scale).convert_to_counts(own.default)
        return own.default

    def _count_mapped_objects(self, index: int) -> int:
        """Return the number of mapped objects of a PDO whose file does not state it."""
        item = next(item for item in self._sheet.objects if item.index == index)
        return sum(1 for entry in item.entries if entry.sub and entry.default)

    def _choose_scale(self, entry: Entry) -> float:
        if entry.index in _SPEEDS and not _is_sub_index_count(entry, self._entries):
            return self._speed
        return self._cut.rated_torque_nm * 1e3 if entry.index == 0x6076 else 1.0

    def _hide_entry(self, entry: Entry) -> Entry:
        return replace(entry, default=_NO_SERVICE.get(entry.key, entry.default))

    def _find_vendor_signals(self, entries: Mapping[int, Entry]) -> Iterator[VendorSignal]:
        for message in self._cut.measured:
            index, sub = message["object"]
            entry = entries.get(index << 8 | sub)
            if entry is not None:
                yield VendorSignal(entry, message["signal"], message["per_count"], message.get("magnitude", False))


def _has_compatible_type(entry: Entry, own: Entry) -> bool:
    reals = (DataType.REAL32, DataType.REAL64)
    return entry.type not in reals and (entry.size is None) == (own.size is None)


def _is_sub_index_count(entry: Entry, entries: Container[int]) -> bool:
    return entry.sub == 0 and entry.key | 1 in entries
