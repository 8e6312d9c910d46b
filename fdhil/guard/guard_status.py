"""Builds the guard's status document, with offsets in the unit and direction of the axis."""

from collections.abc import Mapping, Sequence
from typing import Any

from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.feedforward_law import FeedforwardState
from fdhil.guard.guard_protocol import FEEDFORWARD_STATE, FeedMode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import GuardState
from fdhil.guard.interlocks import Alarm
from fdhil.guard.offset_adoption import list_applied_offsets

FED = "speed and torque offsets may still be applied"


def build_alarm_document(alarm: Alarm) -> dict[str, str]:
    """Return an alarm as clients receive it."""
    late = {"late": alarm.late} if alarm.late else {}
    return {"code": alarm.code, "axis": alarm.axis, "text": alarm.cause, "advice": alarm.action, **late}


def convert_to_um(offsets: Sequence[int | None], settings: GuardSettings) -> dict[str, float | None]:
    """Convert increments per axis to um in the axis' direction; None stays."""
    pairs = zip(settings.axes, offsets, strict=True)
    return {s.name: None if o is None else round(s.sign * o / s.increments_per_mm * 1e3, 3) for s, o in pairs}


def get_sent_offset_um(state: GuardState, settings: GuardSettings) -> dict[str, float | None]:
    """Return the offsets sent last."""
    return convert_to_um([axis.offset for axis in state.axes], settings)


def get_applied_offset_um(state: GuardState, settings: GuardSettings) -> dict[str, float | None]:
    """Return the offset that may still be applied in each drive: 0.0: certainly none, None: unknown."""
    return convert_to_um(list_applied_offsets(state), settings)


def describe_applied_offset(standing_um: Mapping[str, float | None], feed: FeedforwardState | None = None) -> str:
    """Describe what may still be applied; empty when certainly nothing is."""
    left = [
        f"{'an unknown offset' if um is None else f'{um:.1f} um'} on {x}" for x, um in standing_um.items() if um != 0
    ]
    if not left and feed is not None and feed.may_stand:
        return FED
    return f"{' and '.join(left)} may still be applied" if left else ""


def build_status_document(
    state: GuardState, settings: GuardSettings, path: CorrectedPath | None, not_good: Sequence[Alarm]
) -> dict[str, Any]:
    """Return the status of state and table; the loop adds what only it knows."""
    cause, feed = state.cause or state.feed.cause, state.feed
    return {
        "state": state.mode.value if feed.mode is FeedMode.OFF else FEEDFORWARD_STATE,
        "cause": build_alarm_document(cause) if cause else None,
        "feedforward": {
            "state": feed.mode.value,
            "cause": build_alarm_document(feed.cause) if feed.cause else None,
            "confirmed": not feed.unconfirmed,
            "limited_cycles": feed.limited,
            "applied": {s.name: list(p) for s, p in zip(settings.axes, feed.applied, strict=False)},
        },
        "tick": state.tick,
        "good_for": state.good_for,
        "row": state.places[0].row if state.places else None,
        "rows": [path.first, path.end] if path else None,
        "table_sequence": path.sequence if path else 0,
        "program_digest": path.program_digest if path else "",
        "offset_um": get_sent_offset_um(state, settings),
        "may_stand_um": get_applied_offset_um(state, settings),
        "missed_cycles": state.missed,
        "touched": {s.name: a.touched for s, a in zip(settings.axes, state.axes, strict=True)},
        "late_frames": {s.name: a.late_echoes for s, a in zip(settings.axes, state.axes, strict=True)},
        "not_good": [build_alarm_document(alarm) for alarm in not_good],
    }
