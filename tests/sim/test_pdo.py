"""PDOs: mapping rules, latching and sending, and the codec against the `canopen` library."""

from __future__ import annotations

import struct

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.sim.drive.drive_description import compute_bus_load, count_frame_bits, describe_mapping
from tests.sim.canopen_peer import connect_directly
from tests.sim.drive_rig import Abort, DriveRig, build_machine_config

INVALID = 1 << 31


def list_identifiers(frames: list[tuple[int, bytes]]) -> list[int]:
    return [can_id for can_id, _ in frames]


def configure_pdo(
    rig: DriveRig, communication: int, mapping_index: int, cob_id: int, kind: int, entries: list[int]
) -> None:
    """Follow the procedure of CiA 301: invalid, count 0, entries, count, type, valid."""
    rig.write_object(communication, 1, cob_id | INVALID, 4)
    rig.write_object(mapping_index, 0, 0, 1)
    for sub, word in enumerate(entries, 1):
        rig.write_object(mapping_index, sub, word, 4)
    rig.write_object(mapping_index, 0, len(entries), 1)
    rig.write_object(communication, 2, kind, 1)
    rig.write_object(communication, 1, cob_id, 4)


def test_default_tpdos_have_their_rates() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    frames = [rig.send_sync() for _ in range(20)]
    assert [list_identifiers(f) for f in frames[:9]] == [[0x181, 0x281]] * 9
    assert list_identifiers(frames[9]) == [0x181, 0x281, 0x381, 0x481] == list_identifiers(frames[19])
    assert [len(data) for _, data in frames[9]] == [8, 6, 8, 7]


def test_no_pdo_is_sent_outside_operational() -> None:
    rig = DriveRig()
    assert rig.send_sync() == []
    rig.send_frame(0x201, struct.pack("<Hi", 6, 77))
    rig.send_nmt(0x01)
    rig.send_sync()
    assert rig.read_object(0x607A) == 0
    rig.send_nmt(0x80)
    assert rig.send_sync() == []
    rig.send_frame(0x201, struct.pack("<Hi", 6, 77))
    rig.send_sync()
    assert rig.read_object(0x607A) == 0


def test_synchronous_rpdo_waits_for_sync_and_newest_wins() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    rig.send_frame(0x301, struct.pack("<i", 5))
    rig.send_frame(0x301, struct.pack("<i", 6))
    assert rig.read_object(0x60B0) == 0
    rig.send_sync()
    assert rig.read_object(0x60B0) == 6
    assert rig.drive.pdo.received_numbers == set()
    assert rig.drive.pdo.previous_received_numbers == {2}


def test_event_driven_rpdo_acts_at_once() -> None:
    rig = DriveRig()
    rig.write_object(0x1401, 2, 255, 1)
    rig.send_nmt(0x01)
    rig.send_frame(0x301, struct.pack("<i", 5))
    assert rig.read_object(0x60B0) == 5
    rig.send_sync()
    assert rig.read_object(0x60B0) == 5


def test_short_rpdo_causes_emergency_and_long_one_is_truncated() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    ((can_id, data),) = rig.send_frame(0x301, b"\x05\0\0")
    assert (can_id, data[:3]) == (0x081, b"\x10\x82\x11")
    rig.send_frame(0x301, b"\x06\0\0\0\xff\xff")
    rig.send_sync()
    assert rig.read_object(0x60B0) == 6
    assert rig.read_object(0x1003) == 1
    assert rig.read_object(0x1003, 1) == 0x8210
    rig.write_object(0x1003, 0, 0, 1)
    assert rig.read_object(0x1003) == 0


def test_mapping_changes_in_pre_operational_only() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    for index, sub, value, size in (
        (0x1800, 1, 0xC0000181, 4),
        (0x1800, 2, 5, 1),
        (0x1A00, 0, 0, 1),
        (0x1400, 5, 9, 2),
    ):
        with pytest.raises(Abort) as abort:
            rig.write_object(index, sub, value, size)
        assert abort.value.code == 0x08000022


def test_remapping_procedure_changes_mapping() -> None:
    rig = DriveRig()
    configure_pdo(rig, 0x1803, 0x1A03, 0x481, 2, [0x606B0020, 0x60770010, 0x21010010])
    configure_pdo(rig, 0x1403, 0x1603, 0x501, 1, [0x00070020, 0x60B20010])
    rig.send_nmt(0x01)
    assert list_identifiers(rig.send_sync()) == [0x181, 0x281]
    rig.send_frame(0x501, struct.pack("<Ih", 99, -7))
    frames = dict(rig.send_sync())
    assert len(frames[0x481]) == 8
    assert rig.read_object(0x60B2, signed=True) == -7


