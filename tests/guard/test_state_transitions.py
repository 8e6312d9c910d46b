"""The table of transitions: forbidden contents, and no transition outside it."""

from __future__ import annotations

import pytest

from fdhil.guard.feedforward_law import FeedforwardState, arm_feedforward
from fdhil.guard.guard_protocol import (
    AT_REST,
    CHARGED_STATES,
    IN_CHARGE,
    ON_PATH,
    RAMPING_MODES,
    SENDING,
    FeedMode,
    Mode,
)
from fdhil.guard.guard_state import GuardRequest, make_initial_state
from fdhil.guard.state_transitions import (
    FEED_SENT,
    FEED_TRANSITIONS,
    SENT,
    TRANSITIONS,
    ZEROS,
    ZEROS_UNCONFIRMED,
    Event,
)
from tests.guard import simulated_bus
from tests.guard.simulated_bus import Bench

WAYS = {(mode, event): after for event, modes, after in TRANSITIONS for mode in modes}
FEED_WAYS = {(mode, event): after for event, modes, after in FEED_TRANSITIONS for mode in modes}
ASKED = {Event.ARM, Event.NOTHING_HELD}
"""What only a request leads to."""


def test_every_state_is_idle_in_charge_or_ramping_down() -> None:
    assert set(SENT) == set(Mode)
    assert set(FEED_SENT) == set(FeedMode)
    assert set(Mode) == AT_REST | IN_CHARGE | RAMPING_MODES
    assert not AT_REST & SENDING
    assert not IN_CHARGE & RAMPING_MODES
    assert {*IN_CHARGE, "FEEDFORWARD"} == CHARGED_STATES


def test_no_event_leads_to_two_states() -> None:
    assert len(WAYS) == sum(len(modes) for _, modes, _ in TRANSITIONS)
    assert len(FEED_WAYS) == sum(len(modes) for _, modes, _ in FEED_TRANSITIONS)
    assert {event for _, event in WAYS} == set(Event)


def test_only_arming_leads_away_from_off() -> None:
    for (mode, event), after in WAYS.items():
        if mode in AT_REST and after in IN_CHARGE:
            assert (mode, event, after) == (Mode.OFF, Event.ARM, Mode.ARMED)
        if mode in RAMPING_MODES:
            assert after in (*AT_REST, Mode.RAMP_DOWN)
        if mode in ON_PATH:
            assert after is not Mode.ARMED
        if mode is Mode.FROZEN:
            assert event in (Event.ADOPT, Event.NOTHING_HELD)


@pytest.mark.parametrize("mode", sorted(SENDING))
def test_every_sending_state_can_freeze_and_ends_idle(mode: Mode) -> None:
    assert WAYS[mode, Event.BLOCKED] is Mode.FROZEN
    reached, ahead = set(), {mode}
    while ahead:
        reached |= ahead
        ahead = {a for (m, event), a in WAYS.items() if m in ahead and event not in ASKED} - reached
    assert reached >= AT_REST


@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("mode", Mode)
def test_unlisted_transition_is_an_error(mode: Mode, event: Event) -> None:
    state = make_initial_state(simulated_bus.settings())._replace(mode=mode)
    if (mode, event) in WAYS:
        assert state.follow_event(event).mode is WAYS[mode, event]
    else:
        with pytest.raises(KeyError):
            state.follow_event(event)


@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("mode", FeedMode)
def test_unlisted_feedforward_transition_is_an_error(mode: FeedMode, event: Event) -> None:
    feed = FeedforwardState(mode)
    if (mode, event) in FEED_WAYS:
        assert feed.follow_event(event, None).mode is FEED_WAYS[mode, event]
    else:
        with pytest.raises(KeyError):
            feed.follow_event(event, None)


def test_feedforward_starts_only_by_arming() -> None:
    assert arm_feedforward(()).mode is FeedMode.ON
    assert [mode for (mode, _), after in FEED_WAYS.items() if after is FeedMode.ON] == [FeedMode.OFF]
    assert {after for (mode, _), after in FEED_WAYS.items() if mode is FeedMode.ZEROING} == {FeedMode.OFF}


@pytest.mark.parametrize("mode", Mode)
def test_two_events_lead_from_every_state_to_idle(mode: Mode) -> None:
    if mode in IN_CHARGE:
        assert WAYS[mode, Event.END] is Mode.RAMP_DOWN
    landed = WAYS.get((mode, Event.END), mode)
    for event in (Event.ZERO_SHOWN, Event.ZERO_NOT_SHOWN, Event.BLOCKED, Event.BLOCKED_AT_ZERO):
        assert WAYS.get((landed, event), landed) in AT_REST
    if mode in AT_REST:
        away = {event for (at, event), after in WAYS.items() if at is mode and after not in AT_REST}
        assert away <= {Event.ARM, Event.ADOPT}


def in_mode(mode: Mode) -> Bench:
    if mode is Mode.ADOPT:
        held = simulated_bus.bench()
        held.drives[0].hold(300)
        held.run_until(Mode.ADOPT)
        return held
    made = simulated_bus.bench(amplitude=800)
    made.settle()
    if mode is Mode.OFF:
        return made
    assert made.arm() == ()
    if mode is Mode.ARMED:
        return made
    made.play()
    while made.offsets[0] < 600:
        made.run_sync()
    if mode is Mode.HOLD:
        made.run_sync(nc=False)
        made.run_until(mode)
    elif mode is Mode.RAMPING:
        made.run_sync(late=True)
    elif mode is Mode.RAMP_DOWN:
        made.run_sync(GuardRequest("disarm"))
    elif mode is Mode.FROZEN:
        made.listener.set_controller_state("off")
        made.run_sync()
        made.listener.set_controller_state("active")
    return made


@pytest.mark.parametrize("end", ["daemon lost", "disarm", "stop"])
@pytest.mark.parametrize("mode", Mode)
def test_drives_reach_zero_from_every_state(mode: Mode, end: str) -> None:
    made = in_mode(mode)
    assert made.mode is mode
    if end == "daemon lost":
        made.main_alive = False
    else:
        made.run_sync(GuardRequest("disarm" if end == "disarm" else "stop"))
    from_here = max(abs(value) for value in made.held[-1])
    made.run(2 + simulated_bus.ramp_cycles(simulated_bus.LIMITS, from_here) + ZEROS)
    rested = made.held[-1]
    assert rested == (0, 0) or (mode is Mode.FROZEN and rested[0] >= 600)
    made.run_until(Mode.FROZEN if mode is Mode.FROZEN else Mode.OFF, ZEROS_UNCONFIRMED)
    sent = len(made.frames), len(made.heartbeats)
    made.run(50)
    assert (len(made.frames), len(made.heartbeats)) == sent
    assert made.held[-1] == rested
