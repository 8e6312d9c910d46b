"""The drive's own clock: motion without SYNC, with a SYNC of any period, and with an intermittent one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fdhil import config
from fdhil.sim.drive.drive_oscillator import DriveOscillator
from fdhil.sim.fault_kinds import FaultEntry
from tests.bench import bench_document
from tests.sim.bench_simulator import SteppedSimulator, build_corner_rows, build_simulator_config
from tests.sim.drive_rig import Abort, DriveRig, build_machine_config, list_emergency_codes

INC_PER_MM = 3276.8
MS = 1e-3


def advance_time(rig: DriveRig, seconds: float, sync_s: float | None = None, step_s: float = 4 * MS) -> list[float]:
    """Advance time in steps, with a SYNC every ``sync_s``; return the table position at each step."""
    sent: list[tuple[int, bytes]] = []
    places = []
    start, now = getattr(rig, "now_s", 0.0), 0.0
    next_sync = 0.0
    while now < seconds - 1e-9:
        now += step_s
        while sync_s is not None and next_sync < now:
            sent += rig.send_sync()
            next_sync += sync_s
        sent += rig.drive.run_timers(start + now)
        places.append(rig.drive.table_mm)
    rig.now_s = start + now  # type: ignore[attr-defined]
    rig.sent = sent  # type: ignore[attr-defined]
    return places


def write_by_sdo(mode: int, **sim_axis: Any) -> DriveRig:
    """Return a drive enabled by SDO alone, without SYNC."""
    rig = DriveRig(build_machine_config(**sim_axis))
    advance_time(rig, 0.004)
    rig.send_nmt(0x01)
    rig.write_object(0x6060, 0, mode, 1)
    for word in (0x06, 0x07, 0x0F):
        rig.write_object(0x6040, 0, word, 2)
    assert rig.status & 0x6F == 0x27
    return rig


def start_profile(rig: DriveRig, target_mm: float, speed_mm_s: float = 100.0) -> None:
    rig.write_object(0x607A, 0, round(target_mm * INC_PER_MM), 4)
    rig.write_object(0x6081, 0, round(speed_mm_s * INC_PER_MM), 4)
    rig.write_object(0x6083, 0, round(1000 * INC_PER_MM), 4)
    rig.write_object(0x6084, 0, round(1000 * INC_PER_MM), 4)
    rig.write_object(0x6040, 0, 0x1F, 2)


@pytest.mark.parametrize("sync_s", [None, 0.5 * MS, 1 * MS, 1.05 * MS, 2 * MS, 7 * MS, 10 * MS, 100 * MS, 1.0])
def test_profile_duration_is_independent_of_sync_period(sync_s: float | None) -> None:
    """30 mm at 100 mm/s and 1000 mm/s2: 0.1 s up, 0.2 s, 0.1 s down; half of the distance after 0.2 s."""
    rig = write_by_sdo(1)
    if sync_s is not None:
        advance_time(rig, 0.3, sync_s)  # the SYNC runs already
    start_profile(rig, 30.0)
    places = np.array(advance_time(rig, 1.0, sync_s))
    assert places[49] == pytest.approx(15.0, abs=2.6)  # 0.2 s, to the 20 ms that a clock may be wrong by
    assert (places[120:] > 29.9).all()
    assert rig.drive.table_mm == pytest.approx(30.0, abs=0.01)
    assert rig.read_object(0x6041) & 1 << 10


def test_sync_at_drive_period_leads() -> None:
    """One cycle per SYNC, although the host updates the time only occasionally."""
    rig = write_by_sdo(1)
    advance_time(rig, 0.2, 1 * MS)
    start_profile(rig, 30.0)
    before = rig.drive.tick
    rng = np.random.default_rng(1)
    now = rig.now_s  # type: ignore[attr-defined]
    for n in range(400):
        rig.send_sync()
        if n % 4 == 0:
            rig.drive.run_timers(now + (n - rng.integers(2)) * MS)
    assert rig.drive.tick - before == 400


def test_cyclic_setpoints_follow_sync_of_slow_host() -> None:
    rig = write_by_sdo(8)
    advance_time(rig, 0.2, 1 * MS)
    rig.run_cycle(0)
    before = rig.drive.tick
    advance_time(rig, 0.6, 3 * MS, step_s=12 * MS)
    assert rig.drive.tick - before == 200


def test_setpoint_is_held_and_quick_stop_works_after_sync_ends() -> None:
    rig = write_by_sdo(8)
    for n in range(200):
        rig.run_cycle(100 * n)
        rig.drive.run_timers(0.1 + n * MS)
    rig.now_s = 0.3  # type: ignore[attr-defined]
    advance_time(rig, 2.0)
    assert rig.read_object(0x6064) == pytest.approx(19900, abs=20)
    rig.write_object(0x6040, 0, 0x02, 2)
    advance_time(rig, 1.0)
    assert rig.read_object(0x6041) & 0x6F == 0x40


def test_quick_stop_stops_profile_without_sync() -> None:
    rig = write_by_sdo(1)
    start_profile(rig, 300.0)
    advance_time(rig, 0.3)
    start = rig.drive.table_mm
    rig.write_object(0x6085, 0, round(500 * INC_PER_MM), 4)
    rig.write_object(0x6040, 0, 0x0B, 2)
    advance_time(rig, 0.1)
    assert rig.read_object(0x6041) & 0x6F == 0x07
    advance_time(rig, 0.2)
    assert rig.drive.table_mm - start == pytest.approx(100**2 / 1000, abs=0.3)
    assert rig.read_object(0x6041) & 0x6F == 0x40


def test_homing_completes_without_sync() -> None:
    rig = write_by_sdo(6, limit_switches_mm=(-20.0, 60.0))
    rig.write_object(0x6098, 0, 1, 1)
    rig.write_object(0x6040, 0, 0x1F, 2)
    advance_time(rig, 8.0)
    assert rig.read_object(0x6041) & (1 << 10 | 1 << 12 | 1 << 13) == 1 << 10 | 1 << 12
    assert rig.read_object(0x6064) == pytest.approx(0, abs=400)  # the first pulse beyond the switch
    assert rig.drive.physics.table_rad == pytest.approx(0, abs=0.05)


def test_jam_without_sync_sends_emergency() -> None:
    rig = write_by_sdo(1)
    rig.write_object(0x6065, 0, 1000, 4)
    start_profile(rig, 30.0)
    rig.drive.faults.load_torque_nm = 400.0
    advance_time(rig, 0.5)
    assert list_emergency_codes(rig.sent) == [0x8611]  # type: ignore[attr-defined]
    assert rig.read_object(0x6041) & 0x4F == 0x08


@pytest.mark.parametrize("mean_s", [0.9 * MS, 1 * MS, 1.1 * MS, 1.4 * MS, 3 * MS])
def test_irregular_sync_does_not_change_drive_speed(mean_s: float) -> None:
    clock, rng = DriveOscillator(MS), np.random.default_rng(3)
    next_sync = reported = 0.0
    cycles = 0
    while reported < 20.0:
        if next_sync <= reported:
            cycles += clock.accept_sync()
            next_sync += mean_s * rng.exponential()
        else:
            cycles += clock.count_due_cycles(reported, bound=False)
            reported += MS if clock.leads else 4 * MS
    assert cycles == pytest.approx(20_000, rel=0.015)


def test_unpowered_axis_at_standstill_runs_no_cycle() -> None:
    rig = DriveRig()
    advance_time(rig, 5.0)
    assert rig.drive.tick == 0
    rig.drive.overwrite_object(0x6040, 0, 0)


def test_sync_is_only_clock_with_own_nc() -> None:
    clock = DriveOscillator(MS)
    assert clock.count_due_cycles(1.0, bound=False) == 0
    assert clock.count_due_cycles(1.1, bound=False) > 0
    clock.follow_sync_only()
    assert all(clock.accept_sync() for _ in range(1000))


@pytest.mark.parametrize("late_s", [0.01, 0.3])
def test_sync_pause_is_bridged_or_lasts(late_s: float) -> None:
    """A short pause is bridged; in a long one the drive's own time continues."""
    clock = DriveOscillator(MS)
    now, cycles = 0.0, 0
    for _ in range(500):
        now += MS
        clock.count_due_cycles(now, bound=False)
        cycles += clock.accept_sync()
    assert cycles == 500
    own = 0
    for _ in range(round(late_s / MS)):
        now += MS
        own += clock.count_due_cycles(now, bound=False)
    assert own == (0 if late_s < 0.015 else pytest.approx(late_s / MS, abs=2))