def test_mapping_beyond_64_bits_is_refused() -> None:
    rig = DriveRig()
    rig.write_object(0x1803, 1, 0xC0000481, 4)
    rig.write_object(0x1A03, 0, 0, 1)
    for sub, word in enumerate((0x60640020, 0x606C0020, 0x60410010), 1):
        rig.write_object(0x1A03, sub, word, 4)
    with pytest.raises(Abort) as abort:
        rig.write_object(0x1A03, 0, 3, 1)
    assert abort.value.code == 0x06040042
    with pytest.raises(Abort) as abort:
        rig.write_object(0x1A03, 4, 0x00070020, 4)  # dummies are for RPDOs
    assert abort.value.code == 0x06040041
    rig.write_object(0x1A03, 0, 2, 1)
    with pytest.raises(Abort) as abort:
        rig.write_object(0x1A03, 1, 0x60640020, 4)  # sub-index 0 is not 0
    assert abort.value.code == 0x08000022


def test_acyclic_and_event_driven_tpdos_are_sent_on_change() -> None:
    rig = DriveRig(build_machine_config(noise=False))
    configure_pdo(rig, 0x1800, 0x1A00, 0x181, 0, [0x60FD0020])
    configure_pdo(rig, 0x1801, 0x1A01, 0x281, 255, [0x60FD0020])
    configure_pdo(rig, 0x1802, 0x1A02, 0x381, 255, [0x60640020])
    rig.write_object(0x1802, 5, 50, 2)
    rig.send_nmt(0x01)
    rig.drive.run_timers(1.0)
    assert list_identifiers(rig.send_sync()) == [
        0x181
    ]  # first values; the two event-driven ones went out with the clock
    assert list_identifiers(rig.send_sync()) == []
    rig.drive.feedback.digital_inputs = 1 << 16
    assert list_identifiers(rig.send_sync()) == [0x181, 0x281]
    assert list_identifiers(rig.drive.run_timers(1.049)) == []
    assert 0x381 in list_identifiers(rig.drive.run_timers(1.051))


def test_inhibit_time_delays_events() -> None:
    rig = DriveRig()
    rig.write_object(0x1801, 1, 0xC0000281, 4)
    rig.write_object(0x1801, 2, 254, 1)
    rig.write_object(0x1801, 3, 100, 2)  # 10 ms
    rig.write_object(0x1801, 1, 0x40000281, 4)
    rig.write_object(0x1017, 0, 0, 2)
    rig.send_nmt(0x01)
    assert list_identifiers(rig.drive.run_timers(1.0)) == [0x281]
    rig.drive.trip_fault(0xFF01)
    assert 0x281 not in list_identifiers(rig.drive.run_timers(1.005))
    assert 0x281 in list_identifiers(rig.drive.run_timers(1.011))


def test_sync_start_value_delays_first_tpdo() -> None:
    rig = DriveRig()
    rig.write_object(0x1019, 0, 240, 1)
    for n in (0, 1):
        rig.write_object(0x1800 + n, 1, 0xC0000181 + 0x100 * n, 4)
    rig.write_object(0x1802, 1, 0xC0000381, 4)
    rig.write_object(0x1802, 2, 3, 1)
    rig.write_object(0x1802, 6, 5, 1)
    rig.write_object(0x1802, 1, 0x40000381, 4)
    rig.send_nmt(0x01)
    sent = [counter for counter in range(1, 21) if 0x381 in list_identifiers(rig.send_sync(bytes([counter])))]
    assert sent == [7, 10, 13, 16, 19]


def test_rpdo_values_out_of_range_are_ignored() -> None:
    rig = DriveRig()
    configure_pdo(rig, 0x1403, 0x1603, 0x501, 255, [0x60600008])
    rig.send_nmt(0x01)
    rig.send_frame(0x501, bytes([8]))
    rig.send_frame(0x501, bytes([7]))
    assert rig.read_object(0x6060) == 8 == rig.read_object(0x6061)


