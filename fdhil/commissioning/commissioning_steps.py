"""Commission one axis while no NC runs the bus: read, compare, move by 10 um, prove the watchdog, sign off.

On any failure the offset is ramped to 0, the drive is disabled and written objects are restored. See CiA 402-2 for the
objects, CiA 301 7.2.8 for the heartbeat consumer.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import NamedTuple

from fdhil import cia402
from fdhil.cia402 import Mode, NmtCommand, Object, PowerState
from fdhil.commissioning.axis_motion import delay_interrupts
from fdhil.commissioning.commissioning_record import CommissioningRecord, compute_axis_digest
from fdhil.commissioning.drive_survey import (
    DriveSurvey,
    build_drive_fault,
    listen_for_master,
    require_enabled,
    require_no_fault,
    survey_drive,
)
from fdhil.commissioning.feedforward_setup import enable_feedforward_rpdo, prove_feedforward
from fdhil.commissioning.finding import read_optional
from fdhil.commissioning.foreign_master_stop import OFF_WORDS
from fdhil.commissioning.master import Master
from fdhil.commissioning.record_comparison import compute_survey_fingerprint
from fdhil.commissioning.set_points import plan_straight_move
from fdhil.commissioning.step_progress import Found, StepProgress
from fdhil.commissioning.watchdog import run_watchdog_test
from fdhil.config import CorrectionLimits, MachineConfig
from fdhil.drivers import NO_OFFSET_ADVICE, explain_missing_offset, load_profile
from fdhil.errors import DeviceError, DriveFault, ForeignMaster, ProtocolError

SIGN_TEST_UM = 10.0
ENABLE_TIMEOUT_S = 5.0
SETTLE_CYCLES = 400
BOOTED = "it has booted since it was compared, so its set-up may have changed; commission it again"
AVERAGE_CYCLES = 200
TRIAL_RAMPS = 8
MOST_RAMPS = 24
RAMP_CYCLES = 20
EARLY_CYCLES = 8


class DemandExcess(NamedTuple):
    """Unexplained speed demand as a share of the ramp's speed: judged by the last cycle, and by the first."""

    least: float
    most: float


def prepare_drive(master: Master) -> None:
    """Select CSP, start SYNC and the node, and use the actual position as target; the drive is not enabled yet."""
    overflow = read_optional(master, Object.SYNC_COUNTER_OVERFLOW) or 0
    master.sdo.write_int(Object.MODE, 0, Mode.CYCLIC_SYNC_POSITION, 1)
    master.send_nmt(NmtCommand.START)  # first: a node that is not started ignores SYNC
    master.loop.produce_sync(overflow)
    master.wait_until(
        lambda: (
            master.profile.position in master.feedback.objects and master.profile.statusword in master.feedback.objects
        ),
        2.0,
        "it sends no PDOs after NMT start; check that its TPDOs are synchronous and valid",
    )
    master.hold_position()
    master.wait_cycles(20)


def enable_drive(master: Master) -> None:
    """Bring the drive to Operation enabled, holding its position; DriveFault if it does not get there."""
    deadline = time.monotonic() + ENABLE_TIMEOUT_S * master.patience
    reset_tried = False
    while master.get_power_state() is not PowerState.OPERATION_ENABLED:
        if time.monotonic() > deadline:
            text = f"it stays in {master.get_power_state().value!r}; check supply, enable input and safe torque off"
            raise DriveFault(master.device, text)
        if master.get_power_state() is PowerState.FAULT:
            if reset_tried:
                raise build_drive_fault(master, "it is in fault")
            master.controlword, reset_tried = 0, True
            master.wait_cycles(10)
        word = cia402.choose_enabling_controlword(master.get_power_state())
        if word is not None:
            master.hold_position()
            master.controlword = word
        master.wait_cycles(10)
    mode = (master.profile.shift_object_index(Object.MODE_DISPLAY), 0)
    if mode in master.feedback.objects:
        master.wait_until(
            lambda: master.feedback.objects[mode] == Mode.CYCLIC_SYNC_POSITION,
            0.5,
            "it does not enter the mode cyclic synchronous position; check 0x6060 and 0x6502",
        )
    master.wait_cycles(SETTLE_CYCLES)
    require_enabled(master)


