"""Runs one step of the on-line feed-forward: its alarms, its output, and the check of that output. Pure."""

from fdhil.guard import feedforward
from fdhil.guard.feedforward import FADE_S
from fdhil.guard.interlocks import Alarm, Alarms
from fdhil.guard.protocol import FeedMode
from fdhil.guard.settings import Settings
from fdhil.guard.state import Inputs, Output, State


def is_fed(state: State) -> bool:
    """Return whether a drive shows a speed or torque offset."""
    return any(any(axis.fed_back) for axis in state.axes)


def go_on(state: State, inputs: Inputs, alarms: Alarms, settings: Settings, output: Output) -> tuple[State, Output]:
    """Run one step of the feed-forward; its zeros are sent even without SYNC."""
    before = state.feed.not_sent(inputs.unfed)
    if before.mode is FeedMode.OFF:
        return state, output
    own = () if inputs.main_alive is True else (Alarm("MainLost"),)
    feed = feedforward.react(before, (*alarms, *inputs.withdrawn, *own))
    if inputs.sync and feed.mode is not FeedMode.ZEROING:
        feed = feedforward.hear(feed, [axis.target for axis in inputs.axes])
    if inputs.late or not (inputs.sync or feed.mode is FeedMode.ZEROING):
        return state._replace(feed=feed.send(feed.applied) if inputs.sync else feed), output
    limits = [axis.limits for axis in settings.feeds]
    moved = feedforward.move(feed, limits, settings.cycles(FADE_S), confirmed=not is_fed(state))
    ways = zip(limits, before.applied, moved.applied, strict=True)
    if any(feedforward.violates(*way) for way in ways):
        cause = Alarm("InternalError", detail=f"feed-forward {before.applied} -> {moved.applied}")
        moved = feedforward.zeroed(feedforward.react(before, (cause,)))
    heartbeat = output.heartbeat or state.tick % settings.heartbeat_cycles == 0
    return state._replace(feed=moved), output._replace(feed=moved.applied, heartbeat=heartbeat)