def test_tpdos_can_be_dropped_and_remapped_by_fault() -> None:
    rig = DriveRig()
    rig.send_nmt(0x01)
    rig.drive.faults.drop_tpdo[1] = 2
    assert [0x181 in list_identifiers(rig.send_sync()) for _ in range(4)] == [False, False, True, True]
    rig.drive.faults.drop_tpdo[2] = -1
    assert list_identifiers(rig.send_sync()) == [0x181]
    rig.drive.overwrite_mapping(0x1A00, [(0x606C, 0, 32), (0x6064, 0, 32)])
    rig.drive.faults.get_signal_fault("position").offset = 1000
    _, position = struct.unpack("<ii", dict(rig.send_sync())[0x181])
    assert position == 1000
    assert rig.read_object(0x1A00, 1) == 0x606C0020


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=40)
@given(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1), st.integers(0, 2**16 - 1))
def test_codec_matches_library(position: int, torque: int, word: int) -> None:
    RIG.send_nmt(0x80)
    node, bus = connect_directly(RIG.drive)
    node.rpdo.read()
    node.tpdo.read()
    assert [entry.name for entry in node.tpdo[1].map] == ["Position actual value", "Velocity actual value"]
    rpdo = node.rpdo[3]
    rpdo[0x60B1].raw, rpdo[0x60B2].raw = position, torque
    node.rpdo[1][0x6040].raw, node.rpdo[1][0x607A].raw = word & 0xFF00, position
    node.nmt.send_command(0x01)
    for pdo in (rpdo, node.rpdo[1]):
        bus.send(can.Message(arbitration_id=pdo.cob_id, data=pdo.data, is_extended_id=False))
    for _ in range(10):
        bus.deliver_frames(RIG.send_sync())
    assert RIG.drive.dictionary.get_number(0x60B1) == position
    assert RIG.drive.dictionary.get_number(0x607A) == position
    assert RIG.drive.dictionary.get_number(0x60B2) == torque
    for entry in (*node.tpdo[1], *node.tpdo[2], *node.tpdo[3], *node.tpdo[4]):
        assert entry.raw == RIG.drive.dictionary.get_number(entry.index, entry.subindex)


RIG = DriveRig()
RIG.write_object(0x1402, 1, 0x401, 4)


def test_library_remaps_and_reads_back() -> None:
    rig = DriveRig()
    node, _ = connect_directly(rig.drive)
    node.tpdo.read()
    pdo = node.tpdo[4]
    pdo.clear()
    pdo.add_variable(0x60F4)
    pdo.add_variable(0x6041)
    pdo.trans_type = 5
    pdo.save()
    assert rig.read_object(0x1A03, 0) == 2
    assert rig.read_object(0x1A03, 1) == 0x60F40020
    assert rig.read_object(0x1803, 2) == 5
    rig.send_nmt(0x01)
    frames = [dict(rig.send_sync()) for _ in range(5)]
    assert len(frames[4][0x481]) == 6


def test_ready_event_has_live_mapping() -> None:
    rig = DriveRig()
    entry = describe_mapping(rig.drive)
    assert entry["node_id"] == 1
    assert entry["increments_per_mm"] == pytest.approx(3276.8)
    assert entry["sync_counter"] == 0
    assert [pdo["cob_id"] for pdo in entry["tpdo"]] == [0x181, 0x281, 0x381, 0x481]
    assert [pdo["cob_id"] for pdo in entry["rpdo"]] == [0x201, 0x301]  # the third is not valid
    assert entry["tpdo"][0]["entries"][0] == [0x6064, 0, 32, "mm", pytest.approx(20 / 65536)]
    assert entry["tpdo"][1]["entries"][2] == [0x2101, 0, 16, "V", 0.02]
    assert entry["tpdo"][1]["entries"][1] == [0x6078, 0, 16, "A", pytest.approx(0.05)]


def test_default_mapping_of_two_axes_fits_bus() -> None:
    drives = [DriveRig(build_machine_config("XY"), axis).drive for axis in "XY"]
    load = sum(compute_bus_load(drive, 1000) for drive in drives) + count_frame_bits(1) * 1000 / 1e6
    assert 0.8 < load < 0.9
    assert compute_bus_load(drives[0], 1000, stuffed=True) == pytest.approx(0.487, abs=0.01)


def test_position_offset_and_feedforward_are_not_added_to_bus_load() -> None:
    """With a valid RPDO of speed and torque the larger correction counts: 6 bytes instead of 4."""
    drive = DriveRig(build_machine_config("X")).drive
    alone, alone_worst = compute_bus_load(drive, 1000), compute_bus_load(drive, 1000, stuffed=True)
    drive.overwrite_object(0x1402, 1, 0x401)
    assert len(list(drive.pdo.list_configured("rpdo"))) == 3
    assert compute_bus_load(drive, 1000) - alone == pytest.approx((count_frame_bits(6) - count_frame_bits(4)) * 1e-3)
    worst = (count_frame_bits(6, stuffed=True) - count_frame_bits(4, stuffed=True)) * 1e-3
    assert compute_bus_load(drive, 1000, stuffed=True) - alone_worst == pytest.approx(worst)
    drive.overwrite_object(0x1401, 1, 0x80000301)
    assert compute_bus_load(drive, 1000) - alone == pytest.approx((count_frame_bits(6) - count_frame_bits(4)) * 1e-3)