def disable_drive(master: Master) -> None:
    """Switch off the power stage step by step, and leave the node pre-operational without SYNC."""
    if not master.loop.is_producing_sync:
        return
    for word in OFF_WORDS:
        master.controlword = word
        master.wait_cycles(20)
    if master.get_power_state() is PowerState.FAULT:
        master.controlword = cia402.CONTROL_FAULT_RESET
        master.wait_cycles(20)
        master.controlword = cia402.CONTROL_DISABLE_VOLTAGE
        master.wait_cycles(20)
    master.target = None
    master.send_nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    master.loop.stop_sync()


def zero_offset(master: Master) -> None:
    """Ramp the offset to 0 and verify that the drive holds 0."""
    if master.target is None:
        return
    ramp_offset(master, 0)
    master.wait_cycles(20)
    left = master.sdo.read_int(*master.profile.offset, signed=True)
    if left != 0:
        raise DriveFault(master.device, f"it still holds an offset of {left} increments; power it off and on again")


def ramp_offset(master: Master, goal: int, step: int | None = None) -> int:
    """Ramp the offset to ``goal``; return the cycle in which the first value is sent.

    By ``step`` increments per cycle; default: within the limits, at a quarter of the largest speed.
    """
    start = master.drop_offsets()  # Ctrl-C may have interrupted another ramp
    if step is None:
        values = _plan_gentle_ramp(master, start, goal)
    else:
        values = [*range(start, goal, step if goal > start else -step), goal][1:]
    first = master.play_offset(values)
    patience = 5.0 + 20 * len(values) * master.period_s
    master.wait_until(lambda: not master.has_planned_offsets, patience, "the offset was not sent; check the bus")
    return first


def _plan_gentle_ramp(master: Master, start: int, goal: int) -> list[int]:
    limits = _get_correction_limits(master)
    per_cycle = master.config.axis[master.axis].scaling.increments_per_mm * master.period_s
    speed, acceleration = limits.max_speed_mm_s * per_cycle / 4, limits.max_acceleration_mm_s2 * per_cycle
    rows = plan_straight_move([start], [goal], [speed], [acceleration * master.period_s])
    return [round(offset) for offset in rows[1:, 0].tolist()]


def _get_correction_limits(master: Master) -> CorrectionLimits:
    return master.config.axis[master.axis].correction or CorrectionLimits()


def run_sign_test(master: Master) -> float:
    """Offset the axis by +10 um: read-back, demand and table must follow in sign and size; return the table's um.

    The direction is the machine's: ``drive.sign`` is applied to sent and received values.
    """
    settings = master.config.axis[master.axis]
    profile = master.profile
    step = _compute_sign_test_step(master)
    demand = master.average_object(profile.position_demand, AVERAGE_CYCLES)
    table = master.average_object(profile.position, AVERAGE_CYCLES)
    ramp_offset(master, step, 1)
    master.wait_cycles(SETTLE_CYCLES)
    require_enabled(master)
    held = master.sdo.read_int(*profile.offset, signed=True)
    if held != step:
        text = f"an offset of {step} increments was sent and 0x60B0 holds {held}; check the RPDO's mapping"
        raise DriveFault(master.device, text)
    demanded = master.average_object(profile.position_demand, AVERAGE_CYCLES) - demand
    moved = master.average_object(profile.position, AVERAGE_CYCLES) - table
    if abs(demanded - step) > 1.5:
        raise DriveFault(
            master.device,
            f"an offset of {step} increments moved its demand (0x6062) by {demanded:.0f}; "
            "it does not add 0x60B0 to the target and cannot be corrected",
        )
    if not 0.5 <= moved / step <= 1.5:
        raise DriveFault(
            master.device,
            f"an offset of {step} increments moved its position (0x6064) by {moved:.0f}; "
            "check the direction of the encoder and lost motion",
        )
    ramp_offset(master, 0, 1)
    master.wait_cycles(SETTLE_CYCLES)
    return settings.scaling.convert_to_mm(moved) * 1e3


def _compute_sign_test_step(master: Master) -> int:
    scaling, um = (
        master.config.axis[master.axis].scaling,
        min(SIGN_TEST_UM, _get_correction_limits(master).max_offset_um),
    )
    if not um / 1e3 * scaling.increments_per_mm >= 1.0:
        text = f"one increment is {1e3 / scaling.increments_per_mm:.3g} um, more than the sign test's {um:g} um"
        advice = "set a finer resolution in the drive, and correct drive.increments_per_rev"
        raise DriveFault(master.device, f"{text}: its scaling is too coarse for any correction; {advice}")
    return scaling.convert_to_increments(um / 1e3)


