"""Decides what leaves the guard: ``step_guard(state, inputs, settings) -> (state, output)``, pure, once per SYNC.

No clock, no I/O: time is the SYNC count in the state. Every way out of a state leads toward OFF, except the operator's
arm and adopt. The order within a step: what the drives and the bus show, the interlocks, the request, the position on
the path, the motion of the offset, and a check of the frame by formulas other than those that computed it.
"""

from fdhil.guard import feedforward_law
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.feedforward_step import step_feedforward
from fdhil.guard.guard_protocol import HOLD_CYCLES, IN_CHARGE, RAMPING_MODES, RESERVE_S, SENDING, FeedMode, Mode
from fdhil.guard.guard_settings import AxisSettings, GuardSettings
from fdhil.guard.guard_state import AxisState, GuardRequest, GuardState, StepInputs, StepOutput
from fdhil.guard.interlock_checks import (
    Views,
    combine_axis_views,
    list_arming_obstacles,
    list_failing_interlocks,
    list_missing_facts,
)
from fdhil.guard.interlocks import FACTS, FEEDFORWARD_FACTS, Alarm, Alarms, Reaction
from fdhil.guard.offset_adoption import (
    adopt_at_start,
    apply_drive_comparison,
    begin_adoption,
    discard_read_backs,
    freeze_sending,
    list_adopt_refusals,
    set_offset_at_rest,
    set_offset_confirmed_zero,
    wait_for_read_backs,
)
from fdhil.guard.offset_limits import compute_offset_ceiling, decelerate_offset, find_limit_violation, move_toward_goal
from fdhil.guard.path_tracking import await_start, count_standstill, track_path
from fdhil.guard.read_back_checks import mark_offset_late, observe_drives
from fdhil.guard.state_transitions import ZEROS, ZEROS_UNCONFIRMED, Event

SETTLED_CYCLES = 100
FEED_HOLD_S = 10.0
MISSED_CYCLES = 10
FAILED_SENDS = 3


def step_guard(state: GuardState, inputs: StepInputs, settings: GuardSettings) -> tuple[GuardState, StepOutput]:
    """Decide what leaves the guard now. ``inputs.sync`` False is a step of the local timer, while SYNC is missing."""
    before, fed_before = state.mode, state.feed.mode
    state = observe_drives(state, inputs, settings)
    views = combine_axis_views(settings, inputs, state)
    alarms = _list_alarms(state, inputs, views)
    undisturbed_for = (
        0 if any(alarm.code == "OffsetHijack" for alarm in alarms) else state.undisturbed_for + inputs.sync
    )
    state = state._replace(good_for=0 if alarms else state.good_for + inputs.sync, undisturbed_for=undisturbed_for)
    state, refused = _decide_request(state, inputs, alarms, views, settings)
    state = _react_to_alarms(state, inputs, alarms, settings)
    state = adopt_at_start(state, inputs, alarms, views, settings)
    state = wait_for_read_backs(state, inputs, alarms, settings)
    if inputs.sync:
        state = count_standstill(_follow_path(state, inputs, alarms, settings))
    state, output = _move_offsets(state, inputs, settings)
    state, output = step_feedforward(state, inputs, alarms, settings, output)
    moved = None if state.mode is before else (before, state.mode, state.cause)
    fed = None if state.feed.mode is fed_before else (fed_before, state.feed.mode)
    if refused is None and moved is None and fed is None:
        return state, output
    return state, output._replace(refused=refused, transition=moved, feed_transition=fed)


# --- what the drives and the bus show ---


def _list_alarms(state: GuardState, inputs: StepInputs, views: Views) -> Alarms:
    own = []
    if state.missed_run > MISSED_CYCLES:
        own.append(Alarm("LoopOverrun"))
    if state.failed_run >= FAILED_SENDS:
        own.append(Alarm("TxQueueFull"))
    return (*inputs.alarms, *own, *list_failing_interlocks(inputs.bus, views))


def list_status_alarms(state: GuardState, inputs: StepInputs, settings: GuardSettings) -> Alarms:
    """Return every alarm of the step that took ``inputs``, including what forbids arming; for the status."""
    views = combine_axis_views(settings, inputs, state)
    return (*_list_alarms(state, inputs, views), *list_arming_obstacles(views))


