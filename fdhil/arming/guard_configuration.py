"""Derives the guard's settings from the machine's configuration, the drive profiles and the commissioning records."""

import contextlib
import math
import pwd
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from fdhil.arming.operator_token import find_credential
from fdhil.cia402 import COB_RPDO, get_first_axis_index
from fdhil.commissioning import (
    INVALID_COB_ID,
    KEY_NAME,
    CommissioningRecord,
    extract_cob_id,
    is_record_of_config,
    is_record_void,
    list_guard_rpdos,
    load_record,
    read_void_reason,
    require_unique_guard_ids,
)
from fdhil.config import Axis, MachineConfig, OffsetBounds, find_share_fault
from fdhil.drivers import DriveProfile, PdoSpec, load_profile, require_offset
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.guard import AxisSettings, FeedforwardLimits, FeedforwardPdo, GuardSettings, OffsetLimits, Pdo

SPEED_STEPS = 2.0  # times the motor's power: margin for the load's own inertia and for sensor noise
HEARTBEATS_AWAITED = 2.0  # periods of the drive's heartbeat until it counts as lost


def use_systemd_key(machine: MachineConfig) -> MachineConfig:
    """Use the key of the commissioning records from systemd, if it provides one (LoadCredential)."""
    given = find_credential(KEY_NAME)
    if given is None:
        return machine
    return machine.model_copy(update={"store": machine.store.model_copy(update={"commissioning_key": given})})


def find_corrected_bus(machine: MachineConfig, source: str) -> str:
    """Return the one bus with corrected axes. Raises ConfigError if there is none, or more than one."""
    buses = {axis.drive.bus for axis in machine.axis.values() if axis.correction is not None}
    if not buses:
        fault = ConfigFault("axis.*.correction", "no axis has this section: writing is off", "add it to an axis")
        raise ConfigError(source, [fault])
    if len(buses) > 1:
        fault = ConfigFault("axis.*.drive.bus", f"corrected axes are on {', '.join(sorted(buses))}", "use one bus")
        raise ConfigError(source, [fault])
    return buses.pop()


def make_guard_settings(machine: MachineConfig, bus: str, run_directory: Path, token_sha256: str) -> GuardSettings:
    """Return what the guard needs of the configuration and the drive profiles.

    Raises ConfigError if a profile does not allow it, or if a COB-ID of the guard is used by another device.
    """
    axes = [
        _make_axis_settings(machine, name, axis) for name, axis in machine.axis.items() if axis.correction is not None
    ]
    settings = GuardSettings(
        bus=bus,
        transport="can_raw" if machine.bus[bus].interface == "socketcan" else "socketcand",
        sync_period_s=machine.machine.sync_period_s,
        clock=machine.guard.clock,
        heartbeat_s=machine.guard.heartbeat_s,
        node_id=machine.guard.node_id,
        token_sha256=token_sha256,
        run_directory=str(run_directory),
        axes=tuple(axes),
        daemon_uid=_find_user_id(machine.guard.daemon_user),
        watching=tuple(_find_user_ids((*machine.access.watch, *machine.access.operate))),
        lead=machine.bus[bus].offset_lead_cycles,
    )
    require_unique_guard_ids(machine, bus)
    return settings


def _find_user_id(name: str | None) -> int | None:
    if name is None:
        return None
    try:
        return pwd.getpwnam(name).pw_uid
    except KeyError:
        fault = ConfigFault("guard.daemon_user", f"the user {name!r} does not exist", "name the user of fdhil.service")
        raise ConfigError("config", [fault]) from None


def _find_user_ids(names: Iterable[str]) -> Iterator[int]:
    """Yield the existing users of [access]: they may read the guard's status and disarm, no more."""
    for name in sorted(set(names)):
        with contextlib.suppress(KeyError):
            yield pwd.getpwnam(name).pw_uid


