"""The drive follows its set-points: exact timing, modes, ramps, and the bench's path error."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from fdhil import config
from fdhil.records import Float
from fdhil.sim.drive.physics import run_cycle
from fdhil.sim.drive.servo import Drive
from fdhil.sim.drive.setpoints import CyclicSetpoints, Profile, Target
from tests.bench import bench_config, bench_document
from tests.sim.rig import Rig, machine

INC_PER_MM = 3276.8


# -- timing


def test_the_set_point_acts_two_cycles_late_and_the_offset_belongs_to_it() -> None:
    rig = Rig()
    rig.enable()
    targets, offsets = [10, 25, 45, 70, 100, 135], [1, 3, 6, 10, 15, 21]
    demands = []
    for target, offset in zip(targets, offsets, strict=True):
        rig.cycle(target, offset)
        demands.append(rig.read(0x6062, signed=True))
    assert demands == [0, 0, 11, 28, 51, 80]
    assert rig.drive.reference_mm == pytest.approx(70 / INC_PER_MM)
    assert rig.drive.offset_mm == pytest.approx(10 / INC_PER_MM)
    assert rig.read(0x60B0) == 21


def test_the_voltage_is_the_mean_of_the_period_that_ended() -> None:
    rig = Rig()
    rig.enable()
    for target in range(0, 2000, 100):
        mean = rig.drive.physics.voltage_mean_v
        frames = dict(rig.cycle(target))
        shown = struct.unpack("<Hhh", frames[0x281])[2]
        assert shown == round(mean / 0.02)
        assert rig.drive.physics.voltage_mean_v == pytest.approx(rig.drive.physics.voltage_v.mean())


@pytest.mark.parametrize("delay", [0, 1, 2, 3, 5])
def test_other_delays(delay: int) -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"setpoint_delay_cycles": delay}
    document["sim"] = {"noise": {"voltage_v": 0, "current_a": 0, "speed_rad_s": 0}}
    rig = Rig(config.parse_config(document))
    rig.enable()
    demands = []
    for n in range(12):
        rig.cycle(1000 + n if n else 0)
        demands.append(rig.read(0x6062))
    assert demands[delay + 1 :] == [1000 + n for n in range(1, 12 - delay)]


def test_feed_forward_of_the_offset_is_a_choice() -> None:
    ramp = [Target(0, float(o), 0.0, 0.0) for o in (0, 2, 6, 12)]
    for in_feedforward, slopes in ((True, (4000.0, 6000.0)), (False, (0.0, 0.0))):
        cyclic = CyclicSetpoints(2, 1e-3, in_feedforward)
        for target in ramp:
            cyclic.push(target)
        p0, p1, f0, f1, *_ = cyclic.command()
        assert (p0, p1) == (2.0, 6.0)
        assert (f0, f1) == pytest.approx(slopes)


def test_commissioning_sees_the_choice_in_the_speed_demand() -> None:
    shown = {}
    for in_feedforward in (True, False):
        rig = Rig(machine(offset_in_feedforward=in_feedforward))
        rig.enable()
        for offset in (*([0] * 5), *range(0, 60, 10)):
            rig.cycle(0, offset)
        shown[in_feedforward] = rig.read(0x606B, signed=True)
    # 10 increments per ms; the rest is the position loop
    assert shown[True] - shown[False] == pytest.approx(10_000, rel=0.3)


def test_speed_and_torque_offsets_act_with_the_set_point_s_delay() -> None:
    rig = Rig()
    rig.write(0x1402, 1, 0x401, 4)
    rig.enable()
    rig.send(0x401, struct.pack("<ih", 65536, 0))
    demands = []
    for _ in range(4):
        rig.cycle(0)
        demands.append(rig.read(0x606B, signed=True))
    assert demands[:2] == [0, 0]
    assert demands[2] == pytest.approx(65536, rel=0.15)  # latched with the first of them; the ramp up began before
    other = Rig()
    other.write(0x60B2, 0, 100, 2)  # 10 % of the rated torque: 5 A
    other.enable()
    assert other.drive.physics.current_a == pytest.approx(5.0, rel=0.05)


def test_a_drive_that_counts_against_the_axis() -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"sign": -1}
    document["sim"] = {"axis": {"X": {"start_mm": 5.0}}}
    rig = Rig(config.parse_config(document))
    assert rig.read(0x6064, signed=True) == round(-5 * INC_PER_MM)
    rig.enable(round(-5 * INC_PER_MM))
    rig.follow(range(round(-5 * INC_PER_MM), round(-7 * INC_PER_MM), -50))
    assert rig.drive.table_mm > 6.0
    assert rig.drive.physics.speed_rad_s < 0


def test_software_limits_cut_the_demand() -> None:
    rig = Rig()
    rig.write(0x607D, 2, 500, 4)
    rig.enable()
    rig.follow(range(0, 1000, 20))
    assert rig.read(0x6062) == 500
    assert rig.status & 1 << 11


# -- modes and stops


def test_csp_says_that_it_follows() -> None:
    rig = Rig()
    rig.enable()
    assert rig.status & 0x6F == 0x27
    assert rig.status & 1 << 12
    rig.cycle(0, word=0x10F)  # halt
    rig.cycle(0, word=0x10F)
    assert not rig.status & 1 << 12
    assert rig.status & 1 << 10


def test_quick_stop_ramps_down_at_0x6085_and_then_takes_the_power_off() -> None:
    rig = Rig()
    rig.enable()
    rig.follow(range(0, 60000, 600))  # 183 mm/s
    rig.write(0x6085, 0, round(2000 * INC_PER_MM), 4)
    start = rig.drive.table_mm
    demands = []
    for _ in range(200):
        rig.cycle(59400, word=0x02)
        demands.append(rig.read(0x6062))
        if rig.status & 0x4F == 0x40:
            break
    # v^2 / 2a: 8.4 mm, and the lag of one controlword and two cycles
    assert rig.drive.table_mm - start == pytest.approx(183**2 / 4000, abs=0.8)
    assert 80 < len(demands) < 110
    assert rig.drive.physics.speed_rad_s == pytest.approx(0.0, abs=0.5)


def test_quick_stop_with_code_6_holds_and_comes_back() -> None:
    rig = Rig()
    rig.write(0x605A, 0, 6, 2)
    rig.enable()
    rig.follow(range(0, 3000, 100))
    for _ in range(100):
        rig.cycle(2900, word=0x02)
    assert rig.status & 0x6F == 0x07
    held = rig.read(0x6064)
    for _ in range(5):
        rig.cycle(held, word=0x0F)
    assert rig.status & 0x6F == 0x27


def test_disable_operation_slows_down_before_the_power_goes() -> None:
    rig = Rig()
    rig.enable()
    rig.follow(range(0, 6000, 100))
    rig.cycle(5900, word=0x07)
    assert rig.status & 0x6F == 0x27
    for _ in range(50):
        rig.cycle(5900, word=0x07)
    assert rig.status & 0x6F == 0x23
    assert rig.drive.physics.current_a == 0.0


def profile_rig() -> Rig:
    rig = Rig()
    rig.write(0x6081, 0, round(100 * INC_PER_MM), 4)
    rig.write(0x6083, 0, round(1000 * INC_PER_MM), 4)
    rig.write(0x6084, 0, round(500 * INC_PER_MM), 4)
    rig.enable(mode=1)
    return rig


def run_to(rig: Rig, target_mm: float, word: int, cycles: int) -> list[int]:
    """Command a target, then run; return the demand of each cycle."""
    target = round(target_mm * INC_PER_MM)
    demands = []
    for n in range(cycles):
        rig.cycle(target, word=word if n < 3 else word & ~0x10)
        demands.append(rig.read(0x6062, signed=True))
    return demands


@pytest.mark.usefixtures("real_time")
def test_profile_position_runs_a_trapezoid_and_tells_its_arrival() -> None:
    rig = profile_rig()
    assert rig.read(0x6061) == 1
    assert rig.status & 1 << 10
    rig.cycle(round(30 * INC_PER_MM), word=0x1F)
    assert rig.status & 1 << 12  # acknowledged
    assert not rig.status & 1 << 10
    demands = np.array(run_to(rig, 30, 0x0F, 700)) / INC_PER_MM
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
    rig = profile_rig()
    run_to(rig, 10, 0x1F, 600)
    run_to(rig, 5, 0x5F, 600)  # relative
    assert rig.drive.table_mm == pytest.approx(15.0, abs=2e-3)
    run_to(rig, 40, 0x1F, 60)
    run_to(rig, 45, 0x1F, 60)  # waits for its turn: the acknowledge stays
    assert rig.status & 1 << 12
    run_to(rig, 45, 0x0F, 900)
    assert rig.drive.table_mm == pytest.approx(45.0, abs=2e-3)
    run_to(rig, 100, 0x3F, 60)
    run_to(rig, 0, 0x3F, 400)  # turns round at once
    for _ in range(400):
        rig.cycle(0, word=0x10F)
    assert rig.status & 1 << 10
    assert rig.drive.physics.speed_rad_s == pytest.approx(0.0, abs=0.1)  # it hunts within an increment
    held = rig.drive.table_mm
    assert 0 < held < 45
    run_to(rig, 0, 0x0F, 900)
    assert rig.drive.table_mm == pytest.approx(0.0, abs=2e-3)


def test_no_mode_and_no_fault_has_the_cycle_compiled_again() -> None:
    rig = profile_rig()
    rig.drive.faults.load_torque_nm = 1
    rig.drive.faults.offset_scale = 2
    run_to(rig, 1, 0x1F, 5)
    for word in (0x10F, 0x02, 0x00):
        rig.cycle(0, word=word)
    rig.write(0x6060, 0, 8, 1)
    rig.cycle(0, 5, word=0x06)
    for _ in range(5):
        rig.cycle(0, 5)
    assert len(run_cycle.signatures) == 1


def test_switching_to_csp_follows_the_cyclic_set_points_again() -> None:
    rig = profile_rig()
    run_to(rig, 5, 0x1F, 400)
    rig.write(0x6060, 0, 8, 1)
    rig.follow(range(round(5 * INC_PER_MM), round(6 * INC_PER_MM), 50))
    assert rig.read(0x6061) == 8
    assert rig.drive.table_mm > 5.8
    rig.write(0x6060, 0, 1, 1)
    rig.cycle(0)
    before = rig.read(0x6062)
    for _ in range(300):
        rig.cycle(0)
    assert rig.read(0x6062) >= before  # no target yet: it runs out, it does not jump back


def test_without_a_mode_it_holds() -> None:
    rig = Rig()
    rig.enable(mode=0)
    rig.follow(range(0, 1000, 100))
    assert rig.read(0x6062) == 0
    assert rig.status & 0x6F == 0x27


@pytest.mark.parametrize("target", [0.0, 3.0, 12345.0, -777.7])
def test_a_profile_always_lands(target: float) -> None:
    profile = Profile(1e-3)
    profile.start(100.0, 5000.0)
    for _ in range(4000):
        profile.advance(target, 1e5, 1e6, 7e5)
    assert profile.at_rest
    assert profile.now == target


# -- the bench


def bench_path_mm(feed_mm_s: float, smoothing_s: tuple[float, ...]) -> Float:
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


def contour_um(reference: Float, actual: Float, half_window: int = 60) -> Float:
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
    rigs = [Rig(machine_config, axis) for axis in "XY"]
    increments = np.rint(path_mm * INC_PER_MM).astype(int)
    reference, actual = [], []
    for rig in rigs:
        rig.enable()
    for row in [*increments, increments[-1], increments[-1]]:
        for rig, target in zip(rigs, row, strict=True):
            rig.cycle(int(target), 0)
        reference.append([rig.drive.reference_mm for rig in rigs])
        actual.append([rig.drive.table_mm for rig in rigs])
    return np.array(reference)[2:], np.array(actual)[2:]


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize(
    ("feed_m_min", "smoothing_s", "rms_um", "max_um"),
    [(10, (0.060, 0.030), 24.2, 99), (20, (0.060, 0.030), 64, 218), (20, (0.030, 0.015), 760, 2600)],
)
def test_the_path_error_of_the_bench(
    feed_m_min: float, smoothing_s: tuple[float, ...], rms_um: float, max_um: float
) -> None:
    path = bench_path_mm(feed_m_min * 1e3 / 60, smoothing_s)
    reference, actual = drive_path(path)
    np.testing.assert_allclose(reference, path, atol=0.5 / INC_PER_MM + 1e-9)
    error = contour_um(reference, actual)
    assert np.sqrt((error**2).mean()) == pytest.approx(rms_um, rel=0.02)
    assert error.max() == pytest.approx(max_um, rel=0.01)


def test_temperature_or_drift_change_the_path_of_one_axis_alone() -> None:
    drives = [Drive("X", machine(), np.random.default_rng(0)) for _ in range(2)]
    drives[1].set_parameters(Jt=0.085)
    ends = []
    for drive in drives:
        rig = Rig()
        rig.drive = drive
        drive.power_on()
        rig.enable()
        ends.append(rig.follow([n * n // 4 for n in range(120)]))
    assert 1e-3 < np.abs(ends[0] - ends[1]).max() < 0.2