def test_axes_reach_last_setpoint_while_sync_fails() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.play_rows(build_corner_rows() + 5.0)
    twin.run_until("playing")
    twin.run_cycles(100)
    drive = twin.machine.units["Y"].drive
    tick, target = drive.tick, drive.dictionary.get_number(0x607A) / INC_PER_MM
    assert abs(target - drive.table_mm) > 0.1
    twin.machine.faults.add_entry(FaultEntry(fault="sync_lost", at_sync=0, duration_s=0.2))
    twin.run_cycles(150)
    assert drive.tick == tick + 150
    assert drive.table_mm == pytest.approx(target, abs=1.0)
    assert abs(drive.physics.speed_rad_s) < 1.0


def test_setpoints_every_tenth_cycle_are_interpolated_linearly() -> None:
    """By 0x60C2; the speed demand has no steps, and the set-point acts one interval and the delay late."""
    rig = DriveRig()
    rig.write_object(0x60C2, 1, 10, 1)
    rig.write_object(0x1006, 0, 10_000, 4)
    rig.enable_drive()
    tick = rig.drive.tick
    demands, shown = [], []
    for n in range(60):
        rig.run_cycle(1000 * n)
        demands.append(rig.read_object(0x606B, signed=True))
        shown.append(rig.read_object(0x6062, signed=True))
    assert rig.drive.tick - tick == 600
    assert demands[20:] == pytest.approx([100_000] * 40, abs=60)
    assert shown[10:] == [1000 * n - 200 for n in range(10, 60)]  # in the last of the ten cycles, two late


@pytest.mark.parametrize("mode", [8, 9])
def test_configured_slow_sync_leads_drive(mode: int) -> None:
    rig = DriveRig()
    rig.write_object(0x60C2, 1, 10, 1)
    rig.enable_drive(mode=mode)
    advance_time(rig, 1.0, 10 * MS)
    before = rig.drive.tick
    rig.write_object(0x60FF, 0, 65536, 4)
    advance_time(rig, 1.0, 10.1 * MS)
    assert rig.drive.tick - before == 1000
    turned = rig.drive.physics.table_rad / (2 * np.pi)
    assert turned == pytest.approx(1.0 if mode == 9 else 0.0, abs=0.05)


def test_interpolation_time_is_multiple_of_drive_cycle() -> None:
    document = bench_document("X")
    document["machine"]["sync_period_s"] = 0.0005
    rig = DriveRig(config.parse_config(document))
    rig.write_object(0x60C2, 1, 20, 1)
    for value in (0, 7):
        with pytest.raises(Abort) as abort:
            rig.write_object(0x60C2, 1, value, 1)
        assert abort.value.code == 0x06090030
