"""Tracks the NC's state: for the status, for notices, and for the program line of a notice. Pure.

Times are inputs.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from fdhil.daemon.service_log import escape_unprintable
from fdhil.records import MoveKind, NcState, Notice

FRESH_S = 1.0
FULL = 0.005  # tolerance of an override of 100 %
WORKING = (MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC, MoveKind.HOLD)
HELD = "held rapids are not identified, and a correction waits"
ADVICE = {
    "rapid override": "rapids are not identified until it is 100 %",
    "feed override": "a program is corrected only at the speed it was planned for",
}


class NcWatch:
    """The newest state of the NC, and what is unusual about it."""

    def __init__(self) -> None:
        self._state: NcState | None = None
        self._received_s = 0.0
        self._unusual: dict[str, str] = {}

    def take_state(self, state: NcState, now_s: float) -> list[Notice]:
        """Take a state; return notices for what becomes unusual, and for what is normal again."""
        self._state, self._received_s = state, now_s
        if state.motion is MoveKind.UNKNOWN:
            return []
        found = dict(_find_unusual(state))
        begun = [_make_notice(what, "minor", text) for what, text in found.items() if what not in self._unusual]
        over = [_make_notice(what, "info", _describe_normal_again(what)) for what in self._unusual if what not in found]
        self._unusual = found
        return begun + over

    def add_nc_line(self, notice: Notice, now_s: float) -> Notice:
        """Return a notice as reported: printable, and unless it is info with the current line of the NC."""
        return replace(notice, text=escape_unprintable(notice.text + self._describe_nc_line(notice, now_s)))

    def _describe_nc_line(self, notice: Notice, now_s: float) -> str:
        state = self._state
        if state is None or notice.severity == "info" or state.line is None or state.motion not in WORKING:
            return ""
        if now_s - self._received_s > FRESH_S:
            return ""
        program = "" if state.program is None else f" of {state.program.rpartition('/')[2]}"
        return f" (the NC is at line {state.line}{program})"

    def build_status(self, now_s: float) -> dict[str, Any] | None:
        """Return the NC's last reported state with its age; None when there was none."""
        state = self._state
        if state is None:
            return None
        return {
            "motion": state.motion.value,
            "line": state.line,
            "program": state.program,
            "feed_mm_min": state.feed_mm_min,
            "programmed_feed_mm_min": state.programmed_feed_mm_min,
            "feed_override": state.feed_override,
            "rapid_override": state.rapid_override,
            "feed_hold": state.feed_hold,
            "tool": state.tool,
            "heard_s_ago": round(now_s - self._received_s, 3),
        }


def _find_unusual(state: NcState) -> Iterator[tuple[str, str]]:
    if state.is_held:
        yield "feed hold", f"the NC's feed is held: {HELD}"
    for what, override in (("rapid override", state.rapid_override), ("feed override", state.feed_override)):
        if override is not None and abs(override - 1.0) > FULL:
            yield what, f"the NC's {what} is {100 * override:.0f} %: {ADVICE[what]}"


def _describe_normal_again(what: str) -> str:
    return "the NC's feed continues" if what == "feed hold" else f"the NC's {what} is 100 % again"


def _make_notice(what: str, severity: Any, text: str) -> Notice:
    return Notice("FeedHold" if what == "feed hold" else "OverrideChanged", severity, text)
