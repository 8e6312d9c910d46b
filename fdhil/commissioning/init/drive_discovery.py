"""Find the drives on a bus and read, by SDO, what a configuration needs of them. Nothing is written to a drive.

If an NC runs the bus nothing is sent at all; then only the drives' node-IDs are known.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fdhil import tables
from fdhil.cia402 import LOGICAL_AXIS_STEP, Object
from fdhil.commissioning.compare_scales import Read, read_increments_per_rev
from fdhil.commissioning.init.sourced_value import SourcedValue, round_to_six_digits
from fdhil.commissioning.scan import BusScanner, DeviceDescription, NodeAnswers, find_best_description, scan_nodes
from fdhil.config import CanBus
from fdhil.drivers import GENERIC_PROFILE, DriveProfile, decode_speed_unit, read_device, read_profile, suggest_profile

TWIN, TWIN_VENDOR = "fdhil_twin", 0x46444849
MOST_AXES = 8
MAX_CURRENT, DC_LINK_VOLTAGE = 0x6073, 0x6079
NO_WINDOW = (0, 0xFFFFFFFF)


@dataclass(frozen=True, slots=True)
class FoundDrive:
    """A drive, or one axis of a multi-axis device; its values by key within [axis.X], without window and cycle."""

    bus: str
    node_id: int
    label: str
    logical_axis: int = 1
    profile: str | None = None
    eds: Path | None = None
    reported_values: Mapping[str, SourcedValue] = field(default_factory=dict)
    window_increments: int | None = None
    cycle_s: float | None = None

    @property
    def name(self) -> str:
        """Display name: the node-ID and the identification that the drive reports."""
        axis = f", axis {self.logical_axis} of it" if self.logical_axis > 1 else ""
        return f"node {self.node_id}{axis} ({self.label})"


@dataclass(frozen=True, slots=True)
class FoundBus:
    """A bus; ``master`` is the evidence that an NC runs it, None without an NC."""

    name: str
    master: str | None
    sync_period_s: float | None
    drives: tuple[FoundDrive, ...]


def find_drives(name: str, settings: CanBus, descriptions: Sequence[DeviceDescription]) -> FoundBus:
    """Listen to a bus, then read its nodes; ConnectError if it cannot be reached or is silent."""
    with BusScanner(name, settings) as bus:
        scan = scan_nodes(bus, {}, descriptions)
        drives: list[FoundDrive] = []
        for node in scan.nodes:
            if node.answers is not None:
                drives += _query_drive(bus, node.node_id, node.answers, descriptions)
            elif scan.master is not None:
                drives.append(FoundDrive(name, node.node_id, "received while an NC runs the bus, not read"))
        return FoundBus(name, scan.master, scan.sync_period_s, tuple(drives))


def _query_drive(
    bus: BusScanner, node_id: int, answers: NodeAnswers, descriptions: Sequence[DeviceDescription]
) -> Iterator[FoundDrive]:
    best = find_best_description(answers.identity, descriptions)
    eds = best[0].path if best else None
    profile = suggest_drive_profile(answers, eds, partial(_read_unsigned, bus, node_id, 1))
    label = f"{answers.name or 'unnamed'}, vendor {answers.identity.vendor_id:08X}, serial {answers.identity.serial}"
    for axis in range(1, MOST_AXES + 1):
        read = partial(_read_unsigned, bus, node_id, axis)
        if read(Object.STATUSWORD, 0) is None:
            return
        reported = dict(read_scales_and_limits(read, None if profile is None else read_profile(profile, eds)))
        window = read(Object.FOLLOWING_ERROR_WINDOW, 0)
        yield FoundDrive(
            bus.name, node_id, label, axis, profile, eds, reported, window, _read_interpolation_period_s(read)
        )


def _read_unsigned(bus: BusScanner, node_id: int, axis: int, index: int, sub: int) -> int | None:
    up = (axis - 1) * LOGICAL_AXIS_STEP if 0x6000 <= index < 0x6800 else 0
    data = bus.read_object(node_id, index + up, sub)
    return None if data is None else int.from_bytes(data, "little")


def _read_interpolation_period_s(read: Read) -> float | None:
    """Return the interpolation period of set-points (0x60C2); None if the drive does not report a plausible one."""
    count, exponent = read(Object.INTERPOLATION_PERIOD, 1), read(Object.INTERPOLATION_PERIOD, 2)
    if not count or exponent is None:
        return None
    period_s = float(count * 10.0 ** ((exponent ^ 0x80) - 0x80))
    return round_to_six_digits(period_s) if 1e-4 <= period_s <= 0.02 else None


def suggest_drive_profile(answers: NodeAnswers, eds: Path | None, read: Read) -> str | None:
    """Return the profile for a drive: by its EDS, else the profile of its vendor whose objects it has; None without."""
    who = answers.identity
    if who.vendor_id == TWIN_VENDOR:
        return TWIN
    if eds is not None:
        return suggest_profile(read_device(eds))
    if not who.vendor_id:
        return None
    profiles = {name: read_profile(name) for name in tables.DRIVE_PROFILES if name != GENERIC_PROFILE}
    own = {name: profile for name, profile in profiles.items() if profile.vendor_id == who.vendor_id}
    if len(own) < 2:
        return next(iter(own), None)
    return min(own, key=lambda name: sum(read(e.index, e.sub) is None for s in own[name].tpdos for e in s.entries))


def read_scales_and_limits(read: Read, profile: DriveProfile | None) -> Iterator[tuple[str, SourcedValue]]:
    """Yield what a drive reports of its scales and limits, by key within [axis.X]."""
    if (turn := read_increments_per_rev(read)) is not None and turn[0] >= 4:
        yield "drive.increments_per_rev", SourcedValue(round(turn[0]), f"the drive: {turn[1]}")
    unit = decode_speed_unit(read(Object.VELOCITY_UNIT, 0))
    if profile is not None and unit is not None and unit != profile.speed_unit:
        yield "drive.speed_unit", SourcedValue(unit, "the drive: 0x60A9")
    yield from _read_ratings(read, "permille_of_rated" if profile is None else profile.current_unit)
    yield from _read_dc_link(read, profile)


def _read_ratings(read: Read, current_unit: str) -> Iterator[tuple[str, SourcedValue]]:
    rated_ma, rated_mnm = read(Object.RATED_CURRENT, 0), read(Object.RATED_TORQUE, 0)
    if rated_ma and current_unit in ("permille_of_rated", "share_of_rated"):
        yield "drive.rated_current_a", SourcedValue(round_to_six_digits(rated_ma / 1e3), "the drive: 0x6075")
    if rated_ma and (share := read(MAX_CURRENT, 0)):
        yield (
            "regulators.current_limit_a",
            SourcedValue(round_to_six_digits(share * rated_ma / 1e6), "the drive: 0x6073 of 0x6075"),
        )
    if rated_mnm and current_unit == "permille_of_rated_torque":
        yield "drive.rated_torque_nm", SourcedValue(round_to_six_digits(rated_mnm / 1e3), "the drive: 0x6076")
    if rated_ma and rated_mnm:
        source = "guessed: the drive's rated torque over rated current, 0x6076 over 0x6075"
        yield "nominal.K", SourcedValue(round_to_six_digits(rated_mnm / rated_ma), source, guessed=True)


def _read_dc_link(read: Read, profile: DriveProfile | None) -> Iterator[tuple[str, SourcedValue]]:
    """Yield the DC-link voltage, which bounds the motor voltage, from the vendor's object or 0x6079 (mV)."""
    own = profile.dc_link if profile is not None else None
    for key, volts in ((own, profile.dc_link_v_per_count if profile else 0.0), ((DC_LINK_VOLTAGE, 0), 1e-3)):
        if key is not None and (counts := read(*key)):
            link = SourcedValue(
                round_to_six_digits(counts * volts), f"the drive: its DC link now, {key[0]:04X}:{key[1]:02X}"
            )
            yield "regulators.voltage_limit_v", link
            if is_dc_link_required(profile):
                yield "drive.dc_link_v", link
            return


def is_dc_link_required(profile: DriveProfile | None) -> bool:
    """Return whether the configuration must give the DC-link voltage: the voltage is a duty and no TPDO has it."""
    return profile is not None and profile.duty_per_count > 0 and len(profile.voltage_objects) == 1
