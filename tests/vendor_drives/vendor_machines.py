"""Shared by the tests of this folder: which profile belongs to which EDS, and the set-up by the vendor's tool."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.drivers.cia402.drive_profile import PdoSpec
from fdhil.drivers.cia402.drive_profile_file import load_profile
from tests.bench import bench_axis
from tests.eds import write_eds
from tests.sim.bench_simulator import SteppedSimulator
from tests.sim.drive_rig import NO_NOISE, DriveRig

INVALID = 1 << 31
MILLIRPM = 0xFDB44700  # as 0x60A9 has it
Write = Callable[[int, int, int, int], None]
"""Index, sub-index, value, bytes."""


@dataclass(frozen=True)
class VendorDrive:
    """A profile with the EDS of a drive that it is for; ``drive`` holds further keys of [axis.X.drive]."""

    profile: str
    sheet: str
    on_line: bool = False  # whether an offset can correct it
    drive: Mapping[str, Any] = field(default_factory=dict)
    lacks: tuple[str, ...] = ()  # the points of a check that such a drive cannot meet
    led: bool = True  # whether an NC can stream set-points to it
    narrow: bool = False  # whether its current does not reach what the bench's rapid takes

    @property
    def name(self) -> str:
        return self.profile if self.profile == self.sheet else f"{self.profile}-{self.sheet}"


NO_CSP, NO_VOLTAGE = ("mode",), ("voltage",)
OUTFITS = (
    VendorDrive("epos4", "epos4", on_line=True, drive={"dc_link_v": 300.0, "speed_unit": "millirpm"}),
    VendorDrive("epos2", "epos2", narrow=True, lacks=(*NO_CSP, *NO_VOLTAGE)),
    VendorDrive("nanotec", "nanotec", on_line=True, lacks=NO_VOLTAGE),
    VendorDrive("elmo", "elmo", on_line=True, lacks=NO_VOLTAGE),
    VendorDrive("technosoft", "technosoft", narrow=True, lacks=NO_VOLTAGE),
    VendorDrive("trinamic", "trinamic", narrow=True, lacks=NO_VOLTAGE),
    VendorDrive("faulhaber", "faulhaber", drive={"dc_link_v": 300.0}, led=False, lacks=NO_CSP),
    VendorDrive("schunk", "schunk", lacks=(*NO_CSP, *NO_VOLTAGE)),
    VendorDrive("infranor", "infranor", lacks=(*NO_CSP, *NO_VOLTAGE, "heartbeat")),
    VendorDrive("roboteq", "roboteq", led=False, lacks=NO_CSP),
    VendorDrive("cia402", "elmo", on_line=True, lacks=NO_VOLTAGE),
    VendorDrive("cia402", "ingenia", lacks=NO_VOLTAGE),
    VendorDrive("cia402", "two_axes", on_line=True, drive={"logical_axis": 2}, lacks=NO_VOLTAGE),
)
LED = pytest.mark.parametrize("outfit", [o for o in OUTFITS if o.led], ids=lambda outfit: outfit.name)
GENTLE_MM_S2 = 400.0


def get_node(outfit: VendorDrive, place: int) -> dict[str, int]:
    """Return the node-ID of a device with two axes: its second axis has the PDO identifiers of the next node."""
    return {"node_id": 1 + 2 * place} if "logical_axis" in outfit.drive else {}


def build_vendor_config(
    outfit: VendorDrive, folder: Path, axes: str = "X", *, noise: bool = False, **sections: Any
) -> MachineConfig:
    """Return the bench with drives of this vendor, simulated from their EDS."""
    eds = write_eds(outfit.sheet, folder)
    drive = {"profile": outfit.profile, **outfit.drive} | ({"eds": str(eds)} if outfit.profile == "cia402" else {})
    rapid: dict[str, Any] = {"max_acceleration_mm_s2": GENTLE_MM_S2} if outfit.narrow else {}
    document: dict[str, Any] = {
        "machine": {"name": "bench"},
        "axis": {axis: bench_axis(drive=drive | get_node(outfit, k), **rapid) for k, axis in enumerate(axes)},
        "sim": {"axis": {axis: {"eds": str(eds)} for axis in axes}} | ({} if noise else {"noise": NO_NOISE}),
        "guard": {"clock": "sync"},
        **sections,
    }
    return machine_config.parse_config(document, folder=folder)


def start_drives(config: MachineConfig) -> SteppedSimulator:
    """Return the machine with its drives set up and enabled."""
    twin = SteppedSimulator(config)
    for axis, unit in twin.machine.units.items():
        set_up_drive(
            config, axis, unit.drive.dictionary.indices.__contains__, DriveRig.wrap_drive(unit.drive).write_object
        )
    twin.switch_on()
    return twin


def set_up_drive(config: MachineConfig, axis: str, has: Callable[[int], bool], write: Write) -> None:
    """Map the PDOs as the profile has them, as the vendor's tool does, and enable the drive's SYNC monitoring."""
    profile, node_id = load_profile(config.axis[axis].drive), config.get_node_id(axis)
    for base, specs in ((0x1400, profile.rpdos), (0x1800, profile.tpdos)):
        for number in (*range(1, 5), *range(65, 69)):
            spec = next((spec for spec in specs if spec.number == number), None)
            if has(base + number - 1):
                _map(base + number - 1, spec, node_id, write)
    if config.axis[axis].drive.speed_unit == "millirpm":
        write(0x60A9, 0, MILLIRPM, 4)
    up = 0x800 * (config.axis[axis].drive.logical_axis - 1)
    for index, value, size in ((0x1017, 100, 2), (0x6007 + up, 1, 2), (0x605A + up, 2, 2), (0x605E + up, 2, 2)):
        if has(index):
            write(index, 0, value, size)


def _map(index: int, spec: PdoSpec | None, node_id: int, write: Write) -> None:
    """CiA 301, 7.5.2.36: disable, map, enable."""
    cob_id = (0x200 if index < 0x1800 else 0x180) + 0x100 * (index & 3) + node_id if spec is None else 0
    if spec is not None:
        cob_id = spec.cob_base + node_id
    write(index, 1, cob_id | INVALID, 4)
    if spec is None:
        return
    write(index, 2, spec.every_sync, 1)
    write(index + 0x200, 0, 0, 1)
    for sub, entry in enumerate(spec.entries, 1):
        write(index + 0x200, sub, entry.mapping, 4)
    write(index + 0x200, 0, len(spec.entries), 1)
    if spec.valid:
        write(index, 1, cob_id, 4)
