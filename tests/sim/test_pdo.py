"""PDOs: mapping rules, latching and sending, and the codec against the `canopen` library."""

from __future__ import annotations

import struct

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.sim.drive.description import bus_load, frame_bits, mapping
from tests.sim.canopen_peer import direct
from tests.sim.rig import Abort, Rig, machine

INVALID = 1 << 31


def ids(frames: list[tuple[int, bytes]]) -> list[int]:
    return [can_id for can_id, _ in frames]


def configure(rig: Rig, communication: int, mapping_index: int, cob_id: int, kind: int, entries: list[int]) -> None:
    """Follow the procedure of CiA 301: invalid, count 0, entries, count, type, valid."""
    rig.write(communication, 1, cob_id | INVALID, 4)
    rig.write(mapping_index, 0, 0, 1)
    for sub, word in enumerate(entries, 1):
        rig.write(mapping_index, sub, word, 4)
    rig.write(mapping_index, 0, len(entries), 1)
    rig.write(communication, 2, kind, 1)
    rig.write(communication, 1, cob_id, 4)


def test_default_tpdos_come_at_their_rates() -> None:
    rig = Rig()
    rig.nmt(0x01)
    frames = [rig.sync() for _ in range(20)]
    assert [ids(f) for f in frames[:9]] == [[0x181, 0x281]] * 9
    assert ids(frames[9]) == [0x181, 0x281, 0x381, 0x481] == ids(frames[19])
    assert [len(data) for _, data in frames[9]] == [8, 6, 8, 7]


def test_no_pdo_outside_operational() -> None:
    rig = Rig()
    assert rig.sync() == []
    rig.send(0x201, struct.pack("<Hi", 6, 77))
    rig.nmt(0x01)
    rig.sync()
    assert rig.read(0x607A) == 0
    rig.nmt(0x80)
    assert rig.sync() == []
    rig.send(0x201, struct.pack("<Hi", 6, 77))
    rig.sync()
    assert rig.read(0x607A) == 0


def test_a_synchronous_rpdo_waits_for_the_sync_and_the_newest_counts() -> None:
    rig = Rig()
    rig.nmt(0x01)
    rig.send(0x301, struct.pack("<i", 5))
    rig.send(0x301, struct.pack("<i", 6))
    assert rig.read(0x60B0) == 0
    rig.sync()
    assert rig.read(0x60B0) == 6
    assert rig.drive.pdo.heard == set()
    assert rig.drive.pdo.heard_before == {2}


def test_an_event_driven_rpdo_acts_at_once() -> None:
    rig = Rig()
    rig.write(0x1401, 2, 255, 1)
    rig.nmt(0x01)
    rig.send(0x301, struct.pack("<i", 5))
    assert rig.read(0x60B0) == 5
    rig.sync()
    assert rig.read(0x60B0) == 5


def test_short_frames_are_refused_with_an_emergency_and_long_ones_cut() -> None:
    rig = Rig()
    rig.nmt(0x01)
    ((can_id, data),) = rig.send(0x301, b"\x05\0\0")
    assert (can_id, data[:3]) == (0x081, b"\x10\x82\x11")
    rig.send(0x301, b"\x06\0\0\0\xff\xff")
    rig.sync()
    assert rig.read(0x60B0) == 6
    assert rig.read(0x1003) == 1
    assert rig.read(0x1003, 1) == 0x8210
    rig.write(0x1003, 0, 0, 1)
    assert rig.read(0x1003) == 0


def test_mapping_changes_in_pre_operational_only() -> None:
    rig = Rig()
    rig.nmt(0x01)
    for index, sub, value, size in (
        (0x1800, 1, 0xC0000181, 4),
        (0x1800, 2, 5, 1),
        (0x1A00, 0, 0, 1),
        (0x1400, 5, 9, 2),
    ):
        with pytest.raises(Abort) as abort:
            rig.write(index, sub, value, size)
        assert abort.value.code == 0x08000022


