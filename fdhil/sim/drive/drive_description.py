"""Describes a drive for the ready event: its live PDO mapping and its bus load."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from fdhil.sim.drive.drive_objects import VOLTAGE_V_PER_COUNT, DriveRatings
from fdhil.sim.drive.object_dictionary import Entry

if TYPE_CHECKING:
    from fdhil.sim.drive.servo_drive import SimulatedDrive

OFFSETS = frozenset({0x60B000, 0x60B100, 0x60B200})
"""Mapped objects of which a position offset or a speed and torque offset are sent, never both."""


def list_units(ratings: DriveRatings) -> dict[int, tuple[str, float]]:
    """Return unit and scale by index: physical value = raw x scale, in the axis' direction."""
    position = ratings.sign / ratings.increments_per_mm
    speed = ratings.sign * 2 * math.pi / ratings.increments_per_rev
    current = ratings.sign * ratings.rated_current_a * 1e-3
    torque = ratings.sign * ratings.rated_torque_nm * 1e-3
    table = dict.fromkeys((0x6062, 0x6063, 0x6064, 0x607A, 0x60B0, 0x60F4, 0x60FC), ("mm", position))
    table |= dict.fromkeys((0x606B, 0x606C, 0x60B1), ("rad/s", speed))
    table |= dict.fromkeys((0x6071, 0x6077, 0x60B2), ("N.m", torque))
    table |= {0x6078: ("A", current), 0x2101: ("V", ratings.sign * VOLTAGE_V_PER_COUNT)}
    return table | {0x6079: ("V", 1e-3), 0x2110: ("degC", 0.01)}


def describe_mapping(drive: SimulatedDrive) -> dict[str, Any]:
    """Return the drive's entry of the ready event; the caller fills in ``eds``."""
    own = list_units(drive.ratings)
    shown = {signal.entry.key: signal.select_unit(drive.ratings.sign) for signal in drive.emulation.gauges}

    def find_unit(entry: Entry) -> tuple[str, float]:
        if entry.key in shown:
            return shown[entry.key]
        name, scale = own.get(entry.storage_key >> 8, ("", 1))
        return name, scale if entry.scale == 1.0 else scale * entry.scale

    def describe_pdos(direction: str) -> list[dict[str, Any]]:
        listed = []
        for pdo in drive.pdo.list_configured(direction):
            entries = drive.pdo.list_mapped_entries(direction, pdo.number)
            listed.append(
                {
                    "cob_id": pdo.cob_id,
                    "type": pdo.kind,
                    "entries": [
                        [entry.index, entry.sub, 8 * (entry.size or 0), *find_unit(entry)] for entry in entries
                    ],
                }
            )
        return listed

    return {
        "node_id": drive.node_id,
        "eds": "",
        "increments_per_mm": drive.ratings.increments_per_mm,
        "sync_counter": drive.dictionary.get_number(0x1019),
        "tpdo": describe_pdos("tpdo"),
        "rpdo": describe_pdos("rpdo"),
    }


def count_frame_bits(data_bytes: int, *, stuffed: bool = False) -> int:
    """Return the bits of a classic data frame with its interframe space; ``stuffed``: with the most stuff bits."""
    return 47 + 8 * data_bytes + ((34 + 8 * data_bytes - 1) // 4 if stuffed else 0)


def compute_bus_load(
    drive: SimulatedDrive, sync_rate_hz: float, bitrate: int = 1_000_000, *, stuffed: bool = False
) -> float:
    """Return the share of the bus taken by the drive's PDOs and heartbeat at this SYNC rate, without the SYNC itself.

    Event-driven PDOs count as one per SYNC. Of the RPDOs that carry offsets alone only the largest counts: a correction
    sends either a position offset or speed and torque offsets.
    """
    bits_per_s, corrections = 0.0, [0.0]
    for direction in ("rpdo", "tpdo"):
        for pdo in drive.pdo.list_configured(direction):
            every = pdo.kind if direction == "tpdo" and 1 <= pdo.kind <= 240 else 1
            load = count_frame_bits(pdo.codec.size, stuffed=stuffed) * sync_rate_hz / every
            if direction == "rpdo" and pdo.keys and OFFSETS.issuperset(pdo.keys):
                corrections.append(load)
            else:
                bits_per_s += load
    bits_per_s += max(corrections)
    heartbeat_ms = drive.dictionary.get_number(0x1017)
    if heartbeat_ms:
        bits_per_s += count_frame_bits(1, stuffed=stuffed) * 1e3 / heartbeat_ms
    return bits_per_s / bitrate
