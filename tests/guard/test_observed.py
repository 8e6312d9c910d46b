"""Read-back checks of one SYNC: which target and which offset belong to each sample."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import pytest

from fdhil.guard.conditions import known
from fdhil.guard.plausibility import observe
from fdhil.guard.protocol import ON_PATH, SENDING, Mode
from fdhil.guard.settings import Settings
from fdhil.guard.state import AxisInput, BusView, Inputs, State, initial
from tests.guard import machine

TARGETS = ((1,), (20,), (300,), (4000,), (50_000,))
SENT = (7, 60, 500, 4000, 30_000, 200_000)


def made(delay: int = 2, **changes: Any) -> Settings:
    own = replace(machine.axis_settings("X", 1), setpoint_delay_cycles=delay)
    return replace(machine.settings("X"), axes=(own,), **changes)


def begin(**changes: Any) -> State:
    state = initial(made())
    return state._replace(axes=(state.axes[0]._replace(**changes),))


def after(
    state: State, settings: Settings | None = None, *, sync: bool = True, left: bool = True, **seen: Any
) -> State:
    given = AxisInput(**{"target": 9, "read_back_age": 0.0, **seen})
    return observe(state, Inputs(sync, (given,), BusView(), unsent=() if left else (0,)), settings or made())


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
@pytest.mark.parametrize("shown", [None, 60])
def test_the_following_error_is_from_the_target_and_the_offset_that_were_followed(
    delay: int, shown: int | None
) -> None:
    state = begin(sent=SENT)._replace(targets=TARGETS[: delay + 1])
    seen = after(state, made(delay), position=1_000_000, read_back=shown)
    assert seen.axes[0].following_error == TARGETS[delay][0] + SENT[1 + delay] - 1_000_000
    short = after(state._replace(targets=TARGETS[:delay]), made(delay), position=1_000_000)
    assert short.axes[0].following_error != short.axes[0].following_error  # NaN: not known yet


def test_no_more_targets_are_kept_than_the_slowest_drive_needs() -> None:
    axes = tuple([replace(machine.axis_settings("X", 1), setpoint_delay_cycles=delay) for delay in (3, 1)])
    settings = replace(machine.settings(), axes=axes)
    state = initial(settings)
    for _ in range(20):
        state = observe(state, Inputs(True, (AxisInput(target=1), AxisInput(target=2)), BusView()), settings)
    assert state.targets == ((1, 2),) * 5


@pytest.mark.parametrize(
    ("targets", "demand", "off"),
    [
        (((100,), (120,)), 100, 0),
        (((100,), (120,)), 110, 0),
        (((100,), (120,)), 120, 0),
        (((100,), (120,)), 125, 5),
        (((100,), (120,)), 94, 6),
        (((100,), None, (120,)), 125, 5),
        (((100,), (120,)), None, 0),
        ((None, None), 100, inf),
        ((), 100, inf),
    ],
)
def test_the_demand_less_the_offset_is_one_of_the_last_targets_but_the_newest(
    targets: tuple[tuple[int] | None, ...], demand: int | None, off: float
) -> None:
    state = begin()._replace(targets=targets)
    shown = after(state, target=10_000, read_back=40, demand=None if demand is None else demand + 40)
    assert shown.axes[0].off_demand == off


@pytest.mark.parametrize(
    ("age", "first_known"),
    [(0.0, 1), (1.0, 1), (1.1, 3), (2.0, 3)],
)
def test_after_a_gap_three_readings_are_needed_again(age: float, first_known: int) -> None:
    state = begin(following_error=0)  # nothing else changes
    for _ in range(5):
        state = after(state, read_back=40)
    assert known(state.axes[0]) == 40
    state = after(state, read_back_age=age)
    counts = []
    for _ in range(4):
        state = after(state, read_back=40)
        counts.append(known(state.axes[0]))
    assert counts.index(40) + 1 == first_known
    assert known(after(state, read_back_crowded=True).axes[0]) is None
    counts = []
    for _ in range(3):
        state = after(state, read_back=41)
        counts.append(known(state.axes[0]))
    assert counts == [None, None, 41]


@pytest.mark.parametrize(
    ("sent", "read_back", "shown"),
    [((0, 0, 9, 9), 0, True), ((0, 9, 0, 0), 0, False), ((9, 0, 0, 0), 0, False), ((0, 0, 0, 0), 5, False)],
)
def test_a_zero_is_shown_by_a_drive_that_reads_back_the_zero_it_was_sent(
    sent: tuple[int, ...], read_back: int, shown: bool
) -> None:
    sent = (*sent, 0, 0)
    assert after(begin(sent=sent), read_back=read_back).axes[0].zero_shown is shown
    assert after(begin(sent=sent, zero_shown=True), read_back=read_back).axes[0].zero_shown is True


def test_what_is_read_back_is_what_was_in_force_or_a_cycle_or_two_late_or_wrong() -> None:
    for shown, late, misses in ((7, 0, 3), (60, 0, 0), (500, 5, 0), (4000, 5, 0), (30_000, 0, 3), (8, 0, 3)):
        axis = after(begin(sent=SENT, late_echoes=4, echo_misses=2), read_back=shown).axes[0]
        assert (axis.read_back, axis.late_echoes, axis.echo_misses) == (shown, late or 4, misses), shown


@pytest.mark.parametrize(("synchronous", "ticks"), [(True, 0), (False, 1)])
def test_between_two_syncs_it_counts_what_did_not_leave_and_who_touched_a_drive(synchronous: bool, ticks: int) -> None:
    settings, state = made(offset_synchronous=synchronous), begin(sent=SENT, offset=7, rate=-53)
    state = after(state._replace(failed_run=1, tick=5), settings, sync=False, left=False, touched=1, read_back=0)
    axis = state.axes[0]
    assert (axis.offset, axis.rate, axis.sent) == (60, 0, (60, *SENT[1:]))
    assert (axis.touched, axis.record_void) == (1, True)
    assert (state.failed_run, state.tick, state.targets, axis.read_back) == (2, 5 + ticks, (), None)
    assert after(state, settings, sync=False, touched=1).failed_run == 0


@pytest.mark.parametrize(("position", "speed"), [(5, None), (None, 5)])
def test_a_position_or_a_speed_alone_is_not_judged(position: int | None, speed: int | None) -> None:
    settings = made()
    settings = replace(settings, axes=(replace(settings.axes[0], speed_step=1.0, speed_count=1.0),))
    before = begin(believed=(10**6, 0, 0), implausible=1)
    axis = after(before, settings, position=position, speed=speed).axes[0]
    assert (axis.believed, axis.implausible) == ((10**6, 0, 0), 1)


@pytest.mark.parametrize(
    ("sent", "misses"),
    [
        ([(1, 2)], 0),  # nothing of ours can be in force yet
        ([(5, 6), (1, 2)], 1),
        ([(1, 2), (5, 6)], 0),
        ([(1, 2), (3, 4), (5, 6)], 0),
    ],
)
def test_speed_and_torque_that_are_shown_are_those_of_a_cycle_or_more_before(
    sent: list[tuple[int, int]], misses: int
) -> None:
    state = begin()
    state = state._replace(feed=state.feed._replace(sent=tuple([(pair,) for pair in sent])))
    for shown in ((5, 6), (5, None), (None, 6)):
        axis = after(state, fed_back=shown).axes[0]
        assert (axis.fed_back, axis.feed_misses) == (shown, misses)
    assert after(state, fed_back=(6, 5)).axes[0].feed_misses == (1 if len(sent) > 1 else 0)


def test_what_is_not_shown_says_nothing() -> None:
    state = begin(fed_back=(5, 6), feed_misses=1)
    state = state._replace(feed=state.feed._replace(sent=(((1, 2),),) * 3))
    assert (after(state).axes[0].fed_back, after(state).axes[0].feed_misses) == ((5, 6), 1)


@pytest.mark.parametrize("mode", Mode)
def test_a_late_step_is_counted_while_it_sends_and_against_the_loop_where_time_runs_on(mode: Mode) -> None:
    """A simulated machine runs ahead until it is on the path: only there a late step counts."""
    for clock, counts in (("monotonic", True), ("sync", mode in ON_PATH)):
        settings = made(clock=clock)
        state = begin()._replace(mode=mode, missed=5, missed_run=2)
        late = observe(state, Inputs(True, (AxisInput(target=9),), BusView(), late=True), settings)
        assert (late.missed, late.missed_run) == (6 if mode in SENDING else 5, 3 if counts else 0)
        assert (after(state, settings).missed, after(state, settings).missed_run) == (5, 0)
