"""CANopen services of the drive, with the `canopen` library as foreign master: LSS, guarding, blocks, RTR, boot."""

from __future__ import annotations

import binascii
import socket
import struct
from typing import Any

import can
import canopen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.config import parse_config
from fdhil.sim.drive.drive_objects import compute_serial_number
from fdhil.sim.drive.object_dictionary import AbortCode, DataType, ObjectDictionary, create_var
from fdhil.sim.drive.sdo_server import SdoServer
from fdhil.sim.wire.can_buses import SocketCanBus
from tests.bench import bench_document
from tests.sim.canopen_peer import connect_directly, connect_over_virtual_bus
from tests.sim.drive_rig import Abort, DriveRig, build_machine_config, list_emergency_codes
from tests.sim.test_sdo_server import build_header, read_abort_code

SERIALS = tuple(compute_serial_number(build_machine_config("XY"), axis) for axis in "XY")
IDENTITY = (0x46444849, 0x0402, 0x00010000, SERIALS[0])


# -- block download


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=25)
@given(st.binary(min_size=1, max_size=3000), st.booleans())
def test_library_block_download_writes_object(content: bytes, crc: bool) -> None:
    rig = DriveRig()
    node, _ = connect_directly(rig.drive)
    size = len(content)
    with node.sdo.open(0x2122, 0, "wb", size=size, block_transfer=True, request_crc_support=crc) as stream:
        stream.write(content)
    assert rig.drive.dictionary.texts[0x212200] == content
    assert node.sdo.upload(0x2122, 0) == content


def test_number_in_block_download_is_checked() -> None:
    node, _ = connect_directly(DriveRig().drive)
    with node.sdo.open(0x6083, 0, "wb", size=4, block_transfer=True) as stream:
        stream.write((4711).to_bytes(4, "little"))
    assert node.sdo[0x6083].raw == 4711
    with (
        pytest.raises(canopen.SdoAbortedError) as abort,
        node.sdo.open(0x6041, 0, "wb", size=2, block_transfer=True),
    ):
        pass
    assert abort.value.code == 0x06010002


def create_server() -> SdoServer:
    return SdoServer(ObjectDictionary((create_var(0x2000, "Text", DataType.DOMAIN, "rw", b""),)))


def send_block(sdo: SdoServer, content: bytes, skip: int = 0) -> list[bytes]:
    """Send one block without the segment number ``skip``; return the answer."""
    parts = [content[n : n + 7].ljust(7, b"\0") for n in range(0, len(content), 7)]
    answers: list[bytes] = []
    for number, part in enumerate(parts, 1):
        if number != skip:
            answers += sdo.answer_request(bytes([number | (number == len(parts)) << 7]) + part)
    return answers


def test_lost_download_segment_is_requested_again() -> None:
    content, sdo = bytes(range(70)), create_server()
    (first,) = sdo.answer_request(build_header(0xC6, 0x2000) + (70).to_bytes(4, "little"))
    assert first == build_header(0xA4, 0x2000) + bytes([127, 0, 0, 0])
    assert send_block(sdo, content, skip=4) == [bytes([0xA2, 3, 127]) + bytes(5)]
    assert send_block(sdo, content[21:]) == [bytes([0xA2, 7, 127]) + bytes(5)]
    crc = binascii.crc_hqx(content, 0).to_bytes(2, "little")
    assert sdo.answer_request(b"\xc1" + crc + bytes(5)) == [b"\xa1" + bytes(7)]
    assert sdo.answer_request(build_header(0x40, 0x2000) + bytes(4))[0][4:] == (70).to_bytes(4, "little")