def compute_offset_limits(axis: Axis, sync_period_s: float) -> OffsetLimits:
    """Return the limits in whole increments per SYNC cycle, as the planner has them, rounded down. ConfigError."""
    if fault := find_share_fault(axis, sync_period_s):
        raise ConfigError("config", [ConfigFault("axis.*.correction", fault, "leave this axis uncorrected")])
    return OffsetLimits(*OffsetBounds.derive(axis, sync_period_s).whole_increments)


def _make_axis_settings(machine: MachineConfig, name: str, axis: Axis) -> AxisSettings:
    profile = load_profile(axis.drive)
    node_id, period_s = machine.get_node_id(name), machine.machine.sync_period_s
    per_rad = axis.drive.increments_per_rev / (2 * math.pi)
    require_offset(profile, name)
    target, offset = _find_rpdo(profile, profile.target, name), _find_rpdo(profile, profile.offset, name)
    if len(offset.entries) != 1 + (axis.drive.source == "hal"):
        fault = ConfigFault(
            f"axis.{name}.drive.profile", "its offset RPDO maps more than 0x60B0", "give it its own RPDO"
        )
        raise ConfigError(profile.name, [fault])
    record = _read_commissioning_record(machine, name)
    return AxisSettings(
        name=name,
        node_id=node_id,
        target=_make_pdo(target, node_id),
        offset=_make_pdo(offset, node_id),
        tpdos=tuple(_make_pdo(spec, node_id) for spec in profile.tpdos if spec.valid),
        increments_per_mm=axis.scaling.increments_per_mm,
        max_speed_mm_s=axis.top_speed_mm_s,
        max_acceleration_mm_s2=axis.max_acceleration_mm_s2,
        sign=axis.drive.sign,
        limits=compute_offset_limits(axis, period_s),
        window=round(axis.drive.following_error_window_mm * axis.scaling.increments_per_mm),
        setpoint_delay_cycles=axis.drive.setpoint_delay_cycles,
        heartbeat_timeout_s=compute_heartbeat_timeout_s(machine, name),
        feedforward=_make_feedforward_settings(profile, machine, name, axis),
        speed_count=abs(profile.compute_speed_scale(axis)) * per_rad * period_s,
        speed_step=SPEED_STEPS * _compute_largest_acceleration_rad_s2(axis) * per_rad * period_s**2,
        travel=None if record is None else record.travel,
        writers=_find_offset_writers(machine, name, profile, record),
        **_read_fingerprint(machine, name, record),
    )


def _find_offset_writers(
    machine: MachineConfig, name: str, profile: DriveProfile, record: CommissioningRecord | None
) -> tuple[int, ...]:
    """Return the COB-IDs, except the guard's, whose frames may change an offset of the drive.

    By the record these are those of all RPDOs that map one, valid or not. The default RPDOs are added: one that did not
    exist, or was invalid, at commissioning was set up by another master since.
    """
    node, recorded = machine.get_node_id(name), () if record is None else record.rpdos
    harmless = {extract_cob_id(cob_id) for cob_id in recorded if not cob_id & INVALID_COB_ID}
    suspect = {extract_cob_id(cob_id) for cob_id in recorded if cob_id & INVALID_COB_ID}
    suspect |= {base + node for base in COB_RPDO} | {spec.cob_base + node for spec in profile.rpdos}
    same_bus = {n: axis for n, axis in machine.axis.items() if axis.drive.bus == machine.axis[name].drive.bus}
    known = {
        spec.cob_base + machine.get_node_id(other)
        for other, axis in same_bus.items()
        for found in (load_profile(axis.drive),)
        for spec in (*found.rpdos, *found.tpdos)
        if spec.valid
    }
    known |= {axis.table.cob_id or 0 for axis in same_bus.values() if axis.table is not None}
    sent = {spec.cob_base + node for spec in list_guard_rpdos(machine, name, profile)}
    return tuple(sorted(cob_id for cob_id in suspect - known - harmless - sent if 0 < cob_id <= 0x7FF))