def test_remapping_by_the_procedure() -> None:
    rig = Rig()
    configure(rig, 0x1803, 0x1A03, 0x481, 2, [0x606B0020, 0x60770010, 0x21010010])
    configure(rig, 0x1403, 0x1603, 0x501, 1, [0x00070020, 0x60B20010])
    rig.nmt(0x01)
    assert ids(rig.sync()) == [0x181, 0x281]
    rig.send(0x501, struct.pack("<Ih", 99, -7))
    frames = dict(rig.sync())
    assert len(frames[0x481]) == 8
    assert rig.read(0x60B2, signed=True) == -7


def test_a_mapping_beyond_64_bits_is_refused() -> None:
    rig = Rig()
    rig.write(0x1803, 1, 0xC0000481, 4)
    rig.write(0x1A03, 0, 0, 1)
    for sub, word in enumerate((0x60640020, 0x606C0020, 0x60410010), 1):
        rig.write(0x1A03, sub, word, 4)
    with pytest.raises(Abort) as abort:
        rig.write(0x1A03, 0, 3, 1)
    assert abort.value.code == 0x06040042
    with pytest.raises(Abort) as abort:
        rig.write(0x1A03, 4, 0x00070020, 4)  # dummies are for RPDOs
    assert abort.value.code == 0x06040041
    rig.write(0x1A03, 0, 2, 1)
    with pytest.raises(Abort) as abort:
        rig.write(0x1A03, 1, 0x60640020, 4)  # sub-index 0 is not 0
    assert abort.value.code == 0x08000022


def test_acyclic_and_event_driven_tpdos() -> None:
    rig = Rig(machine(noise=False))
    configure(rig, 0x1800, 0x1A00, 0x181, 0, [0x60FD0020])
    configure(rig, 0x1801, 0x1A01, 0x281, 255, [0x60FD0020])
    configure(rig, 0x1802, 0x1A02, 0x381, 255, [0x60640020])
    rig.write(0x1802, 5, 50, 2)
    rig.nmt(0x01)
    rig.drive.wall_clock(1.0)
    assert ids(rig.sync()) == [0x181]  # first values; the two event-driven ones went out with the clock
    assert ids(rig.sync()) == []
    rig.drive.feedback.digital_inputs = 1 << 16
    assert ids(rig.sync()) == [0x181, 0x281]
    assert ids(rig.drive.wall_clock(1.049)) == []
    assert 0x381 in ids(rig.drive.wall_clock(1.051))


def test_inhibit_time_holds_events_back() -> None:
    rig = Rig()
    rig.write(0x1801, 1, 0xC0000281, 4)
    rig.write(0x1801, 2, 254, 1)
    rig.write(0x1801, 3, 100, 2)  # 10 ms
    rig.write(0x1801, 1, 0x40000281, 4)
    rig.write(0x1017, 0, 0, 2)
    rig.nmt(0x01)
    assert ids(rig.drive.wall_clock(1.0)) == [0x281]
    rig.drive.trip(0xFF01)
    assert 0x281 not in ids(rig.drive.wall_clock(1.005))
    assert 0x281 in ids(rig.drive.wall_clock(1.011))


def test_sync_start_value_delays_the_first() -> None:
    rig = Rig()
    rig.write(0x1019, 0, 240, 1)
    for n in (0, 1):
        rig.write(0x1800 + n, 1, 0xC0000181 + 0x100 * n, 4)
    rig.write(0x1802, 1, 0xC0000381, 4)
    rig.write(0x1802, 2, 3, 1)
    rig.write(0x1802, 6, 5, 1)
    rig.write(0x1802, 1, 0x40000381, 4)
    rig.nmt(0x01)
    sent = [counter for counter in range(1, 21) if 0x381 in ids(rig.sync(bytes([counter])))]
    assert sent == [7, 10, 13, 16, 19]


def test_rpdo_values_out_of_range_are_not_taken() -> None:
    rig = Rig()
    configure(rig, 0x1403, 0x1603, 0x501, 255, [0x60600008])
    rig.nmt(0x01)
    rig.send(0x501, bytes([8]))
    rig.send(0x501, bytes([7]))
    assert rig.read(0x6060) == 8 == rig.read(0x6061)