@pytest.mark.parametrize(
    ("end", "code"),
    [
        (b"\xc1\0\0" + bytes(5), AbortCode.CRC),
        (b"\xc5\0\0" + bytes(5), AbortCode.LENGTH),
        (b"\x80" + bytes(7), None),
    ],
)
def test_invalid_download_end_writes_nothing(end: bytes, code: AbortCode | None) -> None:
    sdo = create_server()
    sdo.answer_request(build_header(0xC6, 0x2000) + (14).to_bytes(4, "little"))
    assert len(send_block(sdo, bytes(range(14)))) == 1
    answers = sdo.answer_request(end)
    assert answers == [] if code is None else read_abort_code(answers) == code
    assert sdo.answer_request(build_header(0x40, 0x2000) + bytes(4))[0][4:] == bytes(4)


def test_client_lost_within_block_does_not_block_others() -> None:
    rig = DriveRig()
    rig.drive.run_timers(1.0)
    rig.request_sdo(build_header(0xC2, 0x2122) + (700).to_bytes(4, "little"))
    rig.drive.run_timers(1.9)
    assert rig.send_frame(0x601, bytes([0x40, 0, 0x10, 0]) + bytes(4)) == []
    rig.drive.run_timers(3.0)
    assert rig.read_object(0x1000) == 0x00020192


def test_download_too_long_or_out_of_order_is_aborted() -> None:
    sdo = create_server()
    assert (
        read_abort_code(sdo.answer_request(build_header(0xC2, 0x2000) + (1 << 20).to_bytes(4, "little")))
        == AbortCode.LENGTH
    )
    sdo.answer_request(build_header(0xC2, 0x2000) + (7).to_bytes(4, "little"))
    sdo.answer_request(b"\x01" + bytes(7))
    assert read_abort_code(sdo.answer_request(b"\x02" + bytes(7))) == AbortCode.LENGTH
    sdo.answer_request(build_header(0xC2, 0x2000) + (7).to_bytes(4, "little"))
    assert read_abort_code(sdo.answer_request(b"\x00" + bytes(7))) == AbortCode.SEQUENCE
    assert read_abort_code(sdo.answer_request(b"\xc1" + bytes(7))) == AbortCode.COMMAND


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=1200), st.lists(st.integers(1, 127), max_size=4))
def test_download_with_losses_is_complete(content: bytes, lost: list[int]) -> None:
    sdo, place = create_server(), 0
    sdo.answer_request(build_header(0xC0, 0x2000) + bytes(4))
    while place < len(content):
        skip = lost.pop() if lost else 0
        answers = send_block_of(sdo, content, place, skip)
        if not answers:
            return  # the last segment was lost: the client's time-out ends it
        place += 7 * answers[0][1]
    if content:
        sdo.answer_request(bytes([0xC1 | (-len(content) % 7) << 2]) + bytes(7))
        assert read_all(sdo) == content


def send_block_of(sdo: SdoServer, content: bytes, place: int, skip: int) -> list[bytes]:
    answers: list[bytes] = []
    for number in range(1, 128):
        start = place + 7 * (number - 1)
        last = start + 7 >= len(content)
        if number != skip:
            answers += sdo.answer_request(bytes([number | last << 7]) + content[start : start + 7].ljust(7, b"\0"))
        if last:
            break
    return answers


def read_all(sdo: SdoServer) -> bytes:
    (first,) = sdo.answer_request(build_header(0x40, 0x2000) + bytes(4))
    if first[0] & 2:
        return first[4 : 8 - (first[0] >> 2 & 3)]
    data, toggle = b"", 0
    while len(data) < int.from_bytes(first[4:], "little"):
        (answer,) = sdo.answer_request(bytes([0x60 | toggle << 4]) + bytes(7))
        data, toggle = data + answer[1 : 8 - (answer[0] >> 1 & 7)], toggle ^ 1
    return data


# -- LSS


class LssBus(can.BusABC):
    """A bus without a wire between the library's LSS master and some drives."""

    def __init__(self, *rigs: DriveRig) -> None:
        super().__init__("lss")
        self._is_shutdown = True
        self.network = canopen.Network(bus=self)
        self._rigs = rigs

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        for rig in self._rigs:
            for can_id, data in rig.send_frame(msg.arbitration_id, bytes(msg.data)):
                self.network.notify(can_id, bytearray(data), 0.0)


