"""A jog and a rapid that fit into the room, and a room that is too small."""

from __future__ import annotations

import pytest

from fdhil.commissioning.stroke_planning import TravelRoom, plan_jog, plan_rapid, require_single_drive
from fdhil.config import Axis, parse_config
from fdhil.errors import DriveFault
from tests.bench import rotary_and_gantry_document
from tests.drivers import frame_builder


@pytest.fixture
def axis() -> Axis:
    """500 mm/s with 4000 mm/s2."""
    return frame_builder.build_machine_config().axis["X"]


def test_jog_is_short_slow_and_toward_side_with_room(axis: Axis) -> None:
    jog = plan_jog("X", axis, TravelRoom(-3.0, 40.0))
    assert str(jog) == "5 mm toward plus at 5 mm/s"
    assert str(jog.reverse_direction()) == "5 mm toward minus at 5 mm/s"
    assert plan_jog("X", axis, TravelRoom(-3.0, 1.0)).distance_mm == pytest.approx(-2.94)
    slow = axis.model_copy(update={"rapid_speed_mm_s": 20.0, "max_acceleration_mm_s2": 100.0})
    assert (
        plan_jog("X", slow, TravelRoom(0.0, 40.0)).speed_mm_s,
        plan_jog("X", slow, TravelRoom(0.0, 40.0)).acceleration_mm_s2,
    ) == (2, 10)


def test_too_little_room_for_jog_is_refused(axis: Axis) -> None:
    with pytest.raises(DriveFault, match=r"the room is -0.3 to \+0.2 mm, but the jog needs 0.5 mm .* --room"):
        plan_jog("X", axis, TravelRoom(-0.3, 0.2))


def test_rapid_is_as_fast_as_g0_with_enough_room(axis: Axis) -> None:
    rapid = plan_rapid("X", axis, TravelRoom(-500.0, 20.0))
    assert rapid.speed_mm_s == 500.0
    assert rapid.distance_mm == pytest.approx(-500.0 * (500.0 / 4000.0 + 0.025 + 0.2))


def test_rapid_in_small_room_is_slower_and_keeps_plateau(axis: Axis) -> None:
    rapid = plan_rapid("X", axis, TravelRoom(0.0, 120.0))
    assert rapid.distance_mm == pytest.approx(0.98 * 120.0)
    assert rapid.distance_mm == pytest.approx(rapid.speed_mm_s * (rapid.speed_mm_s / 4000.0 + 0.225))
    assert 325.0 <= rapid.speed_mm_s < 500.0


def test_too_slow_rapid_is_refused_with_needed_room(axis: Axis) -> None:
    with pytest.raises(DriveFault, match=r"the room is -50 to \+90 mm, but test rapids need 102 mm to one side"):
        plan_rapid("X", axis, TravelRoom(-50.0, 90.0))
    assert plan_rapid("X", axis, TravelRoom(-50.0, 102.0)).speed_mm_s >= 325.0


def test_strokes_of_rotary_axis_are_in_degrees() -> None:
    axis = parse_config(rotary_and_gantry_document()).axis["A"]
    rapid = plan_rapid("A", axis, TravelRoom(-10.0, 300.0))
    assert rapid.speed_mm_s == pytest.approx(280.0 * axis.mm_per_unit)
    assert str(rapid).endswith("deg toward plus at 280 deg/s")
    assert str(plan_jog("A", axis, TravelRoom(0.0, 90.0))) == "2.86479 deg toward plus at 2.86 deg/s"
    with pytest.raises(DriveFault, match=r"the room is \+0 to \+0\.1 deg, but the jog needs 0\.286 deg to one side"):
        plan_jog("A", axis, TravelRoom(0.0, 0.1))


@pytest.mark.parametrize("axis", ["Y", "Y2"])
def test_single_gantry_drive_is_not_moved(axis: str) -> None:
    machine = parse_config(rotary_and_gantry_document())
    with pytest.raises(DriveFault, match=f"drive {axis}: Y and Y2 move one beam, which one alone would skew"):
        require_single_drive(machine, axis)
    require_single_drive(machine, "X")
