"""Drives of other vendors are decoded by their profiles: units, a voltage that is a product, no offset."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil import tables
from fdhil.arming.guard_settings import settings_of
from fdhil.cia402 import pack_pdo
from fdhil.config import MachineConfig, parse
from fdhil.drivers.can.frames import frames_of
from fdhil.drivers.can.sync_grid import SyncGrid
from fdhil.drivers.cia402.drive import Cia402Decoder
from fdhil.drivers.cia402.profile import DriveProfile, ObjectKey
from fdhil.drivers.cia402.profile_file import load_profile
from fdhil.errors import ConfigError
from fdhil.records import AxisSamples
from tests.bench import bench_document
from tests.drivers.wire import Row, machine

N = 60
Counts = Callable[[ObjectKey, int], int]


def rows_of(profile: DriveProfile, counts: Counts, *, streamed: bool = True) -> list[Row]:
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


def decoded(
    config: MachineConfig, counts: Counts, profile: DriveProfile | None = None, *, streamed: bool = True
) -> AxisSamples:
    profile = profile or load_profile(config.axis["X"].drive)
    decoder = Cia402Decoder("X", config, profile)
    ticked = SyncGrid(0.001, realtime=True).feed(frames_of(rows_of(profile, counts, streamed=streamed)))
    return next(record for record in decoder.feed(ticked) if isinstance(record, AxisSamples))


def ramp(key: ObjectKey, k: int) -> int:
    """Return counts that differ between the objects and fit 16 bits."""
    return 8 if key[0] in (0x0005, 0x6061, 0x6861) else (key[0] + 3 * key[1]) % 97 + 5 * k


@pytest.mark.parametrize("name", [name for name in tables.DRIVE_PROFILES if name != "cia402"])
def test_every_profile_puts_its_signals_on_their_rows(name: str) -> None:
    config = machine(drive={"profile": name, "dc_link_v": 48.0})
    profile = load_profile(config.axis["X"].drive)
    got = decoded(config, ramp)
    assert got.tick.size > N - 10
    axis = config.axis["X"]
    for values, key, scale in (
        (got.speed_rad_s, profile.speed, profile.speed_rad_s_per_count(axis)),
        (got.current_a, profile.current, profile.current_a_per_count(axis)),
    ):
        np.testing.assert_allclose(values, [ramp(key, int(k)) * scale for k in got.tick])
    if not profile.takes_offset:
        assert not got.offset_mm.any()
    late = axis.drive.setpoint_delay_cycles + 1
    per_mm = axis.scaling.increments_per_mm
    np.testing.assert_allclose(got.demand_mm * per_mm, [ramp(profile.target, int(k) - late) for k in got.tick])


def test_the_second_axis_of_a_device_is_heard_at_the_next_node_id() -> None:
    config = machine(drive={"logical_axis": 2, "node_id": 1})
    profile = load_profile(config.axis["X"].drive)
    got = decoded(config, ramp)
    per_mm = config.axis["X"].scaling.increments_per_mm
    np.testing.assert_allclose(got.position_mm * per_mm, [ramp((0x6864, 0), int(k)) for k in got.tick])
    assert profile.takes_offset
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"logical_axis": 2, "node_id": 1}
    settings = settings_of(parse(document), "can0", Path(), "")
    axis = settings.axes[0]
    assert (axis.node_id, axis.target.cob_id, axis.offset.cob_id) == (1, 0x202, 0x302)
    assert axis.offset.layout == ((0x60B0, 0, 32, True),)


def test_two_axes_may_share_a_node_but_not_its_pdos() -> None:
    document = bench_document("XY")
    document["axis"]["X"]["drive"] = {"node_id": 5}
    document["axis"]["Y"]["drive"] = {"node_id": 5, "logical_axis": 2}
    assert parse(document).node_id("Y") == 5
    document["axis"]["Y"]["drive"]["node_id"] = 4
    with pytest.raises(ConfigError, match="the same node_id"):
        parse(document)


def test_a_duty_without_a_sign_gets_that_of_the_loop() -> None:
    """A braking EPOS4: the current opposes the speed, the voltage follows R i + K w."""
    config = machine(drive={"profile": "epos4", "dc_link_v": 48.0}, voltage={"sampling": "instant"})
    told = {(0x606C, 0): -1000, (0x30D1, 2): 12_000, (0x3203, 1): 250}
    got = decoded(config, lambda key, _k: told.get(key, 0))
    assert got.voltage_v is not None
    np.testing.assert_allclose(got.speed_rad_s, -1000 * 2 * math.pi / 60)
    np.testing.assert_allclose(got.current_a, 12.0)
    np.testing.assert_allclose(got.voltage_v, -0.25 * 48.0)


def test_a_duty_is_multiplied_by_the_dc_link_of_its_own_row() -> None:
    config = machine(drive={"profile": "roboteq", "sign": -1}, voltage={"sampling": "instant"})
    link = {k: 240 + k % 5 for k in range(N)}
    got = decoded(config, lambda key, k: {(0x2102, 1): -500, (0x210D, 2): link[k]}.get(key, 0))
    assert got.voltage_v is not None
    np.testing.assert_allclose(got.voltage_v, [0.5 * 0.1 * link[int(k)] for k in got.tick])


def test_a_duty_alone_is_no_voltage() -> None:
    got = decoded(machine(drive={"profile": "epos4"}), ramp)
    assert got.voltage_v is None


def test_the_drives_own_path_is_the_demand_where_none_is_streamed() -> None:
    config = machine(drive={"profile": "faulhaber", "dc_link_v": 24.0})
    got = decoded(config, ramp, streamed=False)
    per_mm = config.axis["X"].scaling.increments_per_mm
    np.testing.assert_allclose(got.demand_mm * per_mm, [ramp((0x6062, 0), int(k)) for k in got.tick])


def test_another_speed_unit_of_the_drive_counts() -> None:
    config = machine(drive={"profile": "epos4", "speed_unit": "millirpm"})
    profile = load_profile(config.axis["X"].drive)
    assert profile.speed_rad_s_per_count(config.axis["X"]) == pytest.approx(2 * math.pi / 60_000)


def test_a_torque_becomes_a_current_by_the_data_sheet() -> None:
    config = machine(drive={"rated_torque_nm": 4.0})
    axis = config.axis["X"]
    profile = replace(load_profile(axis.drive), current_unit="permille_of_rated_torque")
    assert profile.current_a_per_count(axis) == pytest.approx(4.0 / 1000 / axis.nominal.K)


def test_technosoft_counts_in_shares_of_the_peak_current() -> None:
    config = machine(drive={"profile": "technosoft", "rated_current_a": 20.0})
    axis = config.axis["X"]
    profile = load_profile(axis.drive)
    assert profile.current_a_per_count(axis) == pytest.approx(2 * 20.0 / 65520)
    assert profile.speed_rad_s_per_count(axis) == pytest.approx(1000 / 65536 * 2 * math.pi / 65536)
