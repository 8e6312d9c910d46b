"""Read-back checks of one SYNC: which target and which offset belong to each sample."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import pytest

from fdhil.guard.guard_protocol import ON_PATH, SENDING, Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import AxisInput, BusView, GuardState, StepInputs, make_initial_state
from fdhil.guard.interlock_checks import get_confirmed_read_back
from fdhil.guard.read_back_checks import observe_drives
from tests.guard import simulated_bus

TARGETS = ((1,), (20,), (300,), (4000,), (50_000,))
SENT = (7, 60, 500, 4000, 30_000, 200_000)


def made(delay: int = 2, **changes: Any) -> GuardSettings:
    own = replace(simulated_bus.axis_settings("X", 1), setpoint_delay_cycles=delay)
    return replace(simulated_bus.settings("X"), axes=(own,), **changes)


def begin(**changes: Any) -> GuardState:
    state = make_initial_state(made())
    return state._replace(axes=(state.axes[0]._replace(**changes),))


def after(
    state: GuardState, settings: GuardSettings | None = None, *, sync: bool = True, left: bool = True, **seen: Any
) -> GuardState:
    given = AxisInput(**{"target": 9, "read_back_age": 0.0, **seen})
    return observe_drives(state, StepInputs(sync, (given,), BusView(), unsent=() if left else (0,)), settings or made())


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
@pytest.mark.parametrize("shown", [None, 60])
def test_following_error_uses_the_followed_target_and_offset(delay: int, shown: int | None) -> None:
    state = begin(sent=SENT)._replace(targets=TARGETS[: delay + 1])
    seen = after(state, made(delay), position=1_000_000, read_back=shown)
    assert seen.axes[0].following_error == TARGETS[delay][0] + SENT[1 + delay] - 1_000_000
    short = after(state._replace(targets=TARGETS[:delay]), made(delay), position=1_000_000)
    assert short.axes[0].following_error != short.axes[0].following_error  # NaN: not known yet


def test_targets_are_kept_for_the_slowest_drive_only() -> None:
    axes = tuple([replace(simulated_bus.axis_settings("X", 1), setpoint_delay_cycles=delay) for delay in (3, 1)])
    settings = replace(simulated_bus.settings(), axes=axes)
    state = make_initial_state(settings)
    for _ in range(20):
        state = observe_drives(state, StepInputs(True, (AxisInput(target=1), AxisInput(target=2)), BusView()), settings)
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
def test_demand_minus_offset_matches_a_recent_target(
    targets: tuple[tuple[int] | None, ...], demand: int | None, off: float
) -> None:
    state = begin()._replace(targets=targets)
    shown = after(state, target=10_000, read_back=40, demand=None if demand is None else demand + 40)
    assert shown.axes[0].off_demand == off


@pytest.mark.parametrize(
    ("age", "first_known"),
    [(0.0, 1), (1.0, 1), (1.1, 3), (2.0, 3)],
)
def test_three_readings_are_needed_again_after_a_gap(age: float, first_known: int) -> None:
    state = begin(following_error=0)  # nothing else changes
    for _ in range(5):
        state = after(state, read_back=40)
    assert get_confirmed_read_back(state.axes[0]) == 40
    state = after(state, read_back_age=age)
    counts = []
    for _ in range(4):
        state = after(state, read_back=40)
        counts.append(get_confirmed_read_back(state.axes[0]))
    assert counts.index(40) + 1 == first_known
    assert get_confirmed_read_back(after(state, read_back_crowded=True).axes[0]) is None
    counts = []
    for _ in range(3):
        state = after(state, read_back=41)
        counts.append(get_confirmed_read_back(state.axes[0]))
    assert counts == [None, None, 41]


@pytest.mark.parametrize(
    ("sent", "read_back", "shown"),
    [((0, 0, 9, 9), 0, True), ((0, 9, 0, 0), 0, False), ((9, 0, 0, 0), 0, False), ((0, 0, 0, 0), 5, False)],
)
def test_zero_is_confirmed_by_reading_back_a_sent_zero(sent: tuple[int, ...], read_back: int, shown: bool) -> None:
    sent = (*sent, 0, 0)
    assert after(begin(sent=sent), read_back=read_back).axes[0].zero_shown is shown
    assert after(begin(sent=sent, zero_shown=True), read_back=read_back).axes[0].zero_shown is True


def test_read_back_is_current_late_or_wrong() -> None:
    for shown, late, misses in ((7, 0, 3), (60, 0, 0), (500, 5, 0), (4000, 5, 0), (30_000, 0, 3), (8, 0, 3)):
        axis = after(begin(sent=SENT, late_echoes=4, echo_misses=2), read_back=shown).axes[0]
        assert (axis.read_back, axis.late_echoes, axis.echo_misses) == (shown, late or 4, misses), shown


@pytest.mark.parametrize(("synchronous", "ticks"), [(True, 0), (False, 1)])
def test_unsent_frames_and_drive_writes_count_between_syncs(synchronous: bool, ticks: int) -> None:
    settings, state = made(offset_synchronous=synchronous), begin(sent=SENT, offset=7, rate=-53)
    state = after(state._replace(failed_run=1, tick=5), settings, sync=False, left=False, touched=1, read_back=0)
    axis = state.axes[0]
    assert (axis.offset, axis.rate, axis.sent) == (60, 0, (60, *SENT[1:]))
    assert (axis.touched, axis.record_void) == (1, True)
    assert (state.failed_run, state.tick, state.targets, axis.read_back) == (2, 5 + ticks, (), None)
    assert after(state, settings, sync=False, touched=1).failed_run == 0


@pytest.mark.parametrize(("position", "speed"), [(5, None), (None, 5)])
def test_position_or_speed_alone_is_not_checked(position: int | None, speed: int | None) -> None:
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
def test_shown_speed_and_torque_may_be_older_than_one_cycle(sent: list[tuple[int, int]], misses: int) -> None:
    state = begin()
    state = state._replace(feed=state.feed._replace(sent=tuple([(pair,) for pair in sent])))
    for shown in ((5, 6), (5, None), (None, 6)):
        axis = after(state, fed_back=shown).axes[0]
        assert (axis.fed_back, axis.feed_misses) == (shown, misses)
    assert after(state, fed_back=(6, 5)).axes[0].feed_misses == (1 if len(sent) > 1 else 0)


def test_missing_read_back_changes_nothing() -> None:
    state = begin(fed_back=(5, 6), feed_misses=1)
    state = state._replace(feed=state.feed._replace(sent=(((1, 2),),) * 3))
    assert (after(state).axes[0].fed_back, after(state).axes[0].feed_misses) == ((5, 6), 1)


@pytest.mark.parametrize("mode", Mode)
def test_late_step_counts_as_overrun_only_in_real_time(mode: Mode) -> None:
    """A simulated machine runs ahead until it is on the path: only there a late step counts."""
    for clock, counts in (("monotonic", True), ("sync", mode in ON_PATH)):
        settings = made(clock=clock)
        state = begin()._replace(mode=mode, missed=5, missed_run=2)
        late = observe_drives(state, StepInputs(True, (AxisInput(target=9),), BusView(), late=True), settings)
        assert (late.missed, late.missed_run) == (6 if mode in SENDING else 5, 3 if counts else 0)
        assert (after(state, settings).missed, after(state, settings).missed_run) == (5, 0)
