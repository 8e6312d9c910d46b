"""Drives of other vendors are decoded by their profiles: units, a voltage that is a product, no offset."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil import tables
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.cia402 import pack_pdo
from fdhil.config import MachineConfig, parse_config
from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.can.sync_grid import SyncGrid
from fdhil.drivers.cia402.drive_profile import DriveProfile, ObjectKey
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.drivers.cia402.pdo_decoder import PdoDecoder
from fdhil.errors import ConfigError
from fdhil.records import AxisSamples
from tests.bench import bench_document
from tests.drivers.frame_builder import Row, build_machine_config

N = 60
Counts = Callable[[ObjectKey, int], int]


def decode_samples(profile: DriveProfile, counts: Counts, *, streamed: bool = True) -> list[Row]:
    """Return the frames of one drive: SYNC k, its TPDOs, then the set-points for SYNC k+1."""
    out: list[Row] = []
    for k in range(N):
        at = 1_000_000_000 + k * 1_000_000
        out.append((at, 0x80, b""))
        specs = [spec for spec in profile.tpdos if spec.valid and k % spec.every_sync == 0]
        specs += [spec for spec in profile.rpdos if spec.valid and streamed]
        for place, spec in enumerate(specs, 1):
            values = [counts((e.index, e.sub), k) for e in spec.entries]
            out.append((at + place * 50_000, spec.cob_base + 1, pack_pdo(spec.entries, values)))
    return out


def decode_frames(
    config: MachineConfig, counts: Counts, profile: DriveProfile | None = None, *, streamed: bool = True
) -> AxisSamples:
    profile = profile or load_profile(config.axis["X"].drive)
    decoder = PdoDecoder("X", config, profile)
    ticked = SyncGrid(0.001, realtime=True).assign_ticks(
        pack_frames(decode_samples(profile, counts, streamed=streamed))
    )
    return next(record for record in decoder.decode_frames(ticked) if isinstance(record, AxisSamples))


def build_ramp(key: ObjectKey, k: int) -> int:
    """Return counts that differ between the objects and fit 16 bits."""
    return 8 if key[0] in (0x0005, 0x6061, 0x6861) else (key[0] + 3 * key[1]) % 97 + 5 * k


@pytest.mark.parametrize("name", [name for name in tables.DRIVE_PROFILES if name != "cia402"])
def test_every_profile_decodes_its_signals_at_their_ticks(name: str) -> None:
    config = build_machine_config(drive={"profile": name, "dc_link_v": 48.0})
    profile = load_profile(config.axis["X"].drive)
    got = decode_frames(config, build_ramp)
    assert got.tick.size > N - 10
    axis = config.axis["X"]
    for values, key, scale in (
        (got.speed_rad_s, profile.speed, profile.compute_speed_scale(axis)),
        (got.current_a, profile.current, profile.compute_current_scale(axis)),
    ):
        np.testing.assert_allclose(values, [build_ramp(key, int(k)) * scale for k in got.tick])
    if not profile.can_take_offset:
        assert not got.offset_mm.any()
    late = axis.drive.setpoint_delay_cycles + 1
    per_mm = axis.scaling.increments_per_mm
    np.testing.assert_allclose(got.demand_mm * per_mm, [build_ramp(profile.target, int(k) - late) for k in got.tick])


def test_second_axis_of_a_device_uses_the_next_node_id() -> None:
    config = build_machine_config(drive={"logical_axis": 2, "node_id": 1})
    profile = load_profile(config.axis["X"].drive)
    got = decode_frames(config, build_ramp)
    per_mm = config.axis["X"].scaling.increments_per_mm
    np.testing.assert_allclose(got.position_mm * per_mm, [build_ramp((0x6864, 0), int(k)) for k in got.tick])
    assert profile.can_take_offset
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"logical_axis": 2, "node_id": 1}
    settings = make_guard_settings(parse_config(document), "can0", Path(), "")
    axis = settings.axes[0]
    assert (axis.node_id, axis.target.cob_id, axis.offset.cob_id) == (1, 0x202, 0x302)
    assert axis.offset.layout == ((0x60B0, 0, 32, True),)


def test_two_axes_can_share_a_node_but_not_its_pdos() -> None:
    document = bench_document("XY")
    document["axis"]["X"]["drive"] = {"node_id": 5}
    document["axis"]["Y"]["drive"] = {"node_id": 5, "logical_axis": 2}
    assert parse_config(document).get_node_id("Y") == 5
    document["axis"]["Y"]["drive"]["node_id"] = 4
    with pytest.raises(ConfigError, match="the same node_id"):
        parse_config(document)


def test_unsigned_duty_gets_the_sign_of_the_motor_equation() -> None:
    """A braking EPOS4: the current opposes the speed, the voltage follows R i + K w."""
    config = build_machine_config(drive={"profile": "epos4", "dc_link_v": 48.0}, voltage={"sampling": "instant"})
    reported = {(0x606C, 0): -1000, (0x30D1, 2): 12_000, (0x3203, 1): 250}
    got = decode_frames(config, lambda key, _k: reported.get(key, 0))
    assert got.voltage_v is not None
    np.testing.assert_allclose(got.speed_rad_s, -1000 * 2 * math.pi / 60)
    np.testing.assert_allclose(got.current_a, 12.0)
    np.testing.assert_allclose(got.voltage_v, -0.25 * 48.0)


def test_duty_is_multiplied_by_the_dc_link_of_its_tick() -> None:
    config = build_machine_config(drive={"profile": "roboteq", "sign": -1}, voltage={"sampling": "instant"})
    link = {k: 240 + k % 5 for k in range(N)}
    got = decode_frames(config, lambda key, k: {(0x2102, 1): -500, (0x210D, 2): link[k]}.get(key, 0))
    assert got.voltage_v is not None
    np.testing.assert_allclose(got.voltage_v, [0.5 * 0.1 * link[int(k)] for k in got.tick])


def test_duty_without_dc_link_gives_no_voltage() -> None:
    got = decode_frames(build_machine_config(drive={"profile": "epos4"}), build_ramp)
    assert got.voltage_v is None


def test_drives_own_demand_is_used_when_none_is_streamed() -> None:
    config = build_machine_config(drive={"profile": "faulhaber", "dc_link_v": 24.0})
    got = decode_frames(config, build_ramp, streamed=False)
    per_mm = config.axis["X"].scaling.increments_per_mm
    np.testing.assert_allclose(got.demand_mm * per_mm, [build_ramp((0x6062, 0), int(k)) for k in got.tick])


def test_configured_speed_unit_overrides_the_profile() -> None:
    config = build_machine_config(drive={"profile": "epos4", "speed_unit": "millirpm"})
    profile = load_profile(config.axis["X"].drive)
    assert profile.compute_speed_scale(config.axis["X"]) == pytest.approx(2 * math.pi / 60_000)


def test_torque_is_converted_to_current_by_nominal_k() -> None:
    config = build_machine_config(drive={"rated_torque_nm": 4.0})
    axis = config.axis["X"]
    profile = replace(load_profile(axis.drive), current_unit="permille_of_rated_torque")
    assert profile.compute_current_scale(axis) == pytest.approx(4.0 / 1000 / axis.nominal.K)


def test_technosoft_current_scales_with_the_peak_current() -> None:
    config = build_machine_config(drive={"profile": "technosoft", "rated_current_a": 20.0})
    axis = config.axis["X"]
    profile = load_profile(axis.drive)
    assert profile.compute_current_scale(axis) == pytest.approx(2 * 20.0 / 65520)
    assert profile.compute_speed_scale(axis) == pytest.approx(1000 / 65536 * 2 * math.pi / 65536)