def _read_fingerprint(machine: MachineConfig, name: str, record: CommissioningRecord | None) -> dict[str, Any]:
    if record is None or not is_record_of_config(record, machine, name):
        return {}
    void = is_record_void(machine.store.directory, name)
    reason = read_void_reason(machine.store.directory, name) if void else ""
    return {"record": record.fingerprint, "record_void": void, "void_reason": reason}


def _compute_largest_acceleration_rad_s2(axis: Axis) -> float:
    """Return the motor's acceleration at its current limit, or the NC's demand if that is larger."""
    of_the_motor = axis.regulators.current_limit_a * axis.nominal.K / axis.nominal.Jt
    return max(of_the_motor, axis.max_acceleration_mm_s2 * 2 * math.pi / axis.screw_pitch_mm)


def _make_feedforward_settings(
    profile: DriveProfile, machine: MachineConfig, name: str, axis: Axis
) -> FeedforwardPdo | None:
    """Return what the on-line feed-forward of an axis may send; None without [axis.X.feedforward]."""
    limits = axis.feedforward
    if limits is None:
        return None
    found = profile.find_rpdo(profile.speed_offset)
    if found is None or [(e.index, e.sub) for e in found[0].entries] != [profile.speed_offset, profile.torque_offset]:
        text = f"{profile.name} maps no RPDO with 60B1 and 60B2 alone"
        fault = ConfigFault(f"axis.{name}.feedforward", text, "leave the section out, or give the profile such an RPDO")
        raise ConfigError(profile.name, [fault])
    period = machine.machine.sync_period_s
    speed = axis.drive.increments_per_rev / (2 * math.pi)
    torque = 1e3 / (axis.nominal.K * axis.drive.rated_current_a)
    return FeedforwardPdo(
        _make_pdo(found[0], machine.get_node_id(name)),
        FeedforwardLimits(
            speed=max(1, math.floor(limits.max_speed_rad_s * speed)),
            speed_rate=max(1, math.floor(limits.max_speed_rate_rad_s2 * speed * period)),
            torque=min(0x7FFF, max(1, math.floor(limits.max_torque_nm * torque))),
            torque_rate=max(1, math.floor(limits.max_torque_rate_nm_s * torque * period)),
        ),
    )


def compute_heartbeat_timeout_s(machine: MachineConfig, axis: str) -> float:
    """Return how long the drive's heartbeat may be missing, from object 0x1017 at commissioning.

    0 means never: without a readable record (nothing is armed then), for a drive without heartbeat, and if time is the
    count of SYNC, which has no relation to heartbeats by the wall clock.
    """
    record = _read_commissioning_record(machine, axis)
    if record is None or machine.guard.clock == "sync":
        return 0.0
    return HEARTBEATS_AWAITED * record.options.get("1017", 0) * 1e-3


def _read_commissioning_record(machine: MachineConfig, axis: str) -> CommissioningRecord | None:
    try:
        return load_record(machine.store.directory, axis, machine.store.commissioning_key)
    except StoreError:
        return None


def _find_rpdo(profile: DriveProfile, key: tuple[int, int], axis: str) -> PdoSpec:
    found = profile.find_rpdo(key)
    if found is None or not found[0].valid:
        fault = ConfigFault(f"axis.{axis}.drive.profile", f"{profile.name} maps no {key[0]:04X} into an RPDO", "map it")
        raise ConfigError(profile.name, [fault])
    return found[0]


def _make_pdo(spec: PdoSpec, node_id: int) -> Pdo:
    """Convert a PDO for the guard, which names the objects of a device's second axis like those of the first."""
    layout = tuple((get_first_axis_index(entry.index), entry.sub, entry.bits, entry.signed) for entry in spec.entries)
    return Pdo(spec.cob_base + node_id, layout, spec.every_sync)
