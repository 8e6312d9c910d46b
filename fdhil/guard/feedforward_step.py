"""Runs one step of the on-line feed-forward: its alarms, its output, and the check of that output. Pure."""

from fdhil.guard import feedforward_law
from fdhil.guard.feedforward_law import FADE_S
from fdhil.guard.guard_protocol import FeedMode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import GuardState, StepInputs, StepOutput
from fdhil.guard.interlocks import Alarm, Alarms


def is_feedforward_shown(state: GuardState) -> bool:
    """Return whether a drive shows a speed or torque offset."""
    return any(any(axis.fed_back) for axis in state.axes)


def step_feedforward(
    state: GuardState, inputs: StepInputs, alarms: Alarms, settings: GuardSettings, output: StepOutput
) -> tuple[GuardState, StepOutput]:
    """Run one step of the feed-forward; its zeros are sent even without SYNC."""
    before = state.feed.restore_unsent_pairs(inputs.unfed)
    if before.mode is FeedMode.OFF:
        return state, output
    own = () if inputs.main_alive is True else (Alarm("MainLost"),)
    feed = feedforward_law.react_to_alarms(before, (*alarms, *inputs.withdrawn, *own))
    if inputs.sync and feed.mode is not FeedMode.ZEROING:
        feed = feedforward_law.take_targets(feed, [axis.target for axis in inputs.axes])
    if inputs.late or not (inputs.sync or feed.mode is FeedMode.ZEROING):
        return state._replace(feed=feed.record_sent_pairs(feed.applied) if inputs.sync else feed), output
    limits = [axis.limits for axis in settings.feeds]
    moved = feedforward_law.advance_feedforward(
        feed, limits, settings.convert_to_cycles(FADE_S), confirmed=not is_feedforward_shown(state)
    )
    ways = zip(limits, before.applied, moved.applied, strict=True)
    if any(feedforward_law.violates_limits(*way) for way in ways):
        cause = Alarm("InternalError", detail=f"feed-forward {before.applied} -> {moved.applied}")
        moved = feedforward_law.advance_zeroing(feedforward_law.react_to_alarms(before, (cause,)))
    heartbeat = output.heartbeat or state.tick % settings.heartbeat_cycles == 0
    return state._replace(feed=moved), output._replace(feed=moved.applied, heartbeat=heartbeat)
