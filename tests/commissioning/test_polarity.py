"""A jog of a simulated motor: a wrong sign or unit is named, whatever load acts on the axis."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fdhil.commissioning.polarity import assess_acceleration_power, assess_jog
from fdhil.commissioning.set_points import plan_straight_move
from fdhil.records import Recording, SlowVoltage, freeze_array
from tests.bench import bench_config

DT, PITCH, JOG = 0.001, 20.0, 5.0
AXIS = bench_config("X").axis["X"]
R, K, J, FRICTION = 0.5, 0.8, 0.075, 5.0


def record_jog(weight_nm: float = 0.0, top_mm_s: float = 5.0, way_mm: float = JOG) -> Recording:
    """Samples of a jog back and forth; ``weight_nm`` acts on the axis all the time."""
    part = plan_straight_move((0.0,), (way_mm,), (top_mm_s * DT,), (50.0 * top_mm_s / 5.0 * DT**2,), 20)[:, 0]
    rest = np.zeros(300)
    position = np.concatenate([rest, part, rest + way_mm, way_mm - part, rest])
    speed = np.gradient(position, DT) * 2 * math.pi / PITCH
    noise = np.random.default_rng(1).normal(size=(2, position.size))
    torque = J * np.gradient(speed, DT) + FRICTION * np.sign(np.round(speed, 6)) + weight_nm
    current = torque / K + 0.05 * noise[0]
    voltage = R * current + K * speed + 0.05 * noise[1]
    return Recording(
        "X", DT, freeze_array(np.arange(position.size) * DT), freeze_array(voltage), freeze_array(current),
        freeze_array(speed), freeze_array(position), freeze_array(position), "interval_mean", PITCH, None,
    )  # fmt: skip


def list_causes(jog: Recording) -> str:
    return "; ".join(finding.cause for finding in assess_jog(jog, JOG, AXIS) if finding.ok is False)


@pytest.mark.parametrize("weight_nm", [0.0, 20.0, -20.0])
def test_correct_axis_passes_with_and_without_weight(weight_nm: float) -> None:
    jog = record_jog(weight_nm)
    assert [f.point for f in assess_jog(jog, JOG, AXIS) if f.ok] == [
        "travel",
        "speed unit",
        "current sign",
        "voltage sign",
    ]
    lossy = replace(
        jog, current_a=freeze_array(np.where(np.arange(jog.current_a.size) % 50 == 3, np.nan, jog.current_a))
    )
    assert list_causes(lossy) == ""


WRONG: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "current": (lambda r: replace(r, current_a=-r.current_a), "SignOrScale: current times speed is negative"),
    "voltage": (
        lambda r: replace(r, voltage_v=freeze_array(-(r.voltage_v if r.voltage_v is not None else 0))),
        "SignOrScale: voltage times current, and times speed is negative",
    ),
    "speed": (
        lambda r: replace(r, speed_rad_s=-r.speed_rad_s),
        "its speed (0x606C) is -1 times the derivative of its position",
    ),
    "speed x 10": (lambda r: replace(r, speed_rad_s=r.speed_rad_s * 10), "its speed (0x606C) is 10 times"),
    "way": (
        lambda r: replace(r, position_mm=r.position_mm * 2),
        "it was commanded 5 mm, but its position (0x6064) moved 10.000",
    ),
    "no current": (lambda r: replace(r, current_a=r.current_a * 0), "cancel out"),
}


@pytest.mark.parametrize("what", WRONG)
@pytest.mark.fault("B10")
def test_wrong_unit_or_sign_is_named(what: str) -> None:
    spoil, says = WRONG[what]
    assert says in list_causes(spoil(record_jog()))


@pytest.mark.fault("B10")
def test_swapped_words_are_detected() -> None:
    """A float with swapped words is noise of any size."""
    jog = record_jog()
    noise = freeze_array(np.random.default_rng(2).normal(size=jog.speed_rad_s.size) * 1e3)
    assert "SignOrScale: voltage times current" in list_causes(replace(jog, voltage_v=noise))


def test_slower_voltage_sensor_is_assessed() -> None:
    jog = record_jog()
    assert jog.voltage_v is not None
    means = jog.voltage_v[: jog.voltage_v.size // 50 * 50].reshape(-1, 50).mean(axis=1)
    slow = replace(jog, voltage_v=None, slow_voltage=SlowVoltage(0.0, 0.05, 0.0, freeze_array(means)))
    assert list_causes(slow) == ""
    turned = replace(slow, slow_voltage=SlowVoltage(0.0, 0.05, 0.0, freeze_array(-means)))
    assert "voltage times current, and times speed is negative" in list_causes(turned)


def test_missing_voltage_is_not_assessed() -> None:
    (voltage,) = [f for f in assess_jog(replace(record_jog(), voltage_v=None), JOG, AXIS) if f.point == "voltage sign"]
    assert (voltage.ok, voltage.cause) == (None, "no voltage was recorded")


def test_motor_that_delivers_power_while_accelerating_is_refused() -> None:
    rapid = record_jog(top_mm_s=400.0, way_mm=150.0)
    assert assess_acceleration_power(rapid).ok is True
    assert rapid.voltage_v is not None
    wrong = assess_acceleration_power(replace(rapid, voltage_v=freeze_array(-rapid.voltage_v)))
    assert (wrong.ok, "J while it accelerated, which is impossible for a motor" in wrong.cause) == (False, True)


def test_table_moving_differently_is_detected() -> None:
    jog = record_jog()
    seen = replace(
        jog, table_mm=freeze_array(np.where(np.arange(jog.position_mm.size) % 3 == 0, jog.position_mm + 7.0, np.nan))
    )
    assert [f.point for f in assess_jog(seen, JOG, AXIS) if f.ok][2] == "table"
    turned = replace(jog, table_mm=-jog.position_mm)
    assert "its table moves -1 times the distance of its motor" in list_causes(turned)
    assert list_causes(replace(jog, table_mm=jog.position_mm * np.nan)) == ""
