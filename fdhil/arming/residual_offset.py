"""Determines what offset may still be applied in the drives, by the guard's last status."""

import contextlib
import math
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from typing import Any

from fdhil.guard import AT_REST
from fdhil.system_clock import SYSTEM_CLOCK, Clock

GONE = frozenset({"absent", "lost"})
REST: frozenset[str] = AT_REST | GONE
ABSENT: Mapping[str, Any] = {"state": "absent", "text": "no guard runs: nothing can be armed, nothing is sent"}
LANDING_S = 3.0  # without a SYNC; the ramp and the zeros after it are counted in SYNC by the guard
LOOK_S = 0.02
ADOPT_ADVICE = "hold the feed, then run fdhil adopt"
START_AND_ADOPT = "hold the feed, start fdhil-guard, then run fdhil adopt"


@dataclass(frozen=True, slots=True)
class ResidualOffset:
    """``offset_um`` of each axis in its own direction (None: unknown), ``fed``: axes with speed or torque offsets.

    ``heard`` is False if there never was a guard, so that nothing was sent.
    """

    offset_um: Mapping[str, float | None]
    feedforward_axes: tuple[str, ...] = ()
    guard_seen: bool = True

    @property
    def is_zero(self) -> bool:
        """Whether it is certain that no offset is applied; an unknown offset is not certain."""
        return not self.guard_seen or (
            bool(self.offset_um) and not self.feedforward_axes and not any(um != 0.0 for um in self._list_values())
        )

    @property
    def is_applied(self) -> bool:
        """Whether it is certain that an offset is applied."""
        return bool(self.feedforward_axes) or any(self._list_values())

    def _list_values(self) -> list[float | None]:
        return list(self.offset_um.values())

    def __str__(self) -> str:
        if not self.guard_seen:
            return "there was no guard, nothing was sent"
        if self.is_zero:
            return "offset 0"
        parts = [f"{um:+.3g} um on axis {axis}" for axis, um in self.offset_um.items() if um]
        unknown = [axis for axis, um in self.offset_um.items() if um is None]
        if unknown:
            parts.append(f"an unknown offset on axis {', '.join(unknown)}")
        if self.feedforward_axes:
            parts.append(f"speed and torque offsets on axis {', '.join(self.feedforward_axes)}")
        return (" and ".join(parts) or "an unknown offset") + " may still be applied"


def read_residual_offset(status: Mapping[str, Any]) -> ResidualOffset:
    """Return what may be applied by a status document of the guard; what it does not report is unknown.

    A zero of a guard that is not idle is unknown too: the next SYNC may change it.
    """
    offsets = status.get("may_stand_um")
    if status["state"] == "absent" and offsets is None:
        return ResidualOffset({}, guard_seen=False)
    moving = status["state"] not in (*AT_REST, "absent")
    known = {str(axis): _parse_number(value) for axis, value in offsets.items()} if isinstance(offsets, Mapping) else {}
    offset_um = {axis: None if moving and um == 0.0 else um for axis, um in known.items()}
    return ResidualOffset(offset_um, _find_feedforward_axes(status.get("feedforward")))


def _parse_number(value: Any) -> float | None:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    with contextlib.suppress(OverflowError):  # an integer of hundreds of digits
        return float(value) if math.isfinite(value) else None
    return None


def _find_feedforward_axes(feedforward: Any) -> tuple[str, ...]:
    """Return the axes whose speed or torque offset is on, or was not confirmed as zero."""
    if not isinstance(feedforward, Mapping):
        return ()
    applied = feedforward.get("applied") or {}
    on = feedforward.get("state", "OFF") != "OFF" or feedforward.get("confirmed") is False
    return tuple(axis for axis, pair in applied.items() if on or any(pair))


def make_lost_status(before: Mapping[str, Any], arming: bool) -> Mapping[str, Any]:
    """Return the status of a guard that is gone: its last one, with what may have moved since as unknown.

    ``arming``: it went while it was asked to arm, so that it may have armed.
    """
    if before["state"] in GONE and not arming:
        return before
    last = {**before, "state": "lost" if arming or before["state"] not in AT_REST else before["state"]}
    residual = read_residual_offset(last)
    known = {
        "may_stand_um": residual.offset_um,
        "feedforward": before.get("feedforward"),
        "last_state": before["state"],
    }
    if residual.is_zero:
        text = "the guard is gone; by its last status nothing was applied"
        return {"state": "absent", "text": text, **known}
    return {"state": "lost", "text": f"the guard is gone; {residual}; {START_AND_ADOPT}", **known}


def wait_until_idle(
    look: Callable[[], Mapping[str, Any]],
    patience_s: float = LANDING_S,
    landing: Set[str] | None = None,
    clock: Clock = SYSTEM_CLOCK,
) -> Mapping[str, Any]:
    """Wait until the guard is idle or gone, as long as SYNC advances, and return its status (blocking).

    ``look`` reads the status; in states outside ``landing`` its SYNC does not count. Errors of ``look`` pass through.
    """
    status, tick, moved_s = look(), None, clock.now_s()
    while status["state"] not in REST and clock.now_s() - moved_s < patience_s:
        if status.get("tick") != tick and (landing is None or status["state"] in landing):
            tick, moved_s = status.get("tick"), clock.now_s()
        clock.sleep(LOOK_S)
        status = look()
    return status


def answer_disarm(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the answer to a request for zero: ok only if the guard is off and certain that nothing is applied."""
    residual, state = read_residual_offset(status), status["state"]
    report = {"state": state, "may_stand_um": dict(residual.offset_um)}
    if state == "OFF" and residual.is_zero:
        return {"ok": True, "text": f"guard: OFF, {residual}", **report}
    cause = (status.get("cause") or {}).get("text")
    text = f"the guard is {state}" + (f" ({cause})" if cause else "") + f": {residual}"
    advice = ADOPT_ADVICE if state in AT_REST else f"check fdhil status; if it does not end, {ADOPT_ADVICE}"
    return {"ok": False, "code": "OffsetStands", "text": text, "advice": advice, **report}
