"""Assesses the offset that a drive still holds and ramps it to zero once it is trustworthy. Pure, part of the core.

A value is confirmed when three TPDOs in a row showed it, each in its own cycle. It is trusted, and only then sent, when
it also lies within the compiled ceiling, agrees with the drive's own demand (0x6062), and the drive is as it was
commissioned.
"""

from fdhil.guard import feedforward_law
from fdhil.guard.corrected_path import EPS
from fdhil.guard.feedforward_step import is_feedforward_shown
from fdhil.guard.guard_protocol import AT_REST, SENDING, FeedMode, Mode
from fdhil.guard.guard_settings import AxisSettings, GuardSettings
from fdhil.guard.guard_state import AxisState, GuardRequest, GuardState, StepInputs
from fdhil.guard.interlock_checks import (
    AGREEING,
    ARMING_INTERLOCKS,
    View,
    Views,
    combine_axis_views,
    get_confirmed_read_back,
)
from fdhil.guard.interlocks import Alarm, Alarms, Reaction
from fdhil.guard.offset_limits import CEILING_OFFSET_UM, compute_offset_ceiling
from fdhil.guard.state_transitions import Event

PERIODS_AWAITED = 2 * AGREEING
"""TPDOs within which a value must be confirmed: three in a row, after as many doubtful ones."""
EMPTIED_S = 0.25  # until HAL's limit3, behind the queue, has brought any offset to zero
DISTURBED_CYCLES = 1000
"""SYNC cycles after another node wrote an offset, in which nothing is adopted."""
IMPLAUSIBLE = frozenset({"StaleData", "TargetLost", "FollowingError", "Implausible", "PdoLength"})
OF_THE_RECORD = frozenset({"NotCommissioned", "RecordVoid", "PdoMapping"})


def count_cycles_to_wait(settings: GuardSettings) -> int:
    """Return the number of SYNC cycles to wait for a confirmed value; a queue (HAL) needs time to run empty first."""
    emptied = settings.lead + settings.convert_to_cycles(EMPTIED_S) if settings.lead else 0
    return PERIODS_AWAITED * max([axis.read_back_every for axis in settings.axes]) + emptied


def find_adoption_doubts(views: Views, alarms: Alarms) -> Alarms:
    """Return every reason not to trust what the drives show; empty: the ramp to zero may start from there."""
    found = [alarm for alarm in alarms if alarm.code in IMPLAUSIBLE]
    for view in views:
        found += [
            Alarm(code, view[0].name) for code, good in ARMING_INTERLOCKS if code in OF_THE_RECORD and not good(*view)
        ]
        why = _explain_offset_doubt(view)
        if why:
            found.append(Alarm("OffsetDoubtful", view[0].name, why))
    return tuple(found)


def _explain_offset_doubt(view: View) -> str:
    own, _seen, axis = view
    held = get_confirmed_read_back(axis)
    if held is None:
        return "no three TPDOs in a row agree on it"
    if not abs(held) <= compute_offset_ceiling(own.increments_per_mm):
        return f"{_describe_offset(own, held)}: beyond the ceiling of {CEILING_OFFSET_UM:.0f} um"
    if not axis.off_demand <= EPS:
        return f"{_describe_offset(own, held)}: its demand (0x6062) contradicts it"
    return ""


def _describe_offset(own: AxisSettings, held: int) -> str:
    return f"{own.sign * held / own.increments_per_mm * 1e3:.1f} um may still be applied"


def choose_freeze_cause(views: Views, doubtful: Alarms) -> Alarm:
    """Return the cause of freezing: the axis that shows an offset, its size, and the first thing that is wrong."""
    own, _, axis = next((view for view in views if view[2].read_back), views[0])
    doubt = next((a for a in doubtful if a.axis == own.name and a.code == "OffsetDoubtful"), None)
    if doubt is not None:
        return doubt
    return Alarm("OffsetDoubtful", own.name, f"{_describe_offset(own, axis.read_back or 0)}: {doubtful[0].cause}")


