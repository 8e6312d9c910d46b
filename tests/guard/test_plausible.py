"""Position and speed that contradict each other: two samples in a row end a correction, feasible motion never does."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.arming.guard_settings import settings_of
from fdhil.guard.plausibility import observe
from fdhil.guard.protocol import Mode
from fdhil.guard.settings import Settings, from_json, to_json
from fdhil.guard.state import AxisInput, BusView, Inputs, State, initial
from tests.bench import bench_config
from tests.guard import machine
from tests.guard.machine import Bench

STEP = 44.0
COUNT = 1e-3


def judged() -> Settings:
    made = machine.settings("X")
    return replace(made, axes=(replace(made.axes[0], speed_count=COUNT, speed_step=STEP),))


def bench() -> Bench:
    made = machine.bench()
    axes = tuple(replace(axis, speed_count=COUNT, speed_step=STEP) for axis in made.settings.axes)
    made = Bench(replace(made.settings, axes=axes), made.path, made.demand, made.drives)
    made.settle()
    assert made.arm() == ()
    made.play()
    made.until(Mode.ACTIVE)
    made.run(150)
    return made


def mutate(made: Bench, position: int, speed: int) -> None:
    drive = made.drives[0]
    made.sync(drop=(0x181,))
    assert drive.followed is not None
    made.hear(0x181, struct.pack("<ii", drive.followed + position, speed))


def test_the_config_tells_what_a_motor_can_do(tmp_path: Path) -> None:
    """200 A make 160 N.m on 0.075 kg.m2: 22 increments per cycle squared; twice that is plausible."""
    made = settings_of(bench_config("X"), "can0", tmp_path, "")
    assert made.axes[0].speed_count == pytest.approx(1e-3)
    assert made.axes[0].speed_step == pytest.approx(2 * 200 * 0.8 / 0.075 * 65536 / (2 * math.pi) * 1e-6)
    assert from_json(to_json(made)) == made


def test_a_path_is_believed_to_its_end() -> None:
    made = bench()
    made.until(Mode.OFF)
    assert [alarm.code for alarm in made.alarms][-1] == "Finished"


@pytest.mark.parametrize(("position", "speed"), [(0, 900_000), (2_000, 500_000), (-2_000, 500_000), (0, -500_000)])
@pytest.mark.fault("A14")
def test_one_wrong_frame_is_passed_over_two_are_not(position: int, speed: int) -> None:
    made = bench()
    mutate(made, position, speed)
    made.run(3)
    assert made.mode is Mode.ACTIVE
    assert made.state.axes[0].implausible == 0
    mutate(made, position, speed)
    mutate(made, position, speed)
    made.sync()
    assert made.alarms[-1].code == "Implausible"
    made.until(Mode.OFF)


def test_a_speed_that_is_stuck_is_noticed() -> None:
    made = bench()
    for k in range(400):
        if made.mode is not Mode.ACTIVE:
            break
        made.sync(drop=(0x181,))
        drive = made.drives[0]
        assert drive.followed is not None
        made.hear(0x181, struct.pack("<ii", drive.followed + 200 * k, 500_000))
    assert any(alarm.code in ("Implausible", "FollowingError") for alarm in made.alarms)


def seen(position: int | None, speed: int | None) -> AxisInput:
    return AxisInput(target=0, position=position, speed=speed, statusword=0x1237, mode=8, nmt=5, feedback_age=1)


def observed(state: State, position: int | None, speed: int | None) -> State:
    return observe(state, Inputs(True, (seen(position, speed),), BusView()), judged())


@settings(max_examples=80, deadline=None)
@given(st.lists(st.tuples(st.integers(-22, 22), st.booleans()), min_size=3, max_size=120))
def test_whatever_the_motor_can_do_is_believed(course: list[tuple[int, bool]]) -> None:
    state, place, speed = initial(judged()), 0.0, 0.0
    for push, lost in course:
        place += speed + 0.5 * push
        speed += push
        state = observed(state, None if lost else round(place), None if lost else round(speed * 1000))
        assert state.axes[0].implausible == 0


def test_the_bounds_are_what_the_settings_say() -> None:
    limit = machine.LIMITS.offset
    start = observed(initial(judged()), 0, 0)
    for position, speed, good in (
        (22, 44_000, True),
        (22, 44_001, False),
        (44 + limit, 0, True),
        (45 + limit, 0, False),
        (-44 - limit, 0, True),
        (-45 - limit, 0, False),
    ):
        assert observed(start, position, speed).axes[0].implausible == (0 if good else 1), (position, speed)


def test_a_place_that_was_set_anew_is_believed_again() -> None:
    """Homing moves the zero: the longer ago the last sample, the larger the allowed distance."""
    state = observed(initial(judged()), 0, 0)
    for _ in range(400):
        state = observed(state, 1_000_000, 0)
    assert state.axes[0].implausible == 0


def test_it_is_not_judged_without_a_speed() -> None:
    made = machine.settings("X")
    state = initial(made)
    for position in (0, 10**6, -(10**6)):
        state = observe(state, Inputs(True, (seen(position, 0),), BusView()), made)
        assert state.axes[0].implausible == 0


def test_one_wrong_read_back_is_forgiven_two_in_a_row_are_not() -> None:
    state = initial(machine.settings("X"))
    axis = state.axes[0]._replace(sent=(40, 30, 20, 10, 0, 0))
    counts = []
    for shown in (30, 7, 30, 7, 7, 20, 10, 0):
        state = state._replace(axes=(axis._replace(echo_misses=state.axes[0].echo_misses),))
        given = AxisInput(target=0, read_back=shown)
        state = observe(state, Inputs(True, (given,), BusView()), machine.settings("X"))
        counts.append(state.axes[0].echo_misses)
    assert counts == [0, 1, 0, 1, 2, 0, 0, 1]
