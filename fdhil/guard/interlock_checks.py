"""Checks the bus and each axis against the interlocks: predicates that must hold before and while offsets are sent.

Every comparison states the good case, so that an unknown value (None, NaN) never passes.
"""

from collections.abc import Callable, Mapping

from fdhil.cia402 import (
    STATUS_FOLLOWING_ERROR,
    STATUS_FOLLOWS_DEMAND,
    STATUS_INTERNAL_LIMIT,
    Mode,
    Nmt,
    decode_power_state,
)
from fdhil.cia402 import PowerState as DriveState
from fdhil.guard.guard_settings import AxisSettings, GuardSettings
from fdhil.guard.guard_state import AxisInput, AxisState, BusView, GuardState, StepInputs
from fdhil.guard.interlocks import Alarm, Alarms

View = tuple[AxisSettings, AxisInput, AxisState]
"""One axis: its settings, its inputs and its state."""
Views = tuple[View, ...]
Good = Callable[[AxisSettings, AxisInput, AxisState], bool]
AGREEING = 3
"""TPDOs in a row that must show the same offset before it is confirmed."""


def combine_axis_views(settings: GuardSettings, inputs: StepInputs, state: GuardState) -> Views:
    """Combine settings, inputs and state of each axis."""
    return tuple(zip(settings.axes, inputs.axes, state.axes, strict=True))


def _has_status_bit(seen: AxisInput, bit: int) -> bool | None:
    """Return whether a statusword bit is set, None when the statusword is unknown."""
    return None if seen.statusword is None else bool(seen.statusword & bit)


def get_confirmed_read_back(axis: AxisState) -> int | None:
    """Return the offset that the drive holds, None until enough TPDOs in a row show the same value."""
    return axis.read_back if axis.readings >= AGREEING else None


def _is_operation_enabled(_own: AxisSettings, seen: AxisInput, _axis: AxisState) -> bool:
    return seen.statusword is not None and decode_power_state(seen.statusword) is DriveState.OPERATION_ENABLED


def _is_following_error_within_window(own: AxisSettings, seen: AxisInput, axis: AxisState) -> bool:
    return not _has_status_bit(seen, STATUS_FOLLOWING_ERROR) and abs(axis.following_error) <= own.window / 2


def _is_heartbeat_recent(own: AxisSettings, seen: AxisInput, _axis: AxisState) -> bool:
    return own.heartbeat_timeout_s == 0 or seen.heartbeat_age_s <= own.heartbeat_timeout_s


# (class, what must be true): evaluated per axis and SYNC, in this order
AXIS_INTERLOCKS: tuple[tuple[str, Good], ...] = (
    ("PdoLength", lambda _own, seen, _axis: seen.short_frames < 3),  # first: others follow from it
    ("StaleData", lambda _own, seen, _axis: seen.feedback_age <= 3),
    ("HeartbeatLost", _is_heartbeat_recent),
    ("NmtStateWrong", lambda _own, seen, _axis: seen.nmt is None or seen.nmt == Nmt.OPERATIONAL),
    ("FollowingError", _is_following_error_within_window),
    ("DriveNotEnabled", _is_operation_enabled),
    ("NotFollowing", lambda _own, seen, _axis: _has_status_bit(seen, STATUS_FOLLOWS_DEMAND) is True),
    ("LimitActive", lambda _own, seen, _axis: _has_status_bit(seen, STATUS_INTERNAL_LIMIT) is False),
    ("NotCsp", lambda _own, seen, _axis: seen.mode == Mode.CYCLIC_SYNC_POSITION),
    ("ReadBackStale", lambda _own, seen, _axis: seen.read_back_age <= 2),
    ("OffsetHijack", lambda _own, _seen, axis: not axis.foreign),
    ("EchoMismatch", lambda _own, _seen, axis: axis.echo_misses < 2 and axis.feed_misses < 2),
    ("Implausible", lambda _own, _seen, axis: axis.implausible < 2),
    ("TargetLost", lambda _own, seen, _axis: seen.target is not None),
    ("FeedbackGap", lambda _own, seen, _axis: seen.feedback_age <= 1),
)
BUS_INTERLOCKS: tuple[tuple[str, Callable[[BusView], bool]], ...] = (
    ("BusDown", lambda bus: bus.state != "down"),
    ("BusOff", lambda bus: bus.state != "off"),
    ("ErrorPassive", lambda bus: bus.state != "passive"),
    ("SyncLost", lambda bus: not bus.silent),
    ("SyncJitter", lambda bus: bus.sync_regular),
    ("RxOverflow", lambda bus: bus.lost_frames == 0),
)
# needed to arm only: per axis
ARMING_INTERLOCKS: tuple[tuple[str, Good], ...] = (
    ("StaleOffset", lambda _own, _seen, axis: not axis.read_back and not any(axis.fed_back)),
    ("ReadBackStale", lambda _own, _seen, axis: get_confirmed_read_back(axis) is not None),
    ("NotCommissioned", lambda own, _seen, _axis: bool(own.record)),
    ("RecordVoid", lambda _own, _seen, axis: not axis.record_void),
    ("PdoMapping", lambda _own, seen, _axis: seen.long_frames == 0),
    ("LimitBeyondWindow", lambda own, _seen, _axis: own.limits.offset <= own.window / 4),
)


def list_failing_interlocks(bus: BusView, views: Views) -> Alarms:
    """Return an alarm for every interlock that fails at this SYNC."""
    of_bus = [Alarm(code) for code, good in BUS_INTERLOCKS if not good(bus)]
    return (*of_bus, *[Alarm(code, v[0].name) for v in views for code, good in AXIS_INTERLOCKS if not good(*v)])


def list_arming_obstacles(views: Views) -> Alarms:
    """Return an alarm for every condition of the drives, beyond ``list_failing_interlocks``, that forbids arming."""
    return tuple([_make_arming_alarm(code, v) for v in views for code, good in ARMING_INTERLOCKS if not good(*v)])


def _make_arming_alarm(code: str, view: View) -> Alarm:
    own, _seen, axis = view
    return Alarm(code, own.name, own.void_reason if code == "RecordVoid" and not axis.touched else "")


def list_missing_facts(facts: Mapping[str, object], needed: Mapping[str, str]) -> Alarms:
    """Return an alarm for every required fact that the daemon does not attest; only a literal ``True`` counts."""
    return tuple(Alarm(code) for fact, code in needed.items() if facts.get(fact) is not True)