def list_applied_offsets(state: GuardState) -> tuple[int | None, ...]:
    """Return the offset that may still be applied in each drive, increments; 0: certainly none, None: unknown."""
    return tuple([_find_applied_offset(state, axis) for axis in state.axes])


def _find_applied_offset(state: GuardState, axis: AxisState) -> int | None:
    if state.mode in SENDING and not state.measuring:
        return axis.read_back if axis.echo_misses else axis.sent[0]
    held = get_confirmed_read_back(axis)
    if held is None and state.adopt_checked and is_zero_confirmed(axis):
        return 0
    if held is None and state.mode is Mode.FROZEN:
        return axis.sent[0] or None  # the last one sent; zeros that were not read back prove nothing
    return held


def is_zero_confirmed(axis: AxisState) -> bool:
    """Return whether only zeros were sent, and the drive has shown zero since then and in its last TPDO."""
    return not any(axis.sent) and not axis.read_back and (axis.zero_shown or get_confirmed_read_back(axis) == 0)


def list_adopt_refusals(state: GuardState, request: GuardRequest, alarms: Alarms, views: Views) -> Alarms:
    """Return every reason to refuse an adopt request; empty: granted."""
    refused = [alarm for alarm in alarms if alarm.reaction is Reaction.FREEZE]
    if state.undisturbed_for < DISTURBED_CYCLES:
        refused.append(Alarm("OffsetHijack", detail=f"{state.undisturbed_for} SYNC ago"))
    if not _is_nothing_applied(state):
        refused += find_adoption_doubts(views, alarms)
    if state.mode not in AT_REST or state.feed.mode is not FeedMode.OFF:
        refused.append(Alarm("NotOff", detail=state.mode.value))
    if request.token_valid is not True:
        refused.append(Alarm("AuthRequired"))
    return tuple(refused)


def _is_nothing_applied(state: GuardState) -> bool:
    return not _is_feedforward_applied(state) and all(get_confirmed_read_back(axis) == 0 for axis in state.axes)


def _is_feedforward_applied(state: GuardState) -> bool:
    return is_feedforward_shown(state) or state.feed.unconfirmed


def begin_adoption(state: GuardState, settings: GuardSettings) -> GuardState:
    """Start the ramp to zero from the values read back; speed and torque offsets get zeros at once."""
    cause = Alarm("StaleOffset")
    if _is_nothing_applied(state):
        return state.follow_event(
            Event.NOTHING_HELD, axes=tuple(map(set_offset_confirmed_zero, state.axes)), cause=None
        )
    feed = (
        feedforward_law.begin_zeroing(len(state.axes), cause)
        if _is_feedforward_applied(state) and settings.feeds
        else state.feed
    )
    state = state.follow_event(Event.ADOPT, zeros_sent=0, cause=cause, feed=feed)
    return _start_ramp_from_read_back(state)


def _start_ramp_from_read_back(state: GuardState) -> GuardState:
    return state._replace(
        axes=tuple([set_offset_at_rest(axis, get_confirmed_read_back(axis) or 0) for axis in state.axes]), measuring=0
    )


def apply_drive_comparison(
    state: GuardState, request: GuardRequest, settings: GuardSettings
) -> tuple[GuardState, Alarms]:
    """Validate the record of each drive that matches the one signed off; void it where the drive differs.

    A record is void, too, where the drive was written to or rebooted after the comparison.
    """
    refused = [] if request.token_valid is True else [Alarm("AuthRequired")]
    if state.sending:
        refused.append(Alarm("NotOff", detail=state.mode.value))
    if refused:
        return state, tuple(refused)
    axes = []
    for own, axis in zip(settings.axes, state.axes, strict=True):
        found = request.compared.get(own.name)
        why = (
            ""
            if found is None
            else _explain_void_record(own.record, found, axis.touched != request.touched.get(own.name))
        )
        if why:
            refused.append(Alarm("RecordVoid", own.name, why))
        axes.append(axis._replace(record_void=bool(why) or (found is None and axis.record_void)))
    return state._replace(axes=tuple(axes)), tuple(refused)