def test_dropped_tpdos_and_a_mapping_changed_behind_our_back() -> None:
    rig = Rig()
    rig.nmt(0x01)
    rig.drive.faults.drop_tpdo[1] = 2
    assert [0x181 in ids(rig.sync()) for _ in range(4)] == [False, False, True, True]
    rig.drive.faults.drop_tpdo[2] = -1
    assert ids(rig.sync()) == [0x181]
    rig.drive.remap(0x1A00, [(0x606C, 0, 32), (0x6064, 0, 32)])
    rig.drive.faults.signal("position").offset = 1000
    _, position = struct.unpack("<ii", dict(rig.sync())[0x181])
    assert position == 1000
    assert rig.read(0x1A00, 1) == 0x606C0020


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=40)
@given(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1), st.integers(0, 2**16 - 1))
def test_the_codec_is_that_of_the_library(position: int, torque: int, word: int) -> None:
    RIG.nmt(0x80)
    node, bus = direct(RIG.drive)
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
        bus.deliver(RIG.sync())
    assert RIG.drive.dictionary.number(0x60B1) == position
    assert RIG.drive.dictionary.number(0x607A) == position
    assert RIG.drive.dictionary.number(0x60B2) == torque
    for entry in (*node.tpdo[1], *node.tpdo[2], *node.tpdo[3], *node.tpdo[4]):
        assert entry.raw == RIG.drive.dictionary.number(entry.index, entry.subindex)


RIG = Rig()
RIG.write(0x1402, 1, 0x401, 4)


def test_the_library_remaps_and_reads_back() -> None:
    rig = Rig()
    node, _ = direct(rig.drive)
    node.tpdo.read()
    pdo = node.tpdo[4]
    pdo.clear()
    pdo.add_variable(0x60F4)
    pdo.add_variable(0x6041)
    pdo.trans_type = 5
    pdo.save()
    assert rig.read(0x1A03, 0) == 2
    assert rig.read(0x1A03, 1) == 0x60F40020
    assert rig.read(0x1803, 2) == 5
    rig.nmt(0x01)
    frames = [dict(rig.sync()) for _ in range(5)]
    assert len(frames[4][0x481]) == 6


def test_the_ready_entry_shows_the_live_mapping() -> None:
    rig = Rig()
    entry = mapping(rig.drive)
    assert entry["node_id"] == 1
    assert entry["increments_per_mm"] == pytest.approx(3276.8)
    assert entry["sync_counter"] == 0
    assert [pdo["cob_id"] for pdo in entry["tpdo"]] == [0x181, 0x281, 0x381, 0x481]
    assert [pdo["cob_id"] for pdo in entry["rpdo"]] == [0x201, 0x301]  # the third is not valid
    assert entry["tpdo"][0]["entries"][0] == [0x6064, 0, 32, "mm", pytest.approx(20 / 65536)]
    assert entry["tpdo"][1]["entries"][2] == [0x2101, 0, 16, "V", 0.02]
    assert entry["tpdo"][1]["entries"][1] == [0x6078, 0, 16, "A", pytest.approx(0.05)]


def test_the_default_mapping_of_two_axes_fits_the_bus() -> None:
    drives = [Rig(machine("XY"), axis).drive for axis in "XY"]
    load = sum(bus_load(drive, 1000) for drive in drives) + frame_bits(1) * 1000 / 1e6
    assert 0.8 < load < 0.9
    assert bus_load(drives[0], 1000, stuffed=True) == pytest.approx(0.487, abs=0.01)


def test_a_position_offset_and_a_feed_forward_never_load_the_bus_together() -> None:
    """With a valid RPDO of speed and torque the larger correction counts: 6 bytes instead of 4."""
    drive = Rig(machine("X")).drive
    alone, alone_worst = bus_load(drive, 1000), bus_load(drive, 1000, stuffed=True)
    drive.set_object(0x1402, 1, 0x401)
    assert len(list(drive.pdo.configured("rpdo"))) == 3
    assert bus_load(drive, 1000) - alone == pytest.approx((frame_bits(6) - frame_bits(4)) * 1e-3)
    worst = (frame_bits(6, stuffed=True) - frame_bits(4, stuffed=True)) * 1e-3
    assert bus_load(drive, 1000, stuffed=True) - alone_worst == pytest.approx(worst)
    drive.set_object(0x1401, 1, 0x80000301)
    assert bus_load(drive, 1000) - alone == pytest.approx((frame_bits(6) - frame_bits(4)) * 1e-3)
