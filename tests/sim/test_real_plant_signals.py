"""Effects of real axes as reported by the drive's objects: speed, voltage, position, gravity load."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fdhil import config
from tests.bench import bench_document
from tests.sim.drive_rig import NO_NOISE, DriveRig, build_machine_config

INC_PER_MM = 65536 / 20


def measure_travel_mm(n: int = 300) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray(20.0 * (1 - np.cos(2 * np.pi * np.arange(n) / 400)))


def record_objects(rig: DriveRig, *objects: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Move the axis; return the objects' values at each SYNC, (n, objects)."""
    rows = []
    for target in np.rint(measure_travel_mm() * INC_PER_MM).astype(int):
        rig.run_cycle(int(target))
        rows.append([rig.drive.dictionary.numbers[index << 8] for index in objects])
    return np.array(rows, dtype=float)


def test_encoder_difference_speed_has_quantisation_noise_only() -> None:
    rig = DriveRig(build_machine_config(noise=True, reality={"speed_object": "difference", "encoder_bits": 16}))
    rig.enable_drive()
    position, speed = record_objects(rig, 0x6064, 0x606C).T
    assert np.abs(np.diff(position) / 1e-3 - speed[1:]).max() < 1001  # an increment per millisecond
    assert speed.max() > 900_000


def test_shaft_speed_has_white_noise() -> None:
    rig = DriveRig(build_machine_config(noise=True, reality={"dead_time_v": 1.0}))
    rig.enable_drive()
    position, speed = record_objects(rig, 0x6064, 0x606C).T
    middle = np.gradient(position, 1e-3)
    assert 0.1 < np.std((middle - speed)[5:-5]) * 2 * np.pi / 65536 < 0.3


def test_voltage_object_is_demand_and_separate_sensor_is_terminal_voltage() -> None:
    rig = DriveRig(build_machine_config(reality={"voltage_object": "command", "dead_time_v": 3.0}))
    rig.enable_drive()
    record_objects(rig, 0x2101)
    physics = rig.drive.physics
    assert abs(physics.current_a) > 5.0
    assert physics.sensed.voltage_v == pytest.approx(
        physics.voltage_mean_v + 3.0 * np.sign(physics.current_a), abs=0.01
    )


def test_dc_link_voltage_object_sags() -> None:
    rig = DriveRig(build_machine_config(reality={"bus_sag": 0.1, "bus_power_kw": 20.0}))
    rig.enable_drive()
    assert rig.read_object(0x6079) == 300_000
    bus = record_objects(rig, 0x6079)[:, 0]
    assert 250_000 < bus.min() < 290_000


@pytest.mark.parametrize("sign", [1, -1])
def test_load_acts_in_axis_direction_for_either_drive_sign(sign: int) -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"sign": sign}
    document["sim"] = {"noise": NO_NOISE, "axis": {"X": {"reality": {"load_nm": 8.0}}}}
    rig = DriveRig(config.parse_config(document))
    for _ in range(50):
        rig.send_sync()
    assert rig.drive.table_mm < -0.05  # no brake: it falls
    assert rig.drive.physics.angle_rad * sign < 0.0


def test_enabled_drive_holds_load_and_reports_standstill_current() -> None:
    rig = DriveRig(build_machine_config(reality={"load_nm": 8.0, "brake_nm": 20.0}))
    rig.enable_drive()
    for _ in range(800):
        rig.run_cycle(0)
    current_a = rig.drive.dictionary.numbers[0x607800] * 0.05
    assert current_a == pytest.approx((8.0 - 5.0) / 0.8, abs=12.0 / 0.8)  # friction holds a part, either way
    assert current_a > 3.0
    assert abs(rig.drive.table_mm) < 2e-3


def test_speed_demand_uses_real_gains() -> None:
    rig = DriveRig(build_machine_config(reality={"position_gain_per_s": 100.0, "speed_feedforward": 0.0}))
    rig.enable_drive()
    demand, position, wanted = record_objects(rig, 0x6062, 0x6064, 0x606B).T
    assert np.abs(wanted - 100.0 * (demand - position)).max() <= 100.0  # an increment of rounding


def test_temperature_and_parameter_changes_keep_real_effects() -> None:
    rig = DriveRig(build_machine_config(Cd_per_kelvin=-0.1, reality={"static_friction": 0.2, "resonance_hz": 80.0}))
    rig.drive.set_temperature(22.0)
    assert rig.drive.physics.parameters.Cd == pytest.approx(4.0)
    rig.drive.set_parameters(Jt=0.09)
    assert rig.drive.physics.parameters.Jt == 0.09
    with pytest.raises(TypeError, match="load: not a parameter"):
        rig.drive.set_parameters(load=1.0)