def run_feedforward_test(master: Master) -> bool | None:
    """Return whether the offset's slope reaches the speed feed-forward; None if undetermined.

    The offset is ramped at standstill and the speed demand (0x606B) is read early in the ramp. Without feed-forward the
    demand grows as v (1 - exp(-Kv t)) at most; with it, the share Kff of v is present at once. More ramps are made on a
    busy computer, which captures the start of only a few.
    """
    settings = master.config.axis[master.axis]
    share = settings.regulators.speed_feedforward
    if share == 0.0:
        return True  # without feed-forward there is nothing to reach
    step = _compute_ramp_step(master.config, master.axis)
    if step < 1 or read_optional(master, Object.VELOCITY_DEMAND, signed=True) is None:
        return None
    excess: list[DemandExcess] = []
    for number in range(round(MOST_RAMPS * master.patience)):
        goal = step * RAMP_CYCLES if number % 2 == 0 else 0
        excess += _measure_early_excess(master, goal, step)
        master.wait_cycles(SETTLE_CYCLES // 2)
        if number + 1 >= TRIAL_RAMPS and len(excess) >= TRIAL_RAMPS:
            break
    ramp_offset(master, 0, 1)
    require_enabled(master)
    if len(excess) < TRIAL_RAMPS:
        return None
    least, most = (sum(bounds) / len(excess) for bounds in zip(*excess, strict=True))
    return True if least > 0.5 * share else False if most < 0.25 * share else None


def _compute_ramp_step(config: MachineConfig, axis: str) -> int:
    """Return the ramp of the feed-forward test in increments per cycle: up to 2 mm/s and 40 um, within the limits."""
    settings = config.axis[axis]
    per_mm, limits = settings.scaling.increments_per_mm, settings.correction or CorrectionLimits()
    fastest = int(min(2.0, limits.max_speed_mm_s) * per_mm * config.machine.sync_period_s)
    return min(fastest, int(0.8 * min(50.0, limits.max_offset_um) / 1e3 * per_mm / RAMP_CYCLES))


def compute_largest_move_um(config: MachineConfig, axis: str) -> float:
    """Return the longest distance by which commissioning moves the axis."""
    settings = config.axis[axis]
    ramped = _compute_ramp_step(config, axis) * RAMP_CYCLES / settings.scaling.increments_per_mm * 1e3
    return max(SIGN_TEST_UM, ramped)


def _measure_early_excess(master: Master, goal: int, step: int) -> list[DemandExcess]:
    """Return the speed demand relative to the ramp, less the position loop's share, for the first cycles of a ramp."""
    sign = 1 if goal > master.offset else -1
    settings = master.config.axis[master.axis]
    gain_per_cycle = settings.regulators.position_gain_per_s * master.period_s
    unit = master.profile.compute_speed_scale(settings) * settings.drive.sign
    ramp_rad_s = step / master.period_s / settings.drive.increments_per_rev * 2 * math.pi
    values = [master.offset + sign * step * k for k in range(1, RAMP_CYCLES + 1)]
    in_force = master.play_offset(values) + 1 + settings.drive.setpoint_delay_cycles
    excess = []
    while master.cycle <= in_force + EARLY_CYCLES:
        first = master.cycle - in_force
        demand = master.sdo.read_int(Object.VELOCITY_DEMAND, signed=True) * unit * sign
        last = master.cycle - in_force
        # the drive sampled it somewhere between: a busy computer may ask before the ramp and be answered much later
        if first >= 1 and last <= EARLY_CYCLES:
            explained = (1 - math.exp(-gain_per_cycle * age) for age in (last, first))
            excess.append(DemandExcess(*(demand / ramp_rad_s - share for share in explained)))
    return excess


def check_axis(master: Master) -> DriveSurvey:
    """Check everything that needs no motion; DriveFault for the first difference."""
    found = survey_drive(master)
    require_no_fault(master, found.findings)
    _compute_sign_test_step(master)
    return found


PROOFS: Mapping[str, Callable[[Master], Found]] = {
    "sign test": lambda master: {"moved_um": round(run_sign_test(master), 2)},
    "feed-forward test": lambda master: {"in_feedforward": run_feedforward_test(master)},
    "watchdog test": lambda master: {"watchdog": run_watchdog_test(master, enable_drive)},
}
"""The steps with the drive switched on; their results go into the record."""


def commission_axis(
    config: MachineConfig,
    axis: str,
    report: Callable[[str], None] = lambda _step: None,
    progress: StepProgress | None = None,
    result: Callable[[str, Found], None] = lambda _step, _found: None,
) -> CommissioningRecord:
    """Commission one axis and return the signed-off record (not saved yet).

    ``report`` gets each step's name before it, ``result`` its results after it. Nothing moves before ``report`` returns
    from ``enable``, and only the feed-forward's RPDO is written, and restored: an exception of ``report`` then leaves
    no trace. With ``progress`` each completed step is stored, and a step stored for this drive, unchanged, is skipped.

    DriveFault (also for a drive without offset object), ProtocolError, DeviceTimeout or ConnectError, after everything
    was rolled back; StoreError if a step cannot be stored.
    """
    profile = load_profile(config.axis[axis].drive)
    if not profile.can_take_offset:
        raise DriveFault(f"drive {axis}", f"{explain_missing_offset(profile)}; {NO_OFFSET_ADVICE}")
    with Master(config, axis) as master:
        report("listen")
        listen_for_master(master)
        with enable_feedforward_rpdo(master) as feeding:
            report("compare")
            boots = master.feedback.boots
            found = check_axis(master)
            result("compare", {"points": len(found.findings)})
            proven = _run_proofs(master, found, report, progress, result)
            if master.feedback.boots != boots:
                raise DriveFault(master.device, BOOTED)
    return CommissioningRecord(
        axis=axis,
        **asdict(found.identity),
        config_digest=compute_axis_digest(config, axis),
        mapping_fingerprint=found.fingerprint,
        options={**found.options, **found.rpdos, **feeding},
        following_error_window_um=found.window_um,
        offset_in_feedforward=proven["feed-forward test"]["in_feedforward"],
        sign_test_um=proven["sign test"]["moved_um"],
        readback_ok=True,
        watchdog=proven["watchdog test"]["watchdog"],
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def compute_step_fingerprint(config: MachineConfig, axis: str, found: DriveSurvey) -> str:
    """Return the fingerprint of a drive, as just read, with its configuration."""
    return f"{compute_axis_digest(config, axis)} {compute_survey_fingerprint(found)}"


def _run_proofs(
    master: Master,
    found: DriveSurvey,
    report: Callable[[str], None],
    progress: StepProgress | None,
    result: Callable[[str, Found], None],
) -> Mapping[str, Found]:
    """Return the results of each of the ``PROOFS``; the drive is switched on only if one is not stored."""
    now = compute_step_fingerprint(master.config, master.axis, found)
    done = {name: progress.reuse_step(name, now) if progress else None for name in PROOFS}
    proven = {name: kept for name, kept in done.items() if kept is not None}
    if len(proven) == len(PROOFS):
        return proven
    report("enable")
    with roll_back_afterwards(master):
        prepare_drive(master)
        prove_feedforward(master)
        enable_drive(master)
        for name in (name for name in PROOFS if name not in proven):
            report(name)
            proven[name] = PROOFS[name](master)
            if progress is not None:
                progress.save_step(name, now, proven[name])
            result(name, proven[name])
        report("restore")
    return proven


@contextlib.contextmanager
def roll_back_afterwards(master: Master) -> Iterator[None]:
    """Run steps; afterwards, whatever happens, the offset is ramped to 0 and the drive disabled.

    Actions that cannot be undone are reported with the error. If another master was detected, the cycle has stopped the
    drive, and ForeignMaster is raised.
    """
    try:
        yield
    except BaseException as error:  # Ctrl-C, too
        _roll_back_drive(master, f"{str(error) or 'it was interrupted'}; ")
        raise
    if _roll_back_drive(master):
        raise KeyboardInterrupt


def _roll_back_drive(master: Master, first: str = "") -> bool:
    """Zero the offset and disable the drive; return whether a signal to stop arrived, which waits until both are done.

    ProtocolError, after ``first``, if the drive could not be restored.
    """
    faults: list[str] = []
    with delay_interrupts() as came:
        for step in (zero_offset, disable_drive):
            try:
                step(master)
            except ForeignMaster:
                break
            except DeviceError as error:
                faults.append(str(error))
    if master.loop.foreign_master_bus is not None:
        master.raise_if_failed()
    if faults:
        text = f"{first}the drive could not be restored ({'; '.join(faults)}); power it off and on again"
        raise ProtocolError(master.device, text)
    return bool(came)