# --- requests ---


def _decide_request(
    state: GuardState, inputs: StepInputs, alarms: Alarms, views: Views, settings: GuardSettings
) -> tuple[GuardState, Alarms | None]:
    """Decide the request: the new state and the refusals (empty: granted), None when there was no request."""
    request = inputs.request
    if request is None:
        return state, None
    if request.kind in ("arm", "feedforward"):
        refused = _list_arm_refusals(state, inputs, request, alarms, views, settings)
        if refused:
            return state, refused
        fed = state._replace(feed=feedforward_law.arm_feedforward(request.laws))
        return fed if request.kind == "feedforward" else _enter_armed(state, inputs), ()
    if request.kind == "adopt":
        refused = list_adopt_refusals(state, request, alarms, views)
        return (state, refused) if refused else (begin_adoption(state, settings), ())
    if request.kind == "compared":
        return apply_drive_comparison(state, request, settings)
    cause = Alarm("Disarmed" if request.kind == "disarm" else "Stopped")
    if state.mode in IN_CHARGE:
        state = _begin_ramp_down(state, cause)
    return state._replace(feed=feedforward_law.begin_fade_out(state.feed, cause)), ()


def _list_arm_refusals(
    state: GuardState, inputs: StepInputs, request: GuardRequest, alarms: Alarms, views: Views, settings: GuardSettings
) -> Alarms:
    """Return every reason not to arm; only an empty answer leads from OFF to ARMED or to the on-line feed-forward."""
    refused: list[Alarm] = []
    if state.mode is not Mode.OFF or state.feed.mode is not FeedMode.OFF:
        refused.append(Alarm("NotOff", detail=state.mode.value))
    if state.feed.unconfirmed:
        refused.append(Alarm("StaleOffset", detail="of speed or torque"))
    if request.token_valid is not True:
        refused.append(Alarm("AuthRequired"))
    if inputs.main_alive is not True:
        refused.append(Alarm("MainLost"))
    refused += [*alarms, *list_arming_obstacles(views)]
    if not alarms and not state.good_for >= SETTLED_CYCLES:
        refused.append(Alarm("NotSettled", detail=f"{state.good_for} so far"))
    if request.kind == "feedforward":
        refused += list_missing_facts(request.facts, FEEDFORWARD_FACTS)
        if not settings.feeds or len(request.laws) != len(settings.axes):
            refused.append(Alarm("FeedforwardOff"))
        return tuple(refused)
    refused += list_missing_facts(request.facts, FACTS)
    path = inputs.path
    if path is None or not request.program_digest or path.program_digest != request.program_digest or path.first:
        refused.append(Alarm("ProgramMismatch"))
    return tuple(dict.fromkeys(refused))


def _enter_armed(state: GuardState, inputs: StepInputs) -> GuardState:
    assert inputs.path is not None
    return state.follow_event(
        Event.ARM,
        program_digest=inputs.path.program_digest,
        start_row=inputs.path.count_standing_rows(),
        axes=tuple([set_offset_at_rest(axis, 0) for axis in state.axes]),
        cause=None,
    )


# --- reactions ---


def _begin_ramp_down(state: GuardState, cause: Alarm, event: Event = Event.END) -> GuardState:
    return state.follow_event(event, cause=cause, places=(), zeros_sent=0)


def _react_to_alarms(state: GuardState, inputs: StepInputs, alarms: Alarms, settings: GuardSettings) -> GuardState:
    """Freeze or ramp down, as the worst alarm requires; a lost daemon ramps down."""
    hijack = next((alarm for alarm in alarms if alarm.code == "OffsetHijack"), None)
    if hijack is not None or any(alarm.code == "NodeRebooted" for alarm in inputs.alarms):
        state = discard_read_backs(state)
    if state.mode not in SENDING:
        return state
    worst = max(alarms, key=lambda alarm: _find_reaction(alarm, settings), default=None)
    reaction = Reaction.REFUSE if worst is None else _find_reaction(worst, settings)
    if worst is not None and reaction is Reaction.FREEZE:
        return freeze_sending(state, worst)
    if state.failed_run >= 2 * FAILED_SENDS:
        return freeze_sending(state, Alarm("TxQueueFull"))
    if hijack is not None and _was_ramped_before(state):
        return freeze_sending(state, hijack)  # two masters that write the same offset make the table jump
    if hijack is not None:
        return _begin_ramp_down(state, hijack, Event.HIJACK)._replace(measuring=max(1, state.measuring))
    if state.mode not in IN_CHARGE:
        return state
    if worst is not None and reaction is Reaction.RAMP_DOWN:
        return _begin_ramp_down(state, worst)
    if inputs.main_alive is not True:
        return _begin_ramp_down(state, Alarm("MainLost"))
    return _begin_ramp_down(state, inputs.withdrawn[0]) if inputs.withdrawn else state


