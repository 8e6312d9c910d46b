"""Describes drive models as data: their PDOs, which object carries which signal, and in which unit.

A new vendor is a new TOML file in ``profiles``, with the names of :class:`DriveProfile`, and a line in
``tables.DRIVE_PROFILES``.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any, Literal

from fdhil import tables
from fdhil.cia402 import PdoEntry, lay_out, pdo_length
from fdhil.config import Axis

ObjectKey = tuple[int, int]
"""Index and sub-index."""


@dataclass(frozen=True, slots=True)
class PdoSpec:
    """One PDO: its COB-ID is ``cob_base`` + node-ID; it comes with every ``every_sync``-th SYNC.

    ``number`` is its place in the communication parameters (1 -> 0x1400/0x1800), in a profile's file the last character
    of its name ("RPDO1"). ``valid`` is False when the drive's
    default has bit 31 of the COB-ID set: mapped, but not exchanged.
    """

    name: str
    number: int
    cob_base: int
    entries: tuple[PdoEntry, ...]
    every_sync: int = 1
    valid: bool = True

    @property
    def length(self) -> int:
        """Data bytes of a complete frame."""
        return pdo_length(self.entries)

    def entry(self, key: ObjectKey) -> PdoEntry | None:
        """Return the entry that maps ``key``, or None."""
        return next((e for e in self.entries if (e.index, e.sub) == key), None)


@dataclass(frozen=True, slots=True)
class DriveProfile:
    """A drive model: mapping, signals and units.

    ``voltage`` is the object of the terminal voltage, None when the drive has none; ``voltage_v_per_count`` its scale.
    ``speed_unit`` and ``current_unit`` say what 606C and the current object count in. ``strict_abort_options`` are
    the values of 0x6007 that stop the drive when communication is lost. ``vendor_id`` and ``product_code`` None: any.
    """

    name: str
    rpdos: tuple[PdoSpec, ...]
    tpdos: tuple[PdoSpec, ...]
    target: ObjectKey = (0x607A, 0)
    offset: ObjectKey = (0x60B0, 0)
    speed_offset: ObjectKey = (0x60B1, 0)
    torque_offset: ObjectKey = (0x60B2, 0)
    position: ObjectKey = (0x6064, 0)
    speed: ObjectKey = (0x606C, 0)
    current: ObjectKey = (0x6078, 0)
    statusword: ObjectKey = (0x6041, 0)
    position_demand: ObjectKey = (0x6062, 0)
    digital_inputs: ObjectKey = (0x60FD, 0)
    voltage: ObjectKey | None = None
    voltage_v_per_count: float = 0.0
    speed_unit: Literal["increments_per_s", "rpm", "millirpm"] = "increments_per_s"
    current_unit: Literal["permille_of_rated", "mA"] = "permille_of_rated"
    strict_abort_options: tuple[int, ...] = (1, 3)
    vendor_id: int | None = None
    product_code: int | None = None

    def find_tpdo(self, key: ObjectKey) -> tuple[PdoSpec, PdoEntry] | None:
        """Return the TPDO and entry that carry ``key``, or None."""
        return _find(self.tpdos, key)

    def find_rpdo(self, key: ObjectKey) -> tuple[PdoSpec, PdoEntry] | None:
        """Return the RPDO and entry that carry ``key``, or None."""
        return _find(self.rpdos, key)

    def with_feedforward(self) -> DriveProfile:
        """Return the profile of a drive whose RPDO of speed and torque offset is exchanged."""
        found = self.find_rpdo(self.speed_offset)
        rpdos = tuple(replace(spec, valid=True) if found and spec is found[0] else spec for spec in self.rpdos)
        return replace(self, rpdos=rpdos)

    def speed_rad_s_per_count(self, axis: Axis) -> float:
        """Scale of the speed object, the axis' sign included."""
        per_count = {
            "increments_per_s": 2 * math.pi / axis.drive.increments_per_rev,
            "rpm": 2 * math.pi / 60,
            "millirpm": 2 * math.pi / 60_000,
        }[self.speed_unit]
        return axis.drive.sign * per_count

    def current_a_per_count(self, axis: Axis) -> float:
        """Scale of the current object, the axis' sign included."""
        per_count = {"permille_of_rated": axis.drive.rated_current_a / 1000, "mA": 1e-3}[self.current_unit]
        return axis.drive.sign * per_count


def _find(pdos: Sequence[PdoSpec], key: ObjectKey) -> tuple[PdoSpec, PdoEntry] | None:
    for spec in pdos:
        entry = spec.entry(key)
        if entry is not None:
            return spec, entry
    return None


@cache
def load_profile(name: str) -> DriveProfile:
    """Read the file that ``tables.DRIVE_PROFILES`` lists under ``name``; TypeError for a key that no profile has."""
    package, _, file = tables.DRIVE_PROFILES[name].partition(":")
    document = tomllib.loads((files(package) / file).read_text("utf-8"))
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in document.items()
    }
    values |= {kind: tuple(_pdo(**each) for each in document[kind]) for kind in ("rpdos", "tpdos")}
    return DriveProfile(name, **values)


def _pdo(name: str, entries: Sequence[tuple[int, int, int, bool]], **said: Any) -> PdoSpec:
    """Lay the entries (index, sub-index, bits, signed) out; the PDO's number is its name's last character."""
    return PdoSpec(name, int(name[-1]), entries=lay_out(entries), **said)
