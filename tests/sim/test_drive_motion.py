"""The drive follows its set-points: exact timing, modes, ramps, and the bench's path error."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from fdhil import config
from fdhil.records import Float
from fdhil.sim.drive.plant_physics import simulate_sync_cycle
from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.drive.setpoints import CycleSetpoint, CyclicSetpoints, MotionProfile
from tests.bench import bench_config, bench_document
from tests.sim.drive_rig import DriveRig, build_machine_config

INC_PER_MM = 3276.8


# -- timing


def test_setpoint_and_its_offset_act_two_cycles_late() -> None:
    rig = DriveRig()
    rig.enable_drive()
    targets, offsets = [10, 25, 45, 70, 100, 135], [1, 3, 6, 10, 15, 21]
    demands = []
    for target, offset in zip(targets, offsets, strict=True):
        rig.run_cycle(target, offset)
        demands.append(rig.read_object(0x6062, signed=True))
    assert demands == [0, 0, 11, 28, 51, 80]
    assert rig.drive.reference_mm == pytest.approx(70 / INC_PER_MM)
    assert rig.drive.offset_mm == pytest.approx(10 / INC_PER_MM)
    assert rig.read_object(0x60B0) == 21


def test_voltage_object_is_mean_of_ended_period() -> None:
    rig = DriveRig()
    rig.enable_drive()
    for target in range(0, 2000, 100):
        mean = rig.drive.physics.voltage_mean_v
        frames = dict(rig.run_cycle(target))
        shown = struct.unpack("<Hhh", frames[0x281])[2]
        assert shown == round(mean / 0.02)
        assert rig.drive.physics.voltage_mean_v == pytest.approx(rig.drive.physics.voltage_v.mean())


@pytest.mark.parametrize("delay", [0, 1, 2, 3, 5])
def test_setpoint_delay_is_configurable(delay: int) -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"setpoint_delay_cycles": delay}
    document["sim"] = {"noise": {"voltage_v": 0, "current_a": 0, "speed_rad_s": 0}}
    rig = DriveRig(config.parse_config(document))
    rig.enable_drive()
    demands = []
    for n in range(12):
        rig.run_cycle(1000 + n if n else 0)
        demands.append(rig.read_object(0x6062))
    assert demands[delay + 1 :] == [1000 + n for n in range(1, 12 - delay)]


def test_offset_feedforward_is_configurable() -> None:
    ramp = [CycleSetpoint(0, float(o), 0.0, 0.0) for o in (0, 2, 6, 12)]
    for in_feedforward, slopes in ((True, (4000.0, 6000.0)), (False, (0.0, 0.0))):
        cyclic = CyclicSetpoints(2, 1e-3, in_feedforward)
        for target in ramp:
            cyclic.push_setpoint(target)
        p0, p1, f0, f1, *_ = cyclic.compute_command()
        assert (p0, p1) == (2.0, 6.0)
        assert (f0, f1) == pytest.approx(slopes)


def test_speed_demand_shows_offset_feedforward() -> None:
    shown = {}
    for in_feedforward in (True, False):
        rig = DriveRig(build_machine_config(offset_in_feedforward=in_feedforward))
        rig.enable_drive()
        for offset in (*([0] * 5), *range(0, 60, 10)):
            rig.run_cycle(0, offset)
        shown[in_feedforward] = rig.read_object(0x606B, signed=True)
    # 10 increments per ms; the rest is the position loop
    assert shown[True] - shown[False] == pytest.approx(10_000, rel=0.3)


def test_speed_and_torque_offsets_act_with_the_set_point_s_delay() -> None:
    rig = DriveRig()
    rig.write_object(0x1402, 1, 0x401, 4)
    rig.enable_drive()
    rig.send_frame(0x401, struct.pack("<ih", 65536, 0))
    demands = []
    for _ in range(4):
        rig.run_cycle(0)
        demands.append(rig.read_object(0x606B, signed=True))
    assert demands[:2] == [0, 0]
    assert demands[2] == pytest.approx(65536, rel=0.15)  # latched with the first of them; the ramp up began before
    other = DriveRig()
    other.write_object(0x60B2, 0, 100, 2)  # 10 % of the rated torque: 5 A
    other.enable_drive()
    assert other.drive.physics.current_a == pytest.approx(5.0, rel=0.05)


def test_drive_with_negative_sign_follows_axis_direction() -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"sign": -1}
    document["sim"] = {"axis": {"X": {"start_mm": 5.0}}}
    rig = DriveRig(config.parse_config(document))
    assert rig.read_object(0x6064, signed=True) == round(-5 * INC_PER_MM)
    rig.enable_drive(round(-5 * INC_PER_MM))
    rig.follow_targets(range(round(-5 * INC_PER_MM), round(-7 * INC_PER_MM), -50))
    assert rig.drive.table_mm > 6.0
    assert rig.drive.physics.speed_rad_s < 0


def test_software_limits_clip_demand() -> None:
    rig = DriveRig()
    rig.write_object(0x607D, 2, 500, 4)
    rig.enable_drive()
    rig.follow_targets(range(0, 1000, 20))
    assert rig.read_object(0x6062) == 500
    assert rig.status & 1 << 11


# -- modes and stops


def test_csp_sets_following_bit() -> None:
    rig = DriveRig()
    rig.enable_drive()
    assert rig.status & 0x6F == 0x27
    assert rig.status & 1 << 12
    rig.run_cycle(0, word=0x10F)  # halt
    rig.run_cycle(0, word=0x10F)
    assert not rig.status & 1 << 12
    assert rig.status & 1 << 10


def test_quick_stop_decelerates_at_0x6085_and_disables_power() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.follow_targets(range(0, 60000, 600))  # 183 mm/s
    rig.write_object(0x6085, 0, round(2000 * INC_PER_MM), 4)
    start = rig.drive.table_mm
    demands = []
    for _ in range(200):
        rig.run_cycle(59400, word=0x02)
        demands.append(rig.read_object(0x6062))
        if rig.status & 0x4F == 0x40:
            break
    # v^2 / 2a: 8.4 mm, and the lag of one controlword and two cycles
    assert rig.drive.table_mm - start == pytest.approx(183**2 / 4000, abs=0.8)
    assert 80 < len(demands) < 110
    assert rig.drive.physics.speed_rad_s == pytest.approx(0.0, abs=0.5)


def test_quick_stop_with_code_6_holds_position_and_resumes() -> None:
    rig = DriveRig()
    rig.write_object(0x605A, 0, 6, 2)
    rig.enable_drive()
    rig.follow_targets(range(0, 3000, 100))
    for _ in range(100):
        rig.run_cycle(2900, word=0x02)
    assert rig.status & 0x6F == 0x07
    held = rig.read_object(0x6064)
    for _ in range(5):
        rig.run_cycle(held, word=0x0F)
    assert rig.status & 0x6F == 0x27


def test_disable_operation_decelerates_before_power_off() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.follow_targets(range(0, 6000, 100))
    rig.run_cycle(5900, word=0x07)
    assert rig.status & 0x6F == 0x27
    for _ in range(50):
        rig.run_cycle(5900, word=0x07)
    assert rig.status & 0x6F == 0x23
    assert rig.drive.physics.current_a == 0.0


def create_profile_rig() -> DriveRig:
    rig = DriveRig()
    rig.write_object(0x6081, 0, round(100 * INC_PER_MM), 4)
    rig.write_object(0x6083, 0, round(1000 * INC_PER_MM), 4)
    rig.write_object(0x6084, 0, round(500 * INC_PER_MM), 4)
    rig.enable_drive(mode=1)
    return rig


def run_to_target(rig: DriveRig, target_mm: float, word: int, cycles: int) -> list[int]:
    """Command a target, then run; return the demand of each cycle."""
    target = round(target_mm * INC_PER_MM)
    demands = []
    for n in range(cycles):
        rig.run_cycle(target, word=word if n < 3 else word & ~0x10)
        demands.append(rig.read_object(0x6062, signed=True))
    return demands


@pytest.mark.usefixtures("real_time")
def test_profile_position_runs_trapezoid_and_reports_target_reached() -> None:
    rig = create_profile_rig()
    assert rig.read_object(0x6061) == 1
    assert rig.status & 1 << 10
    rig.run_cycle(round(30 * INC_PER_MM), word=0x1F)
    assert rig.status & 1 << 12  # acknowledged
    assert not rig.status & 1 << 10
    demands = np.array(run_to_target(rig, 30, 0x0F, 700)) / INC_PER_MM
    speed, rate = np.diff(demands) * 1e3, np.diff(demands, 2) * 1e6
    assert speed.max() == pytest.approx(100.0, abs=0.5)
    assert rate.max() < 1700
    assert rate[20:80].mean() == pytest.approx(1000, rel=0.05)
    assert rate.min() > -1300
    assert rate[320:420].mean() == pytest.approx(-500, rel=0.05)
    # 5 mm up, 10 mm down, 15 mm between: 0.1 + 0.15 + 0.2 s
    assert np.flatnonzero(demands >= 30.0 - 1e-3)[0] == pytest.approx(450, abs=8)
    assert rig.status & 1 << 10
    assert not rig.status & 1 << 12
    assert rig.drive.table_mm == pytest.approx(30.0, abs=2e-3)


@pytest.mark.usefixtures("real_time")
def test_profile_position_relative_buffered_at_once_and_halted() -> None:
    rig = create_profile_rig()
    run_to_target(rig, 10, 0x1F, 600)
    run_to_target(rig, 5, 0x5F, 600)  # relative
    assert rig.drive.table_mm == pytest.approx(15.0, abs=2e-3)
    run_to_target(rig, 40, 0x1F, 60)
    run_to_target(rig, 45, 0x1F, 60)  # waits for its turn: the acknowledge stays
    assert rig.status & 1 << 12
    run_to_target(rig, 45, 0x0F, 900)
    assert rig.drive.table_mm == pytest.approx(45.0, abs=2e-3)
    run_to_target(rig, 100, 0x3F, 60)
    run_to_target(rig, 0, 0x3F, 400)  # turns round at once
    for _ in range(400):
        rig.run_cycle(0, word=0x10F)
    assert rig.status & 1 << 10
    assert rig.drive.physics.speed_rad_s == pytest.approx(0.0, abs=0.1)  # it hunts within an increment
    held = rig.drive.table_mm
    assert 0 < held < 45
    run_to_target(rig, 0, 0x0F, 900)
    assert rig.drive.table_mm == pytest.approx(0.0, abs=2e-3)


def test_modes_and_faults_do_not_recompile_kernels() -> None:
    rig = create_profile_rig()
    rig.drive.faults.load_torque_nm = 1
    rig.drive.faults.offset_scale = 2
    run_to_target(rig, 1, 0x1F, 5)
    for word in (0x10F, 0x02, 0x00):
        rig.run_cycle(0, word=word)
    rig.write_object(0x6060, 0, 8, 1)
    rig.run_cycle(0, 5, word=0x06)
    for _ in range(5):
        rig.run_cycle(0, 5)
    assert len(simulate_sync_cycle.signatures) == 1


def test_switch_to_csp_resumes_cyclic_setpoints() -> None:
    rig = create_profile_rig()
    run_to_target(rig, 5, 0x1F, 400)
    rig.write_object(0x6060, 0, 8, 1)
    rig.follow_targets(range(round(5 * INC_PER_MM), round(6 * INC_PER_MM), 50))
    assert rig.read_object(0x6061) == 8
    assert rig.drive.table_mm > 5.8
    rig.write_object(0x6060, 0, 1, 1)
    rig.run_cycle(0)
    before = rig.read_object(0x6062)
    for _ in range(300):
        rig.run_cycle(0)
    assert rig.read_object(0x6062) >= before  # no target yet: it runs out, it does not jump back


def test_drive_without_mode_holds_position() -> None:
    rig = DriveRig()
    rig.enable_drive(mode=0)
    rig.follow_targets(range(0, 1000, 100))
    assert rig.read_object(0x6062) == 0
    assert rig.status & 0x6F == 0x27


@pytest.mark.parametrize("target", [0.0, 3.0, 12345.0, -777.7])
def test_profile_always_ends_at_target(target: float) -> None:
    profile = MotionProfile(1e-3)
    profile.start_from(100.0, 5000.0)
    for _ in range(4000):
        profile.advance_cycle(target, 1e5, 1e6, 7e5)
    assert profile.is_at_rest
    assert profile.current == target


# -- the bench


def build_bench_path_mm(feed_mm_s: float, smoothing_s: tuple[float, ...]) -> Float:
    """Return the bench's path at constant feed, (n, 2), smoothed by the NC's moving averages, then 0.5 s of rest."""
    lengths = np.array([55.0, 100.0, 50 * np.pi, 50.0, 55.0])
    ends = np.concatenate([[0], np.cumsum(lengths)])
    s = np.minimum(np.arange(int(np.ceil(ends[-1] / feed_mm_s * 1e3)) + 1) * feed_mm_s * 1e-3, ends[-1])
    x = np.interp(s, ends, [0, 0, 100, 200, 250, 250])
    y = np.interp(s, ends, [0, 55, 55, 55, 55, 0])
    on_arc = (s > ends[2]) & (s < ends[3])
    angle = np.pi + (s[on_arc] - ends[2]) / 50
    x[on_arc], y[on_arc] = 150 + 50 * np.cos(angle), 55 + 50 * np.sin(angle)
    path = np.stack([x, y], axis=1)
    for tau in smoothing_s:
        n = round(tau * 1e3)
        padded = np.concatenate([np.repeat(path[:1], n - 1, 0), path, np.repeat(path[-1:], n - 1, 0)])
        path = np.stack([np.convolve(column, np.ones(n) / n, "valid") for column in padded.T], axis=1)
    return np.concatenate([path, np.repeat(path[-1:], 500, 0)])


def compute_contour_um(reference: Float, actual: Float, half_window: int = 60) -> Float:
    """Return the distance (n,) to the reference polyline within +-60 ms: points farther in time are not closer here."""
    error = np.zeros(len(reference))
    for k, point in enumerate(actual):
        near = reference[max(k - half_window, 0) : k + half_window + 1]
        start, step = near[:-1], np.diff(near, axis=0)
        length2 = (step**2).sum(axis=1)
        along = ((point - start) * step).sum(axis=1) / np.where(length2 > 0, length2, 1)
        foot = start + np.clip(along, 0, 1)[:, None] * step
        error[k] = np.sqrt(((foot - point) ** 2).sum(axis=1).min()) * 1e3
    return error


def drive_path(path_mm: Float) -> tuple[Float, Float]:
    """Move both axes by frames; return reference and true table position (n, 2), each at the same instants."""
    machine_config = bench_config("XY")
    rigs = [DriveRig(machine_config, axis) for axis in "XY"]
    increments = np.rint(path_mm * INC_PER_MM).astype(int)
    reference, actual = [], []
    for rig in rigs:
        rig.enable_drive()
    for row in [*increments, increments[-1], increments[-1]]:
        for rig, target in zip(rigs, row, strict=True):
            rig.run_cycle(int(target), 0)
        reference.append([rig.drive.reference_mm for rig in rigs])
        actual.append([rig.drive.table_mm for rig in rigs])
    return np.array(reference)[2:], np.array(actual)[2:]


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize(
    ("feed_m_min", "smoothing_s", "rms_um", "max_um"),
    [(10, (0.060, 0.030), 24.2, 99), (20, (0.060, 0.030), 64, 218), (20, (0.030, 0.015), 760, 2600)],
)
def test_bench_path_error_matches_reference(
    feed_m_min: float, smoothing_s: tuple[float, ...], rms_um: float, max_um: float
) -> None:
    path = build_bench_path_mm(feed_m_min * 1e3 / 60, smoothing_s)
    reference, actual = drive_path(path)
    np.testing.assert_allclose(reference, path, atol=0.5 / INC_PER_MM + 1e-9)
    error = compute_contour_um(reference, actual)
    assert np.sqrt((error**2).mean()) == pytest.approx(rms_um, rel=0.02)
    assert error.max() == pytest.approx(max_um, rel=0.01)


def test_temperature_or_drift_changes_path_of_one_axis_only() -> None:
    drives = [SimulatedDrive("X", build_machine_config(), np.random.default_rng(0)) for _ in range(2)]
    drives[1].set_parameters(Jt=0.085)
    ends = []
    for drive in drives:
        rig = DriveRig()
        rig.drive = drive
        drive.power_on()
        rig.enable_drive()
        ends.append(rig.follow_targets([n * n // 4 for n in range(120)]))
    assert 1e-3 < np.abs(ends[0] - ends[1]).max() < 0.2
