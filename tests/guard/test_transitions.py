"""The table of transitions: forbidden contents, and no transition outside it."""

from __future__ import annotations

import pytest

from fdhil.guard.feedforward import Feed, armed
from fdhil.guard.protocol import AT_REST, CHARGED, IN_CHARGE, LANDING, ON_PATH, SENDING, FeedMode, Mode
from fdhil.guard.state import Request, initial
from fdhil.guard.transitions import FEED_SENT, FEED_TRANSITIONS, SENT, TRANSITIONS, ZEROS, ZEROS_UNCONFIRMED, Event
from tests.guard import machine
from tests.guard.machine import Bench

WAYS = {(mode, event): after for event, modes, after in TRANSITIONS for mode in modes}
FEED_WAYS = {(mode, event): after for event, modes, after in FEED_TRANSITIONS for mode in modes}
ASKED = {Event.ARM, Event.NOTHING_HELD}
"""What only a request leads to."""


def test_every_state_is_one_of_rest_charge_or_landing() -> None:
    assert set(SENT) == set(Mode)
    assert set(FEED_SENT) == set(FeedMode)
    assert set(Mode) == AT_REST | IN_CHARGE | LANDING
    assert not AT_REST & SENDING
    assert not IN_CHARGE & LANDING
    assert {*IN_CHARGE, "FEEDFORWARD"} == CHARGED


def test_no_event_leads_to_two_states() -> None:
    assert len(WAYS) == sum(len(modes) for _, modes, _ in TRANSITIONS)
    assert len(FEED_WAYS) == sum(len(modes) for _, modes, _ in FEED_TRANSITIONS)
    assert {event for _, event in WAYS} == set(Event)


def test_only_arming_leads_from_rest_into_charge_and_every_other_way_toward_off() -> None:
    for (mode, event), after in WAYS.items():
        if mode in AT_REST and after in IN_CHARGE:
            assert (mode, event, after) == (Mode.OFF, Event.ARM, Mode.ARMED)
        if mode in LANDING:
            assert after in (*AT_REST, Mode.RAMP_DOWN)
        if mode in ON_PATH:
            assert after is not Mode.ARMED
        if mode is Mode.FROZEN:
            assert event in (Event.ADOPT, Event.NOTHING_HELD)


@pytest.mark.parametrize("mode", sorted(SENDING))
def test_whatever_sends_can_be_frozen_and_ends_at_rest(mode: Mode) -> None:
    assert WAYS[mode, Event.BLOCKED] is Mode.FROZEN
    reached, ahead = set(), {mode}
    while ahead:
        reached |= ahead
        ahead = {a for (m, event), a in WAYS.items() if m in ahead and event not in ASKED} - reached
    assert reached >= AT_REST


@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("mode", Mode)
def test_a_way_that_is_not_in_the_table_is_an_error(mode: Mode, event: Event) -> None:
    state = initial(machine.settings())._replace(mode=mode)
    if (mode, event) in WAYS:
        assert state.after(event).mode is WAYS[mode, event]
    else:
        with pytest.raises(KeyError):
            state.after(event)


@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("mode", FeedMode)
def test_a_way_of_the_feed_forward_that_is_not_in_the_table_is_an_error(mode: FeedMode, event: Event) -> None:
    feed = Feed(mode)
    if (mode, event) in FEED_WAYS:
        assert feed.after(event, None).mode is FEED_WAYS[mode, event]
    else:
        with pytest.raises(KeyError):
            feed.after(event, None)


def test_the_feed_forward_begins_by_arming_and_zeroing_never_turns_on() -> None:
    assert armed(()).mode is FeedMode.ON
    assert [mode for (mode, _), after in FEED_WAYS.items() if after is FeedMode.ON] == [FeedMode.OFF]
    assert {after for (mode, _), after in FEED_WAYS.items() if mode is FeedMode.ZEROING} == {FeedMode.OFF}


@pytest.mark.parametrize("mode", Mode)
def test_from_every_state_two_events_lead_to_rest_and_none_but_the_operators_leads_away(mode: Mode) -> None:
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
        held = machine.bench()
        held.drives[0].hold(300)
        held.until(Mode.ADOPT)
        return held
    made = machine.bench(amplitude=800)
    made.settle()
    if mode is Mode.OFF:
        return made
    assert made.arm() == ()
    if mode is Mode.ARMED:
        return made
    made.play()
    while made.offsets[0] < 600:
        made.sync()
    if mode is Mode.HOLD:
        made.sync(nc=False)
        made.until(mode)
    elif mode is Mode.RAMPING:
        made.sync(late=True)
    elif mode is Mode.RAMP_DOWN:
        made.sync(Request("disarm"))
    elif mode is Mode.FROZEN:
        made.listener.error("off")
        made.sync()
        made.listener.error("active")
    return made


@pytest.mark.parametrize("end", ["daemon lost", "disarm", "stop"])
@pytest.mark.parametrize("mode", Mode)
def test_from_every_state_the_drives_come_to_zero_and_nothing_is_sent_any_more(mode: Mode, end: str) -> None:
    made = in_mode(mode)
    assert made.mode is mode
    if end == "daemon lost":
        made.main_alive = False
    else:
        made.sync(Request("disarm" if end == "disarm" else "stop"))
    from_here = max(abs(value) for value in made.held[-1])
    made.run(2 + machine.ramp_cycles(machine.LIMITS, from_here) + ZEROS)
    rested = made.held[-1]
    assert rested == (0, 0) or (mode is Mode.FROZEN and rested[0] >= 600)
    made.until(Mode.FROZEN if mode is Mode.FROZEN else Mode.OFF, ZEROS_UNCONFIRMED)
    sent = len(made.frames), len(made.heartbeats)
    made.run(50)
    assert (len(made.frames), len(made.heartbeats)) == sent
    assert made.held[-1] == rested