def _explain_void_record(record: str, found: str, touched: bool) -> str:
    """Return why a record is void after its drive was compared; empty: it is valid."""
    if not record or found != record:
        return "it differs from the guard's record"
    return "after it was compared" if touched else ""


def set_offset_at_rest(axis: AxisState, offset: int) -> AxisState:
    """Return the axis with ``offset`` applied and no motion."""
    return axis._replace(offset=offset, rate=0, sent=(offset,) * len(axis.sent), echo_misses=0, zero_shown=False)


def set_offset_confirmed_zero(axis: AxisState) -> AxisState:
    """Return the axis as its drive has shown it: 0 is applied, and only 0 is sent."""
    return set_offset_at_rest(axis, 0)._replace(readings=AGREEING, zero_shown=True)


def discard_read_backs(state: GuardState) -> GuardState:
    """Return the state without the read-backs, so that they have to be confirmed again."""
    return state._replace(axes=tuple([axis._replace(read_back=None, zero_shown=False) for axis in state.axes]))


def freeze_sending(state: GuardState, cause: Alarm) -> GuardState:
    """Stop sending: the applied offset becomes unknown, unless only zeros were sent and read back."""
    if not state.measuring and all(map(is_zero_confirmed, state.axes)):
        return state.follow_event(Event.BLOCKED_AT_ZERO, cause=cause, places=())
    axes = tuple([axis._replace(read_back=None) for axis in state.axes])
    return state.follow_event(Event.BLOCKED, cause=cause, places=(), axes=axes, measuring=0)


def adopt_at_start(
    state: GuardState, inputs: StepInputs, alarms: Alarms, views: Views, settings: GuardSettings
) -> GuardState:
    """Once after the start, ramp an applied offset to zero from its value; freeze when it is in doubt."""
    if state.adopt_checked or state.mode is not Mode.OFF or not inputs.sync:
        return state
    unsafe = any(a.code in ("SyncJitter", "OffsetHijack", "BusLocked") or a.reaction is Reaction.FREEZE for a in alarms)
    if unsafe:
        return state
    if _is_nothing_applied(state):
        return state._replace(adopt_checked=True)
    if not is_feedforward_shown(state) and not any(axis.read_back for axis in state.axes):
        return state._replace(unknown_for=0)
    if state.undisturbed_for < DISTURBED_CYCLES:  # that node would write its offset again
        shows = next(axis for axis, held in zip(settings.axes, state.axes, strict=True) if held.read_back)
        return state.follow_event(Event.DOUBTFUL, cause=Alarm("OffsetHijack", shows.name), adopt_checked=True)
    doubtful = find_adoption_doubts(views, alarms)
    if doubtful and state.unknown_for < count_cycles_to_wait(settings):
        return state._replace(unknown_for=state.unknown_for + 1)
    state = state._replace(adopt_checked=True)
    return (
        state.follow_event(Event.DOUBTFUL, cause=choose_freeze_cause(views, doubtful))
        if doubtful
        else begin_adoption(state, settings)
    )


def wait_for_read_backs(state: GuardState, inputs: StepInputs, alarms: Alarms, settings: GuardSettings) -> GuardState:
    """After another node wrote an offset, send nothing until the drives show confirmed values; then ramp to zero."""
    if not state.measuring:
        return state
    views = combine_axis_views(settings, inputs, state)
    doubtful = find_adoption_doubts(views, alarms)
    if not doubtful:
        return _start_ramp_from_read_back(state)
    if state.measuring < count_cycles_to_wait(settings):
        return state._replace(measuring=state.measuring + 1)
    return freeze_sending(state, choose_freeze_cause(views, doubtful))