def _was_ramped_before(state: GuardState) -> bool:
    """Return whether an offset of another node is being ramped already: ramping again could go on for ever."""
    return (
        state.mode in RAMPING_MODES
        and not state.measuring
        and state.cause is not None
        and (state.cause.code == "OffsetHijack")
    )


def _find_reaction(alarm: Alarm, settings: GuardSettings) -> Reaction:
    """Return the reaction; without SYNC only an event-driven RPDO can be ramped, a synchronous one is not applied."""
    if alarm.code == "SyncLost" and not settings.offset_synchronous:
        return Reaction.RAMP_DOWN
    return alarm.reaction


# --- the position on the path ---


def _follow_path(state: GuardState, inputs: StepInputs, alarms: Alarms, settings: GuardSettings) -> GuardState:
    """Locate the latched row; hold when it is ambiguous, ramp down when that persists or the path ends."""
    if state.mode not in IN_CHARGE:
        return state
    path = inputs.path
    if path is None or path.program_digest != state.program_digest:
        return _begin_ramp_down(state, Alarm("ProgramMismatch"))
    hold = next((alarm for alarm in alarms if alarm.reaction is Reaction.HOLD), None)
    if state.mode is Mode.ARMED:
        if hold:
            return _hold_offset(state, hold, settings)
        state, misaligned = await_start(state._replace(held_for=0), path)
        return state if misaligned is None else _begin_ramp_down(state, misaligned)
    state, lost = track_path(state, path)
    hold = hold or lost
    if path.final and state.places[0].row >= path.end - 1:
        return _begin_ramp_down(state, Alarm("Finished"))
    if not path.final and path.end - state.places[0].row < settings.convert_to_cycles(RESERVE_S):
        return _begin_ramp_down(state, Alarm("TableStarved"))
    if hold is not None:
        return _hold_offset(state, hold, settings)
    if state.mode is Mode.HOLD:
        return state.follow_event(Event.FOUND, held_for=0, cause=None)
    return state._replace(held_for=0)


def _hold_offset(state: GuardState, alarm: Alarm, settings: GuardSettings) -> GuardState:
    """Hold the offset; ramp it down when that has lasted too long. Before the start there is nothing to hold."""
    allowed = settings.convert_to_cycles(FEED_HOLD_S) if alarm.code == "FeedHold" else HOLD_CYCLES
    if state.held_for >= allowed:
        return _begin_ramp_down(state, alarm)
    return state.follow_event(Event.GAP, held_for=state.held_for + 1, cause=alarm)


# --- the motion of the offset ---


def _move_offsets(state: GuardState, inputs: StepInputs, settings: GuardSettings) -> tuple[GuardState, StepOutput]:
    """Compute, check and output the next offsets; a step that is too late sends nothing and holds the value."""
    if state.mode not in SENDING or state.measuring:
        return state, StepOutput()
    if not inputs.sync and (settings.offset_synchronous or not inputs.bus.silent):
        return state, StepOutput()
    if inputs.late:
        return mark_offset_late(state)._replace(axes=tuple(map(_note_unsent_cycle, state.axes))), StepOutput()
    offsets, broken = _compute_next_offsets(state, inputs.path, settings)
    if broken is not None:
        state = _begin_ramp_down(state, broken)
        offsets, _ = _compute_next_offsets(state, inputs.path, settings)
    wrong = _check_offset_frames(state, offsets, settings)
    if wrong is not None:
        return freeze_sending(state, wrong), StepOutput()
    axes = tuple([_note_sent_offset(axis, o, s) for axis, o, s in zip(state.axes, offsets, settings.axes, strict=True)])
    state = _finish_ramps(state._replace(axes=axes), inputs.path, settings.lead)
    heartbeat = state.tick % settings.heartbeat_cycles == 0
    return state, StepOutput(offsets, heartbeat)


