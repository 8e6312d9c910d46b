"""Locates the machine on the path by the NC's targets alone. Pure, part of the core's step."""

from fdhil.guard.corrected_path import (
    EPS,
    CorrectedPath,
    PathPosition,
    advance_matching,
    advance_positions,
    compute_path_rate,
    search_near_row,
)
from fdhil.guard.guard_state import GuardState
from fdhil.guard.interlocks import Alarm
from fdhil.guard.state_transitions import Event

STILL_CYCLES = 10
"""SYNC cycles for which the targets must stand at the path's start before a move can begin it."""
RATE_TOLERANCE = 0.02
HIGHEST_RATE = 1.6
"""The highest rate of an NC's override; a larger step along the path is a jump."""


def count_standstill(state: GuardState) -> GuardState:
    """Count how long the targets have stood still, armed or not; a missing target changes nothing."""
    now = state.targets[0]
    if now is None:
        return state
    return state._replace(rest=now, rested_for=state.rested_for + 1 if now == state.rest else 0)


def await_start(state: GuardState, path: CorrectedPath) -> tuple[GuardState, Alarm | None]:
    """While ARMED: once the targets have stood at the path's start, the first to leave it locates the path."""
    now, stood = state.targets[0], state.rest
    if now is None or stood is None or now == stood or state.rested_for < STILL_CYCLES:
        return state, None
    distance = path.measure_row_distance(path.first, stood)
    if distance is None or distance > EPS:
        return state, None
    places = search_near_row(path, state.start_row + 1, now)
    if not places:
        return state, Alarm("Misaligned", detail="the first move leaves the path")
    return state.follow_event(Event.START, places=places, anchor=places[0].row, cause=None), None


def track_path(state: GuardState, path: CorrectedPath) -> tuple[GuardState, Alarm | None]:
    """Advance along the path with the targets; return an alarm when they do not match."""
    targets = state.targets[0]
    places = advance_matching(path, state.places, targets)
    if places:
        return state._replace(places=places, anchor=places[0].row if targets else state.anchor, resuming=False), None
    assert targets is not None
    distance = path.measure_row_distance(state.anchor, targets)
    if targets == state.targets[1] and distance is not None and distance <= EPS:
        return state._replace(places=(PathPosition(state.anchor),), resuming=True), Alarm("FeedHold")
    looks = state.resuming or path.is_demand_standing(
        state.anchor
    )  # a dwell ends by the NC's clock, a few cycles sooner or later
    places = search_near_row(path, state.anchor + 1, targets) if looks else ()
    if places:
        return state._replace(places=places, anchor=places[0].row, resuming=False), None
    return state._replace(places=advance_positions(state.places), resuming=False), _explain_lost_position(
        state, path, targets
    )


def _explain_lost_position(state: GuardState, path: CorrectedPath, targets: tuple[int, ...]) -> Alarm:
    """Return the alarm for targets that match no row: the path runs at another rate, or it is another path."""
    last = state.targets[1]
    rate = compute_path_rate(path, state.places[0].row, last, targets) if last is not None else None
    if rate is None or not 0 <= rate <= HIGHEST_RATE or abs(rate - 1) <= RATE_TOLERANCE:
        return Alarm("Misaligned")
    return Alarm("OverrideChanged", detail=f"{100 * rate:.0f} % of the planned rate")
