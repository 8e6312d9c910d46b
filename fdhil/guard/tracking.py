"""Locates the machine on the path by the NC's targets alone. Pure, part of the core's step."""

from fdhil.guard.interlocks import Alarm
from fdhil.guard.path import EPS, CorrectedPath, Place, advance, around, onward, rate_between
from fdhil.guard.state import State
from fdhil.guard.transitions import Event

STILL_CYCLES = 10
"""SYNC cycles for which the targets must stand at the path's start before a move can begin it."""
RATE_TOLERANCE = 0.02
HIGHEST_RATE = 1.6
"""The highest rate of an NC's override; a larger step along the path is a jump."""


def rest(state: State) -> State:
    """Count how long the targets have stood still, armed or not; a missing target changes nothing."""
    now = state.targets[0]
    if now is None:
        return state
    return state._replace(rest=now, rested_for=state.rested_for + 1 if now == state.rest else 0)


def await_start(state: State, path: CorrectedPath) -> tuple[State, Alarm | None]:
    """While ARMED: once the targets have stood at the path's start, the first to leave it locates the path."""
    now, stood = state.targets[0], state.rest
    if now is None or stood is None or now == stood or state.rested_for < STILL_CYCLES:
        return state, None
    distance = path.mismatch(path.first, stood)
    if distance is None or distance > EPS:
        return state, None
    places = around(path, state.start_row + 1, now)
    if not places:
        return state, Alarm("Misaligned", detail="the first move leaves the path")
    return state.after(Event.START, places=places, anchor=places[0].row, cause=None), None


def track(state: State, path: CorrectedPath) -> tuple[State, Alarm | None]:
    """Advance along the path with the targets; return an alarm when they do not match."""
    targets = state.targets[0]
    places = advance(path, state.places, targets)
    if places:
        return state._replace(places=places, anchor=places[0].row if targets else state.anchor, resuming=False), None
    assert targets is not None
    distance = path.mismatch(state.anchor, targets)
    if targets == state.targets[1] and distance is not None and distance <= EPS:
        return state._replace(places=(Place(state.anchor),), resuming=True), Alarm("FeedHold")
    looks = state.resuming or path.stands(state.anchor)  # a dwell ends by the NC's clock, a few cycles sooner or later
    places = around(path, state.anchor + 1, targets) if looks else ()
    if places:
        return state._replace(places=places, anchor=places[0].row, resuming=False), None
    return state._replace(places=onward(state.places), resuming=False), _lost(state, path, targets)


def _lost(state: State, path: CorrectedPath, targets: tuple[int, ...]) -> Alarm:
    """Return the alarm for targets that match no row: the path runs at another rate, or it is another path."""
    last = state.targets[1]
    rate = rate_between(path, state.places[0].row, last, targets) if last is not None else None
    if rate is None or not 0 <= rate <= HIGHEST_RATE or abs(rate - 1) <= RATE_TOLERANCE:
        return Alarm("Misaligned")
    return Alarm("OverrideChanged", detail=f"{100 * rate:.0f} % of the planned rate")