def _compute_next_offsets(
    state: GuardState, path: CorrectedPath | None, settings: GuardSettings
) -> tuple[tuple[int, ...], Alarm | None]:
    """Return the next offset of each axis, and an alarm when the table itself exceeds a limit."""
    if state.mode is Mode.ARMED:
        return (0,) * len(state.axes), None
    if state.mode is Mode.HOLD:
        return tuple(
            [decelerate_offset(s.limits, a.offset, a.rate) for s, a in zip(settings.axes, state.axes, strict=True)]
        ), None
    if state.mode in RAMPING_MODES or path is None:
        return tuple(
            [move_toward_goal(s.limits, a.offset, a.rate, 0, 0) for s, a in zip(settings.axes, state.axes, strict=True)]
        ), None
    row = state.places[0].row + settings.lead
    wanted, current = path.get_row_offsets(row + 1), path.get_row_offsets(row)
    offsets = []
    for s, axis, goal, here in zip(settings.axes, state.axes, wanted, current, strict=True):
        offset = move_toward_goal(s.limits, axis.offset, axis.rate, goal, goal - here)
        if state.mode is Mode.ACTIVE and offset != goal:
            return (), Alarm(find_limit_violation(s.limits, axis.offset, axis.rate, goal) or "OffsetRate", s.name)
        if not axis.travel.total <= s.limits.variation:
            return (), Alarm("OffsetEnergy", s.name)
        offsets.append(offset)
    return tuple(offsets), None


def _check_offset_frames(state: GuardState, offsets: tuple[int, ...], settings: GuardSettings) -> Alarm | None:
    """Check the offsets against the limits alone; a violation can only be a fault of this program."""
    for s, axis, offset in zip(settings.axes, state.axes, offsets, strict=True):
        broken = type(offset) is not int or find_limit_violation(s.limits, axis.offset, axis.rate, offset) is not None
        if broken or not abs(offset) <= compute_offset_ceiling(s.increments_per_mm):
            return Alarm("InternalError", s.name, f"{axis.offset} + {axis.rate} -> {offset}")
    return None


def _note_sent_offset(axis: AxisState, offset: int, setting: AxisSettings) -> AxisState:
    move = offset - axis.offset
    return axis._replace(
        offset=offset,
        rate=move,
        sent=(offset, *axis.sent[:-1]),
        travel=axis.travel.add_move(move, setting.limits.window),
        zero_shown=axis.zero_shown and offset == 0,
    )


def _note_unsent_cycle(axis: AxisState) -> AxisState:
    return axis._replace(rate=0, sent=(axis.sent[0], *axis.sent[:-1]))


def _finish_ramps(state: GuardState, path: CorrectedPath | None, lead: int) -> GuardState:
    """Leave RAMPING once on the table; leave a ramp-down once the drives show 0."""
    if state.mode is Mode.RAMPING and path is not None and len(state.places) == 1:
        on_table = tuple([axis.offset for axis in state.axes]) == path.get_row_offsets(state.places[0].row + lead + 1)
        return state.follow_event(Event.ON_TABLE) if on_table else state
    if state.mode not in RAMPING_MODES:
        return state
    if any(axis.offset or axis.rate for axis in state.axes):
        return state._replace(zeros_sent=0)
    sent = state.zeros_sent + 1
    if sent > ZEROS and all(axis.zero_shown for axis in state.axes):
        return state.follow_event(Event.ZERO_SHOWN, axes=tuple(map(set_offset_confirmed_zero, state.axes)))
    if sent > ZEROS_UNCONFIRMED + lead:
        cause = Alarm("EchoMismatch", detail="no zero was read back")
        return discard_read_backs(state).follow_event(Event.ZERO_NOT_SHOWN, cause=cause)
    return state._replace(zeros_sent=sent)