@pytest.fixture
def lss_master(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, DriveRig, DriveRig]:
    monkeypatch.setattr("canopen.lss.time.sleep", lambda _: None)  # no pauses needed
    first, second = DriveRig(build_machine_config("XY"), "X"), DriveRig(build_machine_config("XY"), "Y")
    master: Any = LssBus(first, second).network.lss
    master.RESPONSE_TIMEOUT = 0.001
    return master, first, second


def test_lss_sets_node_id_by_identity(lss_master: tuple[Any, DriveRig, DriveRig]) -> None:
    master, first, second = lss_master
    assert master.send_switch_state_selective(*IDENTITY) is True
    assert master.inquire_node_id() == 1
    assert [master.inquire_lss_address(0x5A + n) for n in range(4)] == list(IDENTITY)
    master.configure_node_id(17)
    master.configure_bit_timing(0)
    master.store_configuration()
    master.send_switch_state_global(master.WAITING_STATE)
    assert (first.drive.node_id, second.drive.node_id) == (1, 2)
    assert first.send_frame(0, b"\x82\x01") == [(0x711, b"\0")]
    first.node = 17
    assert first.read_object(0x1400, 1) == 0x211
    assert first.read_object(0x1014) == 0x91
    assert first.drive.run_timers(1.0) == [(0x711, b"\x7f")]
    first.drive.power_off()
    assert first.drive.power_on() == [(0x711, b"\0")]
    with pytest.raises(canopen.lss.LssError):
        master.inquire_node_id()  # all of them wait


def test_invalid_node_id_is_refused(lss_master: tuple[Any, DriveRig, DriveRig]) -> None:
    master, _, _ = lss_master
    master.send_switch_state_selective(*IDENTITY)
    with pytest.raises(canopen.lss.LssError, match="Error"):
        master.configure_node_id(200)
    with pytest.raises(canopen.lss.LssError, match="Error"):
        master.configure_bit_timing(5)


def test_fastscan_finds_unconfigured_nodes(lss_master: tuple[Any, DriveRig, DriveRig]) -> None:
    master, first, second = lss_master
    for rig, serial in zip((first, second), SERIALS, strict=True):
        assert master.send_switch_state_selective(*IDENTITY[:3], serial) is True
        master.configure_node_id(255)
        master.send_switch_state_global(master.WAITING_STATE)
        assert rig.send_nmt(0x81) == []  # it waits for an ID and says nothing
        assert rig.drive.run_timers(1.0) == []
        assert rig.send_frame(0x601, bytes([0x40, 0, 0x10, 0]) + bytes(4)) == []
    master.send_identify_non_configured_remote_slave()
    for node_id, expected in zip((30, 31), sorted((*IDENTITY[:3], serial) for serial in SERIALS), strict=True):
        found, identity = master.fast_scan()
        assert found
        assert tuple(identity) == expected
        master.configure_node_id(node_id)
        master.send_switch_state_global(master.WAITING_STATE)
        rig = first if expected == IDENTITY else second
        assert rig.drive.power_on() == [(0x700 + node_id, b"\0")]
    assert master.fast_scan() == (False, None)
    assert first.send_frame(0x7E5, bytes([0x46, *IDENTITY[0].to_bytes(4, "little"), 0, 0, 0])) == []


def test_lss_answers_remaining_services() -> None:
    rig = DriveRig()

    def request_lss(*data: int) -> list[bytes]:
        return [answer for can_id, answer in rig.send_frame(0x7E5, bytes(data).ljust(8, b"\0")) if can_id == 0x7E4]

    for place, number in enumerate((*IDENTITY[:2], 0x10000, 0x10000, SERIALS[0] - 1, SERIALS[0] + 1)):
        answers = request_lss(0x46 + place, *number.to_bytes(4, "little"))
    assert answers == [b"\x4f" + bytes(7)]
    assert request_lss(0x11, 5) == []  # it waits
    assert rig.send_frame(0x7E5, b"\x04\x01") == []  # too short
    rig.send_nmt(0x01)
    assert request_lss(0x04, 1) == request_lss(0x5E) == []  # not in operational


