"""Modes other than profile and cyclic position: velocity, torque, homing; windows and limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.sim.drive_rig import Abort, DriveRig, build_machine_config
from tests.tiers import sampled

INC_PER_MM = 3276.8
REV = 65536


def create_enabled_rig(mode: int, writes: dict[int, tuple[int, int]] | None = None, **sim_axis: Any) -> DriveRig:
    rig = DriveRig(build_machine_config(**sim_axis))
    for index, (value, size) in (writes or {}).items():
        rig.write_object(index, 0, value, size)
    rig.enable_drive(mode=mode)
    return rig


def run_syncs(rig: DriveRig, count: int, read: Callable[[], float] | None = None) -> list[float]:
    values = []
    for _ in range(count):
        rig.send_sync()
        if read is not None:
            values.append(read())
    return values


def measure_speed_mm_s(rig: DriveRig) -> float:
    return rig.drive.physics.speed_rad_s / (2 * math.pi) * 20.0


# -- velocity


def test_profile_velocity_ramps_and_reports_target_reached() -> None:
    rig = create_enabled_rig(3, {0x6083: (round(1000 * INC_PER_MM), 4), 0x6084: (round(500 * INC_PER_MM), 4)})
    assert rig.read_object(0x6061) == 3
    assert rig.status & 1 << 12  # it stands
    rig.write_object(0x60FF, 0, round(100 * INC_PER_MM), 4)
    speeds = run_syncs(rig, 300, lambda: measure_speed_mm_s(rig))
    assert speeds[50] == pytest.approx(50, abs=3)
    assert speeds[150] == pytest.approx(100, abs=0.5)
    assert max(speeds) < 104  # the speed loop overshoots
    assert rig.status & 1 << 10
    assert not rig.status & 1 << 12
    assert rig.read_object(0x606B) == pytest.approx(100 * INC_PER_MM, rel=1e-3)
    assert rig.read_object(0x60F4, signed=True) == 0
    rig.write_object(0x60FF, 0, -round(100 * INC_PER_MM), 4)
    down = run_syncs(rig, 400, lambda: measure_speed_mm_s(rig))
    assert down[100] == pytest.approx(50, abs=3)
    assert down[-1] == pytest.approx(-100, abs=0.5)


def test_profile_velocity_halts_on_ramp_and_resumes() -> None:
    rig = create_enabled_rig(3)
    rig.write_object(0x60FF, 0, round(200 * INC_PER_MM), 4)
    run_syncs(rig, 200)
    rig.write_object(0x6040, 0, 0x10F, 2)
    speeds = run_syncs(rig, 150, lambda: measure_speed_mm_s(rig))
    assert np.abs(np.diff(speeds)).max() < 6  # 4000 mm/s2 and no jump
    assert speeds[-1] == pytest.approx(0, abs=0.5)
    assert rig.status & 1 << 10
    rig.write_object(0x6040, 0, 0x0F, 2)
    assert run_syncs(rig, 200, lambda: measure_speed_mm_s(rig))[-1] == pytest.approx(200, abs=0.5)
    rig.write_object(0x6040, 0, 0x02, 2)
    run_syncs(rig, 200)
    assert rig.status & 0x6F == 0x40


def test_speeds_are_limited_by_607f_and_6080() -> None:
    rig = create_enabled_rig(3)
    rig.write_object(0x60FF, 0, round(400 * INC_PER_MM), 4)
    rig.write_object(0x607F, 0, round(150 * INC_PER_MM), 4)
    assert run_syncs(rig, 300, lambda: measure_speed_mm_s(rig))[-1] == pytest.approx(150, abs=0.5)
    rig.write_object(0x6080, 0, 300, 4)  # rpm: 100 mm/s
    assert run_syncs(rig, 300, lambda: measure_speed_mm_s(rig))[-1] == pytest.approx(100, abs=0.5)
    rig.write_object(0x6060, 0, 1, 1)
    rig.write_object(0x6081, 0, round(400 * INC_PER_MM), 4)
    run_syncs(rig, 100)
    rig.write_object(0x607A, 0, round(500 * INC_PER_MM), 4)
    rig.write_object(0x6040, 0, 0x3F, 2)
    demands = run_syncs(rig, 500, lambda: rig.read_object(0x6062, signed=True))
    assert max(np.diff(demands)) / INC_PER_MM * 1e3 == pytest.approx(100, abs=0.5)


def test_cyclic_velocity_follows_targets_with_setpoint_delay() -> None:
    rig = create_enabled_rig(9)
    assert rig.read_object(0x6061) == 9
    assert rig.status & 1 << 12
    demands = []
    for n in range(60):
        rig.write_object(0x60FF, 0, 4000 * n, 4)
        rig.send_sync()
        demands.append(rig.read_object(0x606B))
    assert demands[10:] == pytest.approx([4000 * (n - 2) for n in range(10, 60)], abs=2)
    rig.write_object(0x60B1, 0, 10000, 4)
    run_syncs(rig, 50)
    assert rig.drive.physics.speed_rad_s == pytest.approx((59 * 4000 + 10000) * 2 * math.pi / REV, rel=0.01)
    assert rig.read_object(0x60F4, signed=True) == 0


def test_switch_from_cyclic_velocity_to_position_causes_no_jump() -> None:
    rig = create_enabled_rig(9)
    rig.write_object(0x60FF, 0, 100 * REV // 100, 4)
    run_syncs(rig, 300)
    rig.write_object(0x60FF, 0, 0, 4)
    run_syncs(rig, 200)
    place = rig.read_object(0x6064)
    rig.write_object(0x607A, 0, place, 4)
    rig.write_object(0x6060, 0, 8, 1)
    run_syncs(rig, 50)
    assert rig.read_object(0x6064) == pytest.approx(place, abs=3)
    assert rig.read_object(0x6061) == 8


# -- torque


@pytest.mark.parametrize("mode", [4, 10])
def test_profile_torque_accelerates_axis_with_target_torque(mode: int) -> None:
    """20 % of 40 N.m against 5 N.m of dry friction and 0.05 N.m.s on 0.075 kg.m2: toward 60 rad/s with 1.5 s."""
    rig = create_enabled_rig(mode)
    rig.write_object(0x6071, 0, 200, 2)
    run_syncs(rig, 100)
    assert rig.drive.physics.current_a == pytest.approx(10.0, rel=0.01)
    assert rig.read_object(0x6077) == pytest.approx(200, abs=3) == rig.read_object(0x6074)
    before = rig.drive.physics.speed_rad_s
    run_syncs(rig, 500)
    assert rig.drive.physics.speed_rad_s - before == pytest.approx((60 - before) * (1 - math.exp(-0.5 / 1.5)), rel=0.01)
    assert rig.status & (1 << 10 if mode == 4 else 1 << 12)
    rig.write_object(0x6071, 0, 0, 2)
    run_syncs(rig, 1000)
    assert rig.drive.physics.speed_rad_s == pytest.approx(0.0, abs=1e-9)


def test_torque_follows_slope_and_respects_motor_speed_limit() -> None:
    rig = create_enabled_rig(4)
    rig.write_object(0x6087, 0, 1000, 4)  # 100 % in a second
    rig.write_object(0x6080, 0, 300, 4)
    rig.write_object(0x6071, 0, 500, 2)
    torques = run_syncs(rig, 400, lambda: rig.read_object(0x6074, signed=True))
    assert torques[100] == pytest.approx(100, abs=6)
    assert not rig.status & 1 << 10
    speeds = run_syncs(rig, 3000, lambda: measure_speed_mm_s(rig))
    assert 90 < speeds[-1] < 100.5
    assert rig.drive.physics.current_a < 10


def test_torque_and_current_limits_act() -> None:
    for index in (0x6072, 0x6073):
        rig = create_enabled_rig(8)
        rig.write_object(index, 0, 200, 2)  # 10 A
        rig.follow_targets(range(0, 3000, 100))
        assert rig.drive.physics.current_a == pytest.approx(10.0, rel=0.01)
        assert rig.status & 1 << 11
    assert DriveRig().read_object(0x6072) == 4000 == DriveRig().read_object(0x6073)


def test_closing_speed_loop_continues_from_present_torque() -> None:
    rig = create_enabled_rig(4)
    rig.write_object(0x6071, 0, 200, 2)
    run_syncs(rig, 500)
    rig.write_object(0x60FF, 0, round(rig.drive.physics.speed_rad_s * REV / 2 / math.pi), 4)
    rig.write_object(0x6060, 0, 3, 1)
    currents = run_syncs(rig, 20, lambda: rig.drive.physics.current_a)
    assert max(np.abs(np.diff(currents))) < 3


@pytest.mark.parametrize("mode", [1, 3, 4, 6, 8, 9, 10])
def test_every_supported_mode_ends_with_quick_stop(mode: int) -> None:
    rig = create_enabled_rig(mode)
    assert rig.read_object(0x6502) >> mode - 1 & 1
    assert rig.read_object(0x6061) == mode
    rig.write_object(0x6040, 0, 0x02, 2)
    run_syncs(rig, 10)
    assert rig.status & 0x6F == 0x40


def test_loops_of_real_plant_open_and_close() -> None:
    rig = create_enabled_rig(3, reality={"resonance_hz": 120.0, "position_encoder": "motor"})
    rig.write_object(0x60FF, 0, round(50 * INC_PER_MM), 4)
    assert run_syncs(rig, 300, lambda: measure_speed_mm_s(rig))[-1] == pytest.approx(50, abs=2)
    rig.write_object(0x6060, 0, 4, 1)
    rig.write_object(0x6071, 0, 0, 2)
    run_syncs(rig, 600)
    assert measure_speed_mm_s(rig) == pytest.approx(0, abs=0.1)
    rig.write_object(0x6072, 0, 100, 2)
    rig.write_object(0x6071, 0, 500, 2)
    run_syncs(rig, 100)
    assert rig.drive.physics.current_a == pytest.approx(5.0, rel=0.02)


# -- position window and halt


def test_target_reached_after_window_time() -> None:
    rig = create_enabled_rig(1)
    rig.write_object(0x6067, 0, 5, 4)
    rig.write_object(0x6068, 0, 50, 2)
    rig.write_object(0x607A, 0, round(5 * INC_PER_MM), 4)
    rig.write_object(0x6040, 0, 0x1F, 2)
    inside, reached = [], []
    for _ in range(600):
        rig.send_sync()
        inside.append(abs(rig.read_object(0x6064, signed=True) - round(5 * INC_PER_MM)) <= 5)
        reached.append(bool(rig.status & 1 << 10))
    first = max(n for n, was in enumerate(inside) if not was) + 1
    assert reached.index(True, 10) == pytest.approx(first + 50, abs=3)


def test_halt_option_selects_ramp() -> None:
    ways = {}
    for option in (1, 2):
        rig = create_enabled_rig(1, {0x605D: (option, 2), 0x6085: (round(8000 * INC_PER_MM), 4)})
        rig.write_object(0x607A, 0, round(300 * INC_PER_MM), 4)
        rig.write_object(0x6040, 0, 0x1F, 2)
        run_syncs(rig, 250)
        start = rig.drive.table_mm
        rig.write_object(0x6040, 0, 0x10F, 2)
        run_syncs(rig, 300)
        ways[option] = rig.drive.table_mm - start
    assert ways[1] == pytest.approx(2 * ways[2], rel=0.1)


# -- homing


def run_homing(rig: DriveRig, method: int, offset: int = 0, limit: int = 20000) -> None:
    rig.write_object(0x6098, 0, method, 1)
    rig.write_object(0x607C, 0, offset, 4)
    rig.write_object(0x6099, 1, round(100 * INC_PER_MM), 4)
    rig.write_object(0x6099, 2, round(5 * INC_PER_MM), 4)
    rig.write_object(0x6040, 0, 0x0F, 2)
    rig.send_sync()
    rig.write_object(0x6040, 0, 0x1F, 2)
    rig.send_sync()
    for _ in range(limit):
        rig.send_sync()
        if rig.status & (1 << 12 | 1 << 13) and rig.status & 1 << 10:
            return
    raise AssertionError(f"method {method} did not end")


SWITCHES: dict[str, Any] = {"limit_switches_mm": (-23.0, 64.0), "home_switch_mm": 33.0, "start_mm": 7.0}


@pytest.mark.parametrize(
    ("method", "home_mm"),
    sampled([
        (17, -23.0), (18, 64.0), (1, -20.0), (2, 60.0), (19, 33.0), (20, 33.0), (3, 20.0), (4, 40.0),
        (33, 0.0), (34, 20.0), (35, 7.0), (37, 7.0),
    ], every=2),
)  # fmt: skip
def test_homing_method_finds_its_position(method: int, home_mm: float) -> None:
    rig = create_enabled_rig(6, **SWITCHES)
    assert rig.status & 1 << 10
    assert not rig.status & 1 << 12
    raw = rig.drive.physics.table_rad
    run_homing(rig, method, offset=1000)
    assert rig.status & 1 << 12
    moved_mm = (rig.drive.physics.table_rad - raw) / 2 / math.pi * 20
    position = rig.read_object(0x6064, signed=True)
    assert (position - 1000) / INC_PER_MM == pytest.approx(7.0 + moved_mm - home_mm, abs=0.02)
    assert rig.drive.table_mm == pytest.approx(position / INC_PER_MM, abs=0.001)
    rig.write_object(0x6060, 0, 1, 1)
    rig.write_object(0x607A, 0, 0, 4)
    rig.write_object(0x6040, 0, 0x0F, 2)
    run_syncs(rig, 3)
    rig.write_object(0x6040, 0, 0x3F, 2)
    run_syncs(rig, 2000)
    assert rig.read_object(0x6064, signed=True) == pytest.approx(0, abs=2)


@pytest.mark.parametrize(("start_mm", "method"), [(-25.0, 17), (70.0, 18), (50.0, 19), (50.0, 20), (-25.0, 1)])
def test_homing_starts_on_active_switch(start_mm: float, method: int) -> None:
    rig = create_enabled_rig(6, **SWITCHES | {"start_mm": start_mm})
    raw = rig.drive.physics.table_rad
    run_homing(rig, method)
    moved_mm = (rig.drive.physics.table_rad - raw) / 2 / math.pi * 20
    expected = {17: -23.0, 18: 64.0, 19: 33.0, 20: 33.0, 1: -20.0}[method]
    assert start_mm + moved_mm - rig.read_object(0x6064, signed=True) / INC_PER_MM == pytest.approx(expected, abs=0.02)


def test_homing_without_switch_is_error() -> None:
    rig = create_enabled_rig(6)  # no switches
    run_homing(rig, 17)
    assert rig.status & 1 << 13
    assert not rig.status & 1 << 12
    rig = create_enabled_rig(6, limit_switches_mm=(-20.0, 60.0), home_switch_mm=90.0)
    run_homing(rig, 19)  # the limit switch comes first
    assert rig.status & 1 << 13
    run_homing(rig, 35)
    assert rig.status & 1 << 12
    for method in (7, 15, 36, -1):
        with pytest.raises(Abort) as abort:
            rig.write_object(0x6098, 0, method, 1)
        assert abort.value.code == 0x06090030


def test_halt_interrupts_homing() -> None:
    rig = create_enabled_rig(6, **SWITCHES)
    rig.write_object(0x6098, 0, 17, 1)
    rig.write_object(0x6040, 0, 0x1F, 2)
    run_syncs(rig, 50)
    assert not rig.status & (1 << 10 | 1 << 12)
    rig.write_object(0x6040, 0, 0x11F, 2)
    run_syncs(rig, 200)
    assert rig.status & 1 << 10
    assert not rig.status & 1 << 12
    assert rig.drive.physics.speed_rad_s == pytest.approx(0, abs=0.1)


def test_limit_switches_set_60fd_and_statusword_bit_11() -> None:
    rig = create_enabled_rig(8, **SWITCHES)
    rig.follow_targets(range(round(7 * INC_PER_MM), round(65 * INC_PER_MM), 500))
    run_syncs(rig, 50)
    assert rig.read_object(0x60FD) == 0b110
    assert rig.status & 1 << 11
