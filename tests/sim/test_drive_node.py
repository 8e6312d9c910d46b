"""The drive as a node: NMT, heartbeats, emergencies, sensors, storage, EDS."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import canopen
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil import config
from fdhil.sim.drive.drive_objects import compute_serial_number
from fdhil.sim.drive.eds_writer import write_eds
from fdhil.sim.drive.servo_drive import SimulatedDrive
from tests.bench import bench_document
from tests.sim.canopen_peer import connect_over_virtual_bus, load_dictionary
from tests.sim.drive_rig import Abort, DriveRig, build_machine_config, list_emergency_codes

# -- NMT


def test_boot_up_states_and_heartbeat() -> None:
    rig = DriveRig()
    assert rig.boot == [(0x701, b"\0")]
    assert rig.drive.run_timers(10.0) == [(0x701, b"\x7f")]
    assert rig.drive.run_timers(10.05) == []
    rig.send_nmt(0x01)
    assert rig.drive.run_timers(10.1) == [(0x701, b"\x05")]
    rig.send_nmt(0x02)
    assert rig.drive.run_timers(10.2) == [(0x701, b"\x04")]
    assert rig.send_frame(0x601, bytes([0x40, 0, 0x10, 0]) + bytes(4)) == []  # no SDO while stopped
    rig.send_nmt(0x80)
    assert rig.read_object(0x1017) == 100
    rig.write_object(0x1017, 0, 0, 2)
    assert rig.drive.run_timers(99.0) == []


def test_nmt_addresses_all_nodes_or_its_own() -> None:
    rig = DriveRig()
    rig.send_frame(0, bytes([1, 5]))
    assert rig.drive.nmt == 0x7F
    rig.send_frame(0, bytes([1]))
    assert rig.drive.nmt == 0x7F
    rig.send_frame(0, bytes([1, 0]))
    assert rig.drive.nmt == 0x05


def test_reset_node_boots_with_the_power_on_values() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.run_cycle(0, 77)
    rig.write_object(0x6081, 0, 5, 4)
    assert rig.send_nmt(0x81) == [(0x701, b"\0")]
    assert rig.drive.nmt == 0x7F
    assert rig.read_object(0x60B0) == 0 == rig.read_object(0x6060) == rig.read_object(0x6040)
    assert rig.read_object(0x6081) == 500 * 65536 // 20
    assert rig.status & 0x6F == 0x40


def test_reset_communication_keeps_the_application() -> None:
    rig = DriveRig()
    rig.write_object(0x6081, 0, 5, 4)
    rig.write_object(0x1017, 0, 50, 2)
    rig.write_object(0x1802, 2, 3, 1)
    assert rig.send_nmt(0x82) == [(0x701, b"\0")]
    assert (rig.read_object(0x6081), rig.read_object(0x1017), rig.read_object(0x1802, 2)) == (5, 100, 10)


def test_saved_parameters_survive_reset() -> None:
    rig = DriveRig()
    rig.write_object(0x1016, 1, 100 << 16 | 60, 4)
    rig.write_object(0x607A, 0, 5, 4)
    rig.write_object(0x1010, 1, 0x65766173, 4)
    rig.send_nmt(0x81)
    assert rig.read_object(0x1016, 1) == 100 << 16 | 60
    assert rig.read_object(0x607A) == 0
    rig.write_object(0x1011, 1, 0x64616F6C, 4)
    rig.send_nmt(0x81)
    assert rig.read_object(0x1016, 1) == 0
    assert rig.read_object(0x1010, 1) == 1


def test_drive_without_supply_is_silent_and_coasts() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.follow_targets(range(0, 3000, 300))
    before = rig.drive.physics.speed_rad_s
    rig.drive.power_off()
    assert rig.send_sync() == [] == rig.drive.run_timers(5.0) == rig.send_nmt(0x81)
    assert 0 < rig.drive.physics.speed_rad_s < before
    assert rig.drive.physics.current_a == 0
    assert rig.drive.power_on() == [(0x701, b"\0")]
    assert rig.read_object(0x6064) == rig.read_object(0x607A) > 500  # an absolute encoder


def test_sync_with_and_without_counter() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    assert len(rig.send_sync()) == 2 == len(rig.send_sync(b"\x05"))
    rig.send_nmt(0x80)
    rig.write_object(0x1019, 0, 240, 1)
    rig.send_nmt(0x01)
    assert len(rig.send_sync(b"\x01")) == 2
    assert list_emergency_codes(rig.send_sync()) == [0x8240]
    assert rig.send_sync() == []  # reported once
    rig.send_nmt(0x80)
    rig.write_object(0x1005, 0, 0x81, 4)
    rig.send_nmt(0x01)
    assert rig.send_sync(b"\x01") == []
    assert len(rig.send_frame(0x81, b"\x01")) == 2


def test_sync_parameters_change_in_pre_operational_only() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    for index, value, size in ((0x1005, 0x81, 4), (0x1019, 240, 1)):
        with pytest.raises(Abort) as abort:
            rig.write_object(index, 0, value, size)
        assert abort.value.code == 0x08000022


@pytest.mark.parametrize(("period_s", "value", "exponent"), [(0.001, 1, -3), (0.002, 2, -3), (0.0005, 5, -4)])
def test_drive_follows_other_sync_periods(period_s: float, value: int, exponent: int) -> None:
    document = bench_document("X")
    document["machine"]["sync_period_s"] = period_s
    rig = DriveRig(config.parse_config(document))
    assert (rig.read_object(0x60C2, 1), rig.read_object(0x60C2, 2, signed=True)) == (value, exponent)
    assert rig.read_object(0x1006) == round(period_s * 1e6)
    assert rig.drive.physics.voltage_v.size == round(period_s / 3.125e-5)
    rig.enable_drive()
    rig.follow_targets(range(0, 20000, 100))
    assert rig.drive.reference_mm == pytest.approx(19700 / 3276.8)
    assert rig.drive.table_mm == pytest.approx(rig.drive.reference_mm, abs=0.05)


def test_sync_counter_is_enabled_with_simulated_nc() -> None:
    with_nc = build_machine_config().model_copy(
        update={"sim": build_machine_config().sim.model_copy(update={"nc": True})}
    )
    assert DriveRig(with_nc).read_object(0x1019) == 240


# -- sensors


def test_noise_has_configured_deviation_and_affects_reported_values_only() -> None:
    rig = DriveRig(build_machine_config(noise=True))
    rig.send_nmt(0x01)
    rows = []
    for _ in range(2000):
        frames = dict(rig.send_sync())
        speed = struct.unpack("<ii", frames[0x181])[1]
        rows.append((speed, *struct.unpack("<Hhh", frames[0x281])[1:]))
    std = np.std(np.array(rows) * [2 * np.pi / 65536, 0.05, 0.02], axis=0)
    np.testing.assert_allclose(std, [0.15, np.hypot(0.05, 0.05 / 12**0.5), 0.06], rtol=0.08)
    assert rig.drive.table_mm == 0.0


def test_sensor_faults_change_reported_values() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    read = {"position": 0x6064, "speed": 0x606C, "current": 0x6078, "voltage": 0x2101}
    for name, index in read.items():
        fault = rig.drive.faults.get_signal_fault(name)
        fault.offset = 4.0
        rig.send_sync()
        value = rig.read_object(index, signed=True)
        assert value > 0
        fault.gain, fault.clip = -1.0, 2.0
        rig.send_sync()
        assert 0 < rig.read_object(index, signed=True) <= value
        fault.clip, fault.stuck = None, True
        rig.send_sync()
        fault.offset = -4.0
        rig.send_sync()
        assert rig.read_object(index, signed=True) == value
        fault.stuck, fault.resolution = False, 100.0
        rig.send_sync()
        assert rig.read_object(index, signed=True) == 0
        fault.garbage = 1e9
        seen = set()
        for _ in range(5):
            rig.send_sync()
            seen.add(rig.read_object(index, signed=True))
        assert len(seen) > 1
    with pytest.raises(KeyError):
        rig.drive.faults.get_signal_fault("humidity")


def test_delayed_sensor_reports_old_values() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.drive.faults.get_signal_fault("position").delay_cycles = 3
    true, shown = [], []
    for target in range(0, 4000, 100):
        rig.run_cycle(target)
        true.append(round(rig.drive.table_mm * 3276.8))
        shown.append(rig.read_object(0x6064, signed=True))
    assert shown[3:] == true[:-3]


def test_friction_follows_temperature() -> None:
    rig = DriveRig(build_machine_config(ft_per_kelvin=-0.4, Cd_per_kelvin=-0.1))
    rig.drive.set_temperature(22.0)
    assert rig.read_object(0x2110, 1) == 2200
    assert rig.drive.physics.parameters.ft == pytest.approx(0.05 * 0.2)
    assert rig.drive.physics.parameters.Cd == pytest.approx(4.0)
    rig.drive.set_parameters(Jt=0.085, Cd=1.0)
    assert rig.drive.physics.parameters.Jt == 0.085
    assert rig.drive.physics.parameters.Cd == pytest.approx(0.8)
    rig.drive.set_temperature(30.0)
    assert rig.drive.physics.parameters.ft == 0.0
    for wrong in ({"Jt": 0.0}, {"R": float("nan")}, {"ft": -1.0}):
        with pytest.raises(ValueError, match="is unphysical"):
            rig.drive.set_parameters(**wrong)
    with pytest.raises(TypeError):
        rig.drive.set_parameters(mass=1.0)


def test_true_plant_may_differ_from_nominal() -> None:
    rig = DriveRig(build_machine_config(Jt=0.09, start_mm=12.0))
    assert rig.drive.physics.parameters.Jt == 0.09
    assert rig.read_object(0x6076) == 40000  # the drive's data sheet does not know
    assert rig.drive.table_mm == pytest.approx(12.0)
    assert rig.read_object(0x6064) == round(12 * 3276.8) == rig.read_object(0x607A)


# -- EDS


def test_eds_describes_the_drive(tmp_path: Path) -> None:
    rig = DriveRig(build_machine_config("XY"), "Y")
    od: Any = canopen.import_od(str(write_eds(rig.drive, tmp_path / "sub" / "y.eds")), 2)
    for item in rig.drive.dictionary:
        for entry in item.entries:
            described = od.get_variable(item.index, entry.sub)
            assert described is not None, hex(item.index)
            assert described.data_type == entry.type
            assert described.access_type == entry.access
            assert described.pdo_mappable == entry.mappable
            if entry.size is not None:
                assert described.default == entry.default
                assert (described.min, described.max) == (entry.low, entry.high)
    assert isinstance(od[0x1600], canopen.objectdictionary.ODRecord)
    assert od[0x1018][4].default == compute_serial_number(build_machine_config("XY"), "Y")
    elsewhere: Any = canopen.import_od(str(tmp_path / "sub" / "y.eds"), 9)
    assert elsewhere[0x1800][1].default == 0x40000189
    assert elsewhere[0x1402][1].default == 0x80000409


def test_library_reads_every_readable_object() -> None:
    rig = DriveRig()
    rig.send_sync()
    od: Any = load_dictionary(rig.drive)
    for item in rig.drive.dictionary:
        for entry in item.entries:
            if entry.access == "wo" or item.index == 0x1003:
                continue
            data = rig.drive.dictionary.read_entry(item.index, entry.sub)
            assert od.get_variable(item.index, entry.sub).decode_raw(data) is not None
            assert entry.size in (None, len(data))


@pytest.mark.usefixtures("real_time")
def test_master_enables_drive_over_virtual_bus() -> None:
    rig = DriveRig()
    with connect_over_virtual_bus(rig.drive) as node:
        node.nmt.state = "OPERATIONAL"
        node.sdo["Modes of operation"].raw = 8
        for word in (0x06, 0x07, 0x0F):
            node.sdo["Controlword"].raw = word
        assert node.sdo["Statusword"].raw & 0x6F == 0x27
        assert node.sdo["Modes of operation display"].raw == 8
        assert node.emcy.log == []


def test_two_runs_are_bit_identical() -> None:
    def record_run() -> list[list[tuple[int, bytes]]]:
        rig = DriveRig(build_machine_config(noise=True, backlash_um=5.0), seed=7)
        rig.enable_drive()
        return [rig.run_cycle(n * n, n) for n in range(200)]

    assert record_run() == record_run()


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 0x80, 0x201, 0x301, 0x401, 0x601, 0x701, 0x764, 0x123, 0x181, 0x7E5]),
            st.binary(max_size=8),
        ),
        max_size=60,
    )
)
def test_drive_survives_arbitrary_frames(frames: list[tuple[int, bytes]]) -> None:
    drive = SimulatedDrive("X", CONFIG, np.random.default_rng(0))
    drive.power_on()
    drive.receive_frame(0, b"\x01\x00")
    for n, (can_id, data) in enumerate(frames):
        for sent_id, sent in (*drive.receive_frame(can_id, data), *drive.run_timers(n * 0.02)):
            assert 0 < sent_id <= 0x7FF
            assert len(sent) <= 8
    assert np.isfinite(drive.table_mm)


CONFIG = build_machine_config()
