"""Effects of real axes as reported by the drive's objects: speed, voltage, position, gravity load."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fdhil import config
from tests.bench import bench_document
from tests.sim.rig import NO_NOISE, Rig, machine

INC_PER_MM = 65536 / 20


def way_mm(n: int = 300) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray(20.0 * (1 - np.cos(2 * np.pi * np.arange(n) / 400)))


def told(rig: Rig, *objects: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Move the axis; return the objects' values at each SYNC, (n, objects)."""
    rows = []
    for target in np.rint(way_mm() * INC_PER_MM).astype(int):
        rig.cycle(int(target))
        rows.append([rig.drive.dictionary.numbers[index << 8] for index in objects])
    return np.array(rows, dtype=float)


def test_a_speed_of_encoder_positions_has_their_noise_and_no_other() -> None:
    rig = Rig(machine(noise=True, reality={"speed_object": "difference", "encoder_bits": 16}))
    rig.enable()
    position, speed = told(rig, 0x6064, 0x606C).T
    assert np.abs(np.diff(position) / 1e-3 - speed[1:]).max() < 1001  # an increment per millisecond
    assert speed.max() > 900_000


def test_a_speed_of_the_shaft_has_white_noise() -> None:
    rig = Rig(machine(noise=True, reality={"dead_time_v": 1.0}))
    rig.enable()
    position, speed = told(rig, 0x6064, 0x606C).T
    middle = np.gradient(position, 1e-3)
    assert 0.1 < np.std((middle - speed)[5:-5]) * 2 * np.pi / 65536 < 0.3


def test_the_voltage_object_is_the_command_and_the_sensor_beside_the_motor_tells_the_rest() -> None:
    rig = Rig(machine(reality={"voltage_object": "command", "dead_time_v": 3.0}))
    rig.enable()
    told(rig, 0x2101)
    physics = rig.drive.physics
    assert abs(physics.current_a) > 5.0
    assert physics.seen.voltage_v == pytest.approx(physics.voltage_mean_v + 3.0 * np.sign(physics.current_a), abs=0.01)


def test_the_bus_voltage_is_an_object_and_sags() -> None:
    rig = Rig(machine(reality={"bus_sag": 0.1, "bus_power_kw": 20.0}))
    rig.enable()
    assert rig.read(0x6079) == 300_000
    bus = told(rig, 0x6079)[:, 0]
    assert 250_000 < bus.min() < 290_000


@pytest.mark.parametrize("sign", [1, -1])
def test_a_weight_pulls_against_the_axis_whichever_way_the_drive_counts(sign: int) -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"sign": sign}
    document["sim"] = {"noise": NO_NOISE, "axis": {"X": {"reality": {"load_nm": 8.0}}}}
    rig = Rig(config.parse_config(document))
    for _ in range(50):
        rig.sync()
    assert rig.drive.table_mm < -0.05  # no brake: it falls
    assert rig.drive.physics.angle_rad * sign < 0.0


def test_an_enabled_drive_holds_the_weight_and_its_standstill_current_is_on_the_bus() -> None:
    rig = Rig(machine(reality={"load_nm": 8.0, "brake_nm": 20.0}))
    rig.enable()
    for _ in range(800):
        rig.cycle(0)
    current_a = rig.drive.dictionary.numbers[0x607800] * 0.05
    assert current_a == pytest.approx((8.0 - 5.0) / 0.8, abs=12.0 / 0.8)  # friction holds a part, either way
    assert current_a > 3.0
    assert abs(rig.drive.table_mm) < 2e-3


def test_the_drives_own_gains_are_behind_its_speed_demand() -> None:
    rig = Rig(machine(reality={"position_gain_per_s": 100.0, "speed_feedforward": 0.0}))
    rig.enable()
    demand, position, wanted = told(rig, 0x6062, 0x6064, 0x606B).T
    assert np.abs(wanted - 100.0 * (demand - position)).max() <= 100.0  # an increment of rounding


def test_warmth_and_a_changed_plant_keep_what_reality_adds() -> None:
    rig = Rig(machine(Cd_per_kelvin=-0.1, reality={"static_friction": 0.2, "resonance_hz": 80.0}))
    rig.drive.set_temperature(22.0)
    assert rig.drive.physics.parameters.Cd == pytest.approx(4.0)
    rig.drive.set_parameters(Jt=0.09)
    assert rig.drive.physics.parameters.Jt == 0.09
    with pytest.raises(TypeError, match="load: not a parameter"):
        rig.drive.set_parameters(load=1.0)
