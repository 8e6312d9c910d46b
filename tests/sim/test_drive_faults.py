"""The drive's reactions to faults: lost heartbeats and RPDOs, trips, following error, injected faults."""

from __future__ import annotations

import pytest

from tests.sim.drive_rig import Abort, DriveRig, list_emergency_codes

HEARTBEAT_LOST = 0x8130


# -- heartbeats of others


def monitor_heartbeat(reaction: int) -> DriveRig:
    rig = DriveRig()
    rig.write_object(0x6007, 0, reaction, 2)
    rig.write_object(0x1016, 1, 100 << 16 | 60, 4)
    rig.enable_drive()
    return rig


@pytest.mark.parametrize(("reaction", "pattern"), [(0, 0x27), (1, 0x0F), (2, 0x40), (3, 0x07)])
def test_lost_heartbeat_sends_emergency_and_triggers_reaction(reaction: int, pattern: int) -> None:
    rig = monitor_heartbeat(reaction)
    rig.drive.run_timers(1.0)
    assert list_emergency_codes(rig.drive.run_timers(9.0)) == []  # monitoring starts with the first one
    rig.send_frame(0x764, b"\x05")
    assert list_emergency_codes(rig.drive.run_timers(9.0599)) == []
    assert list_emergency_codes(rig.drive.run_timers(9.061)) == [HEARTBEAT_LOST]
    assert rig.status & (0x4F if reaction == 2 else 0x6F) == pattern
    assert rig.read_object(0x1001) == 0x11
    assert rig.read_object(0x603F) == (HEARTBEAT_LOST if reaction == 1 else 0)
    assert list_emergency_codes(rig.drive.run_timers(9.5)) == []  # once
    back = list_emergency_codes(rig.send_frame(0x764, b"\x05"))
    assert (back, rig.read_object(0x1001)) == (([], 1) if reaction == 1 else ([0], 0))  # a fault stays until its reset


def test_axis_is_unpowered_at_standstill_after_fault_reaction() -> None:
    rig = monitor_heartbeat(1)
    rig.send_frame(0x764, b"\x05")
    rig.follow_targets(range(0, 30000, 300))
    rig.drive.run_timers(1.0)
    for _ in range(200):
        rig.run_cycle(29700)
    assert rig.status & 0x4F == 0x08
    assert rig.drive.physics.speed_rad_s == 0
    assert rig.drive.physics.current_a == 0
    rig.run_cycle(29700, word=0x80)
    assert rig.status & 0x6F == 0x40
    assert rig.read_object(0x603F) == 0


def test_heartbeat_consumer_can_be_disabled_by_fault() -> None:
    rig = monitor_heartbeat(1)
    rig.drive.faults.no_heartbeat_consumer = True
    rig.send_frame(0x764, b"\x05")
    assert list_emergency_codes(rig.drive.run_timers(50.0)) == []


def test_node_cannot_be_monitored_twice() -> None:
    rig = monitor_heartbeat(1)
    with pytest.raises(Abort) as abort:
        rig.write_object(0x1016, 2, 100 << 16 | 50, 4)
    assert abort.value.code == 0x06040043
    rig.write_object(0x1016, 2, 100 << 16, 4)


def test_nmt_stop_under_power_aborts_connection() -> None:
    rig = monitor_heartbeat(2)
    rig.send_nmt(0x02)
    assert rig.status & 0x4F == 0x40


def test_missing_rpdo_causes_timeout_error() -> None:
    rig = DriveRig()
    rig.write_object(0x1401, 5, 5, 2)
    rig.write_object(0x6007, 0, 3, 2)
    rig.enable_drive()
    rig.drive.run_timers(1.0)
    assert list_emergency_codes(rig.drive.run_timers(1.1)) == []
    rig.run_cycle(0, 0)
    assert list_emergency_codes(rig.drive.run_timers(1.104)) == []
    assert list_emergency_codes(rig.drive.run_timers(1.106)) == [0x8250]
    assert rig.status & 0x6F == 0x07


# -- faults


def test_trip_sends_one_emergency_and_enters_history() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.drive.trip_fault(0x2310, b"\x01\x02\x03\x04\x05")
    ((_, data),) = [frame for frame in rig.send_sync() if frame[0] == 0x081]
    assert data == bytes([0x10, 0x23, 0x03, 1, 2, 3, 4, 5])
    assert rig.read_object(0x603F) == 0x2310
    rig.drive.trip_fault(0x4310)
    assert rig.read_object(0x1003) == 2
    assert (rig.read_object(0x1003, 1), rig.read_object(0x1003, 2)) == (0x4310, 0x02012310)
    for _ in range(12):
        rig.drive.trip_fault(0x3210)
    assert rig.read_object(0x1003) == 8
    rig.write_object(0x1014, 0, 0x80000081, 4)
    rig.send_sync()
    rig.drive.trip_fault(0xFF01)
    assert list_emergency_codes(rig.send_sync()) == []  # the EMCY object is not valid


def test_following_error_trips_after_window_and_timeout() -> None:
    rig = DriveRig()
    rig.write_object(0x6065, 0, 1000, 4)
    rig.enable_drive()
    rig.drive.faults.load_torque_nm = 400.0  # a jam: more than 200 A can hold
    codes, statuses = [], []
    for _ in range(60):
        codes += list_emergency_codes(rig.run_cycle(0))
        statuses.append(rig.status)
    assert codes == [0x8611]
    assert statuses[-1] & 1 << 13
    assert statuses[-1] & 0x4F == 0x08
    assert rig.read_object(0x1001) & 0x21 == 0x21
    off = DriveRig()
    off.write_object(0x6065, 0, 0xFFFFFFFF, 4)
    off.enable_drive()
    off.drive.faults.load_torque_nm = 400.0
    for _ in range(60):
        assert list_emergency_codes(off.run_cycle(0)) == []
    assert off.status & 1 << 11  # the current limit acts


def test_limit_switches_set_statusword_bit_11() -> None:
    rig = DriveRig()
    rig.drive.feedback.digital_inputs = 1 << 16 | 2
    rig.send_sync()
    assert rig.status & 1 << 11
    assert rig.read_object(0x60FD) == 0x10002 == rig.drive.feedback.digital_inputs


def test_the_offset_can_be_ignored_or_scaled() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.run_cycle(0, 100)
    rig.drive.faults.ignore_offset = True
    for _ in range(4):
        rig.run_cycle(0, 300)
    assert rig.read_object(0x60B0) == 100 == rig.read_object(0x6062)
    rig.drive.faults.ignore_offset = False
    rig.drive.faults.offset_scale = 10.0
    for _ in range(4):
        rig.run_cycle(0, 30)
    assert (rig.read_object(0x60B0), rig.read_object(0x6062)) == (30, 300)


def test_drive_not_in_csp_reports_mode_and_holds() -> None:
    rig = DriveRig()
    rig.enable_drive()
    rig.drive.faults.not_csp = True
    rig.follow_targets(range(0, 3000, 100))
    assert rig.read_object(0x6061) == 1
    assert not rig.status & 1 << 12
    assert abs(rig.drive.table_mm) < 0.01