# -- node guarding


def test_guarding_toggles_and_timeout_is_lost_connection() -> None:
    rig = DriveRig()
    rig.write_object(0x1017, 0, 0, 2)
    rig.write_object(0x100C, 0, 100, 2)
    rig.write_object(0x100D, 0, 2, 1)
    rig.enable_drive()
    rig.drive.run_timers(1.0)
    assert rig.drive.run_timers(1.5) == []  # it begins with the first request
    assert rig.send_frame(0x701, b"") == [(0x701, b"\x05")]
    assert rig.send_frame(0x701, b"") == [(0x701, b"\x85")]
    assert rig.drive.run_timers(1.7) == []
    frames = rig.drive.run_timers(1.71)
    assert list_emergency_codes(frames) == [0x8130]
    assert rig.status & 0x4F == 0x0F
    rig.send_nmt(0x02)
    assert rig.send_frame(0x701, b"") == [(0x701, b"\x04")]  # the one answer in NMT stopped
    rig.send_nmt(0x81)
    assert rig.send_frame(0x701, b"") == [(0x701, b"\x7f")]


@pytest.mark.usefixtures("real_time")
def test_library_guards_node_over_bus() -> None:
    rig = DriveRig()
    with connect_over_virtual_bus(rig.drive) as node:
        node.nmt.start_node_guarding(0.01)
        assert node.nmt.wait_for_heartbeat(60) == "PRE-OPERATIONAL"
        node.nmt.stop_node_guarding()


# -- remote frames, NMT stopped, storage, boot


def test_tpdo_answers_remote_frame_if_bit_30_allows() -> None:
    rig = DriveRig()
    rig.write_object(0x1801, 1, 0xC0000281, 4)
    rig.write_object(0x1801, 1, 0x00000281, 4)
    assert rig.send_frame(0x281, b"") == []  # not yet operational
    rig.send_nmt(0x01)
    rig.send_sync()
    assert rig.send_frame(0x181, b"") == []
    ((can_id, data),) = rig.send_frame(0x281, b"")
    assert (can_id, len(data)) == (0x281, 6)


def test_kernel_remote_frames_have_no_data() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        ours.setblocking(False)
        attached = SocketCanBus.__new__(SocketCanBus)
        attached._socket = ours
        for can_id, length in ((0x701 | 1 << 30, 1), (0x123 | 1 << 29, 8), (0x601, 2)):
            theirs.send(struct.pack("=IB3x8s", can_id, length, b"\x05\x06" + bytes(6)))
        received: list[tuple[int, bytes]] = []
        attached.receive_frames([ours], received.append)
        assert received == [(0x701, b""), (0x601, b"\x05\x06")]  # the second was an error frame


def test_only_heartbeats_are_sent_in_nmt_stopped() -> None:
    rig = DriveRig()
    rig.write_object(0x1802, 2, 255, 1)
    rig.write_object(0x6065, 0, 10, 4)
    rig.enable_drive(mode=1)
    rig.send_nmt(0x02)
    rig.drive.trip_fault(0x3210)
    sent = [frame for n in range(100) for frame in (*rig.send_sync(), *rig.drive.run_timers(1 + n * 0.01))]
    sent += (
        rig.send_frame(0x601, bytes([0x40, 0, 0x10, 0]) + bytes(4))
        + rig.send_frame(0x201, bytes(6))
        + rig.send_frame(0x181, b"")
    )
    assert {can_id for can_id, _ in sent} == {0x701}
    rig.send_nmt(0x80)
    assert rig.read_object(0x1003) == 1
    assert list_emergency_codes(rig.send_sync()) == []  # in the history, but not sent late


