"""Position and speed that contradict each other: two samples in a row end a correction, feasible motion never does."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import GuardSettings, decode_settings, encode_settings
from fdhil.guard.guard_state import AxisInput, BusView, GuardState, StepInputs, make_initial_state
from fdhil.guard.read_back_checks import observe_drives
from tests.bench import bench_config
from tests.guard import simulated_bus
from tests.guard.simulated_bus import Bench

STEP = 44.0
COUNT = 1e-3


def judged() -> GuardSettings:
    made = simulated_bus.settings("X")
    return replace(made, axes=(replace(made.axes[0], speed_count=COUNT, speed_step=STEP),))


def bench() -> Bench:
    made = simulated_bus.bench()
    axes = tuple(replace(axis, speed_count=COUNT, speed_step=STEP) for axis in made.settings.axes)
    made = Bench(replace(made.settings, axes=axes), made.path, made.demand, made.drives)
    made.settle()
    assert made.arm() == ()
    made.play()
    made.run_until(Mode.ACTIVE)
    made.run(150)
    return made


def mutate(made: Bench, position: int, speed: int) -> None:
    drive = made.drives[0]
    made.run_sync(drop=(0x181,))
    assert drive.followed is not None
    made.receive_frames(0x181, struct.pack("<ii", drive.followed + position, speed))


def test_speed_step_follows_from_the_config(tmp_path: Path) -> None:
    """200 A make 160 N.m on 0.075 kg.m2: 22 increments per cycle squared; twice that is plausible."""
    made = make_guard_settings(bench_config("X"), "can0", tmp_path, "")
    assert made.axes[0].speed_count == pytest.approx(1e-3)
    assert made.axes[0].speed_step == pytest.approx(2 * 200 * 0.8 / 0.075 * 65536 / (2 * math.pi) * 1e-6)
    assert decode_settings(encode_settings(made)) == made


def test_valid_path_stays_plausible() -> None:
    made = bench()
    made.run_until(Mode.OFF)
    assert [alarm.code for alarm in made.alarms][-1] == "Finished"


@pytest.mark.parametrize(("position", "speed"), [(0, 900_000), (2_000, 500_000), (-2_000, 500_000), (0, -500_000)])
@pytest.mark.fault("A14")
def test_one_implausible_frame_is_tolerated_and_two_are_not(position: int, speed: int) -> None:
    made = bench()
    mutate(made, position, speed)
    made.run(3)
    assert made.mode is Mode.ACTIVE
    assert made.state.axes[0].implausible == 0
    mutate(made, position, speed)
    mutate(made, position, speed)
    made.run_sync()
    assert made.alarms[-1].code == "Implausible"
    made.run_until(Mode.OFF)


def test_stuck_speed_is_detected() -> None:
    made = bench()
    for k in range(400):
        if made.mode is not Mode.ACTIVE:
            break
        made.run_sync(drop=(0x181,))
        drive = made.drives[0]
        assert drive.followed is not None
        made.receive_frames(0x181, struct.pack("<ii", drive.followed + 200 * k, 500_000))
    assert any(alarm.code in ("Implausible", "FollowingError") for alarm in made.alarms)


def seen(position: int | None, speed: int | None) -> AxisInput:
    return AxisInput(target=0, position=position, speed=speed, statusword=0x1237, mode=8, nmt=5, feedback_age=1)


def observed(state: GuardState, position: int | None, speed: int | None) -> GuardState:
    return observe_drives(state, StepInputs(True, (seen(position, speed),), BusView()), judged())


@settings(max_examples=80, deadline=None)
@given(st.lists(st.tuples(st.integers(-22, 22), st.booleans()), min_size=3, max_size=120))
def test_any_feasible_motion_is_plausible(course: list[tuple[int, bool]]) -> None:
    state, place, speed = make_initial_state(judged()), 0.0, 0.0
    for push, lost in course:
        place += speed + 0.5 * push
        speed += push
        state = observed(state, None if lost else round(place), None if lost else round(speed * 1000))
        assert state.axes[0].implausible == 0


def test_plausibility_bounds_follow_the_settings() -> None:
    limit = simulated_bus.LIMITS.offset
    start = observed(make_initial_state(judged()), 0, 0)
    for position, speed, good in (
        (22, 44_000, True),
        (22, 44_001, False),
        (44 + limit, 0, True),
        (45 + limit, 0, False),
        (-44 - limit, 0, True),
        (-45 - limit, 0, False),
    ):
        assert observed(start, position, speed).axes[0].implausible == (0 if good else 1), (position, speed)


def test_new_reference_position_becomes_plausible_again() -> None:
    """Homing moves the zero: the longer ago the last sample, the larger the allowed distance."""
    state = observed(make_initial_state(judged()), 0, 0)
    for _ in range(400):
        state = observed(state, 1_000_000, 0)
    assert state.axes[0].implausible == 0


def test_motion_is_not_checked_without_a_speed() -> None:
    made = simulated_bus.settings("X")
    state = make_initial_state(made)
    for position in (0, 10**6, -(10**6)):
        state = observe_drives(state, StepInputs(True, (seen(position, 0),), BusView()), made)
        assert state.axes[0].implausible == 0


def test_one_wrong_read_back_is_tolerated_and_two_in_a_row_are_not() -> None:
    state = make_initial_state(simulated_bus.settings("X"))
    axis = state.axes[0]._replace(sent=(40, 30, 20, 10, 0, 0))
    counts = []
    for shown in (30, 7, 30, 7, 7, 20, 10, 0):
        state = state._replace(axes=(axis._replace(echo_misses=state.axes[0].echo_misses),))
        given = AxisInput(target=0, read_back=shown)
        state = observe_drives(state, StepInputs(True, (given,), BusView()), simulated_bus.settings("X"))
        counts.append(state.axes[0].echo_misses)
    assert counts == [0, 1, 0, 1, 2, 0, 0, 1]
