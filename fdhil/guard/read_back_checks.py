"""Compares at each SYNC the offsets in force with what the drives showed. Pure, part of the core."""

from collections.abc import Sequence
from math import inf

from fdhil.guard.feedforward_law import Pair
from fdhil.guard.guard_protocol import ON_PATH, SENDING, Mode
from fdhil.guard.guard_settings import AxisSettings, GuardSettings
from fdhil.guard.guard_state import NOT_SHOWN, AxisInput, AxisState, GuardState, Shown, StepInputs
from fdhil.guard.state_transitions import Event

STRAY = 50  # readings; a second wrong one within as many was written by another node


def observe_drives(state: GuardState, inputs: StepInputs, settings: GuardSettings) -> GuardState:
    """Take the samples of a cycle: unsent frames, read-backs, following errors, the targets just latched."""
    axes, failed = tuple(map(_void_touched_record, state.axes, inputs.axes)), 0
    if inputs.unsent or inputs.unfed:
        axes = tuple([_restore_unsent_offset(axis) if k in inputs.unsent else axis for k, axis in enumerate(axes)])
        state, failed = mark_offset_late(state), state.failed_run + 1
    if not inputs.sync:
        return state._replace(axes=axes, failed_run=failed, tick=state.tick + (not settings.offset_synchronous))
    received = [axis.target for axis in inputs.axes]
    targets = None if None in received else tuple([target for target in received if target is not None])
    depth = max([axis.setpoint_delay_cycles for axis in settings.axes]) + 2
    history = (targets, *state.targets)[:depth]
    sampled = [
        _compare_feedforward_read_back(
            _check_motion_plausibility(
                _compare_read_back(axis, seen, setting, k, history, state.mode in SENDING, settings.lead),
                seen,
                setting,
                state.tick,
            ),
            seen.fed_back,
            [pairs[k] for pairs in state.feed.sent if pairs],
        )
        for k, (axis, seen, setting) in enumerate(zip(axes, inputs.axes, settings.axes, strict=True))
    ]
    return state._replace(
        axes=tuple(sampled),
        tick=state.tick + 1,
        targets=history,
        failed_run=failed,
        missed=state.missed + (inputs.late and state.mode in SENDING),
        missed_run=state.missed_run + 1 if inputs.late and _is_lateness_counted(state, settings) else 0,
    )


def _void_touched_record(axis: AxisState, seen: AxisInput) -> AxisState:
    """Void the record of a drive that rebooted or was written to: it may differ from the commissioned one."""
    return axis if seen.touched == axis.touched else axis._replace(touched=seen.touched, record_void=True)


def _is_lateness_counted(state: GuardState, settings: GuardSettings) -> bool:
    """Return whether a late step is the loop's fault: a simulated machine waits only while offsets are sent."""
    return settings.clock == "monotonic" or state.mode in ON_PATH


def _restore_unsent_offset(axis: AxisState) -> AxisState:
    return axis._replace(offset=axis.sent[1], rate=0, sent=(axis.sent[1], *axis.sent[1:]))


def _compare_read_back(
    axis: AxisState,
    seen: AxisInput,
    setting: AxisSettings,
    k: int,
    history: tuple[tuple[int, ...] | None, ...],
    sending: bool,
    lead: int,
) -> AxisState:
    """Compare what the drive showed at the previous SYNC with what was in force then.

    ``axis.sent[0]`` left after that SYNC, ``sent[1]`` after the one before it and was latched at it. The set-point
    followed then was latched ``setpoint_delay_cycles`` earlier, together with its offset. With a ``lead`` the offset in
    force left that many cycles earlier. Another node wrote the offset where it changes while nothing is ``sending``,
    except to one of the last sent values (a drive may be late), or where wrong values appear between correct ones.
    """
    axis = axis._replace(foreign=False) if axis.foreign else axis
    error: float = axis.following_error
    latched = history[1 + setting.setpoint_delay_cycles] if len(history) > 1 + setting.setpoint_delay_cycles else None
    if seen.following_error is not None:
        error = seen.following_error
    elif seen.position is not None and latched is not None:
        error = latched[k] + axis.sent[1 + lead + setting.setpoint_delay_cycles] - seen.position
    if seen.read_back is None:
        readings = 0 if seen.read_back_age > 1 or seen.read_back_crowded else axis.readings
        if error == axis.following_error and readings == axis.readings:
            return axis
        return axis._replace(following_error=error, readings=readings)
    in_force = axis.sent[1 + lead]
    late = seen.read_back != in_force and seen.read_back in axis.sent[2 + lead : 4 + lead]
    wrong = seen.read_back != in_force and not late
    strays = min(axis.strays + STRAY, 2 * STRAY) if wrong else max(0, axis.strays - 1)
    moved = not sending and axis.read_back not in (None, seen.read_back) and seen.read_back not in (0, *axis.sent)
    return axis._replace(
        following_error=error,
        read_back=seen.read_back,
        readings=axis.readings + 1 if seen.read_back == axis.read_back else 1,
        off_demand=_measure_demand_mismatch(seen, k, history),
        echo_misses=axis.echo_misses + 1 if wrong else 0,
        strays=strays,
        foreign=bool(moved) or (wrong and strays > STRAY and not axis.echo_misses),
        late_echoes=axis.late_echoes + late,
        zero_shown=axis.zero_shown or (seen.read_back == 0 and not any(axis.sent[: 2 + lead])),
    )


def _measure_demand_mismatch(seen: AxisInput, k: int, history: tuple[tuple[int, ...] | None, ...]) -> float:
    """Return how far the read-back is from 0x6062 minus the last targets; 0 where 0x6062 is not mapped."""
    if seen.demand is None or seen.read_back is None:
        return 0.0
    targets = [latched[k] for latched in history[1:] if latched is not None]
    without = seen.demand - seen.read_back
    return max(min(targets) - without, without - max(targets), 0) if targets else inf


def _check_motion_plausibility(axis: AxisState, seen: AxisInput, setting: AxisSettings, tick: int) -> AxisState:
    """Check position and speed against the last plausible ones: by the motor's power, and against each other.

    Table and motor may differ by the largest offset: with more lost motion a correction makes no sense. An implausible
    sample is no reference for the next one, which has had more time to get there.
    """
    if not setting.speed_step or seen.position is None or seen.speed is None:
        return axis
    speed = seen.speed * setting.speed_count
    position, before, then = axis.believed or (seen.position, speed, tick)
    cycles = tick - then
    step = setting.speed_step * cycles
    apart = abs(seen.position - position - 0.5 * (speed + before) * cycles)
    if abs(speed - before) <= step and apart <= step * cycles + setting.limits.offset:
        return axis._replace(believed=(seen.position, speed, tick), implausible=0)
    return axis._replace(implausible=axis.implausible + 1)


def _compare_feedforward_read_back(axis: AxisState, shown: Shown, sent: Sequence[Pair]) -> AxisState:
    """Compare the speed and torque offset in the same way; a frame late by a cycle or two is no mismatch."""
    if shown == NOT_SHOWN:
        return axis
    right = len(sent) < 2 or any(all(s in (None, v) for s, v in zip(shown, pair, strict=True)) for pair in sent[1:])
    return axis._replace(fed_back=shown, feed_misses=0 if right else axis.feed_misses + 1)


def mark_offset_late(state: GuardState) -> GuardState:
    """Note that a frame did not leave in time: the offset is off the table and has to catch up."""
    return state.follow_event(Event.LATE) if state.mode is Mode.ACTIVE else state