def test_emergencies_respect_inhibit_time() -> None:
    rig = DriveRig()
    rig.write_object(0x1015, 0, 1000, 2)  # 100 ms
    rig.drive.run_timers(1.0)
    for code in (0x2310, 0x3210, 0x4310):
        rig.drive.trip_fault(code)
    reported = {}
    for n in range(100):
        now = 1.0 + n * 0.005
        reported.update(dict.fromkeys(list_emergency_codes(rig.drive.run_timers(now)), round(now, 3)))
    assert reported == {0x2310: 1.0, 0x3210: pytest.approx(1.1, abs=0.006), 0x4310: pytest.approx(1.2, abs=0.006)}


@pytest.mark.parametrize(("behaviour", "state"), [(0, 0x7F), (1, 0x05), (2, 0x04)])
def test_lost_heartbeat_changes_nmt_state_by_1029(behaviour: int, state: int) -> None:
    rig = DriveRig()
    rig.write_object(0x1029, 1, behaviour, 1)
    rig.write_object(0x1016, 1, 100 << 16 | 60, 4)
    rig.send_nmt(0x01)
    rig.drive.run_timers(1.0)
    rig.send_frame(0x764, b"\x05")
    assert list_emergency_codes(rig.drive.run_timers(1.1)) == [0x8130]
    assert rig.drive.nmt == state


def test_parameters_are_not_stored_while_current_flows() -> None:
    rig = DriveRig()
    rig.enable_drive()
    for index, word in ((0x1010, 0x65766173), (0x1011, 0x64616F6C)):
        with pytest.raises(Abort) as abort:
            rig.write_object(index, 1, word, 4)
        assert abort.value.code == 0x08000022
    rig.run_cycle(0, word=0x06)
    for _ in range(10):
        rig.run_cycle(0, word=0x06)
    rig.write_object(0x1010, 1, 0x65766173, 4)


def test_drive_is_silent_until_boot_up() -> None:
    rig = DriveRig(build_machine_config(boot_s=0.5))
    assert rig.boot == [(0x701, b"\0")]  # it was switched on before anybody listened
    rig.drive.run_timers(1.0)
    assert rig.send_nmt(0x81) == []
    assert rig.send_frame(0x601, bytes([0x40, 0, 0x10, 0]) + bytes(4)) == [] == rig.send_sync() == rig.send_nmt(0x01)
    assert rig.drive.run_timers(1.4999) == []
    assert rig.drive.run_timers(1.5) == [(0x701, b"\0"), (0x701, b"\x7f")]
    assert rig.read_object(0x1000) == 0x00020192
    rig.drive.power_off()
    assert rig.drive.power_on() == []
    assert rig.drive.run_timers(2.0)[0] == (0x701, b"\0")


def test_common_drive_objects_exist() -> None:
    rig = DriveRig()
    for index in (
        0x1006, 0x100C, 0x100D, 0x1012, 0x1013, 0x1014, 0x1015, 0x605D, 0x6067, 0x6068, 0x606D, 0x606E, 0x606F, 0x6070,
        0x6072, 0x6073, 0x6074, 0x607C, 0x607E, 0x607F, 0x6080, 0x6086, 0x6087, 0x6098, 0x609A, 0x60C5, 0x60C6, 0x60FF,
        0x6402, 0x67FF,
    ):  # fmt: skip
        rig.read_object(index)
    for index in (0x1029, 0x6099, 0x60FE):
        assert rig.read_object(index) >= 1
    assert rig.read_object(0x6502) == 0x3AD
    rig.drive.run_timers(2.5)
    assert rig.read_object(0x1013) == 2_500_000


def test_drives_of_two_machines_have_different_serial_numbers() -> None:
    """A commissioning record of another simulator's drive is invalid here."""
    machines = [parse_config(bench_document("XY") | {"machine": {"name": name}}) for name in "AB"]
    numbers = [compute_serial_number(machine, axis) for machine in machines for axis in "XY"]
    assert len(set(numbers)) == 4
    assert numbers == [compute_serial_number(machine, axis) for machine in machines for axis in "XY"]
