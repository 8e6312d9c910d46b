"""Describes the simulated drive's default mapping, a sensible one for a real drive with a terminal-voltage object."""

from __future__ import annotations

from fdhil.drivers.cia402.profile import DriveProfile, pdo

PROFILE = DriveProfile(
    name="fdhil_twin",
    rpdos=(
        pdo("RPDO1", 0x200, [(0x6040, 0, 16, False), (0x607A, 0, 32, True)]),
        pdo("RPDO2", 0x300, [(0x60B0, 0, 32, True)]),
        pdo("RPDO3", 0x400, [(0x60B1, 0, 32, True), (0x60B2, 0, 16, True)], valid=False),
    ),
    tpdos=(
        pdo("TPDO1", 0x180, [(0x6064, 0, 32, True), (0x606C, 0, 32, True)]),
        pdo("TPDO2", 0x280, [(0x6041, 0, 16, False), (0x6078, 0, 16, True), (0x2101, 0, 16, True)]),
        pdo("TPDO3", 0x380, [(0x6062, 0, 32, True), (0x60B0, 0, 32, True)], every_sync=10),
        pdo("TPDO4", 0x480, [(0x60FD, 0, 32, False), (0x6061, 0, 8, True), (0x6077, 0, 16, True)], every_sync=10),
    ),
    voltage=(0x2101, 0),
    voltage_v_per_count=0.02,
)
