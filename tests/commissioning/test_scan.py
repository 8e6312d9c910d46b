"""Scan results from traffic, answers and EDS files, and check results of a drive that is not set up."""

from __future__ import annotations

import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import can
import pytest

from fdhil.commissioning.commissioning_steps import check_axis
from fdhil.commissioning.config_check import check_machine, compare_by_traffic
from fdhil.commissioning.drive_survey import DeviceIdentity, compare_identity
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.master import Master
from fdhil.commissioning.scan import (
    BusScanner,
    DeviceDescription,
    EdsMatch,
    read_descriptions,
    replace_unprintable,
    scan_bus,
)
from fdhil.commissioning.traffic_listener import BusTraffic
from fdhil.config import Drive, MachineConfig
from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, pack_frames
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.errors import ConnectError, DriveFault, ForeignMaster
from fdhil.sim.drive.object_dictionary import AbortCode, TransferAbort
from tests.drivers.frame_builder import FrameBuilder, Row, build_machine_config
from tests.drivers.peer import DrivePeer
from tests.short_waits import shorten_waits
from tests.virtual_threads import VirtualThreads

WHO = DeviceIdentity(1, 2, 3, 4)


@pytest.fixture(autouse=True)
def fast_scan(virtual_threads: object, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_waits(monkeypatch)


@pytest.fixture
def peer() -> Iterator[tuple[DrivePeer, MachineConfig]]:
    settings = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with DrivePeer(settings) as running:
        yield running, settings


def build_traffic(*rows: Row) -> BusTraffic:
    received = BusTraffic()
    received.add_frames(pack_frames(rows))
    return received


@pytest.mark.parametrize(
    ("can_id", "data", "master"),
    [
        (0x080, b"", "SYNC"),
        (0x000, b"\x01\x00", "NMT commands"),
        (0x205, bytes(6), "set-points"),
        (0x509, bytes(8), "set-points"),
        (0x601, bytes(8), "SDO requests"),
        (0x7E5, bytes(8), "LSS commands"),
        (0x701 | REMOTE_FLAG, b"", "node guarding"),
        (0x181 | REMOTE_FLAG, b"", "requests for PDOs"),
        (0x701 | REMOTE_FLAG | EXTENDED_FLAG, b"", None),
        (0x701, b"\x05", None),
        (0x181, bytes(8), None),
        (0x581, bytes(8), None),
        (0x081, bytes(8), None),
        (0x205 | EXTENDED_FLAG, bytes(6), None),
        (0x200 | ERROR_FLAG, bytes(8), None),
    ],
)
def test_master_is_recognised_by_its_frames(can_id: int, data: bytes, master: str | None) -> None:
    assert build_traffic((0, can_id, data)).master == master


def test_nodes_states_and_heartbeats_are_listed() -> None:
    beats = [(int(k * 5e8), 0x703, bytes([0x7F])) for k in range(4)]
    received = build_traffic(*beats, (0, 0x182, bytes(8)), (0, 0x085, b"\x11\x86" + bytes(6)), (0, 0x707, b"\x33"))
    assert received.sending_nodes == {2, 3, 5, 7}
    assert (received.decode_nmt_state(3), received.decode_nmt_state(2), received.decode_nmt_state(7)) == (
        "pre-operational",
        None,
        "unknown (33)",
    )
    assert received.measure_heartbeat_s(3) == pytest.approx(0.5)
    assert received.measure_heartbeat_s(7) is None
    assert received.emergencies == {5: {0x8611}}


def test_single_late_sync_does_not_change_period() -> None:
    stamps = [k * 1_000_000 + (9_000_000 if k == 20 else 0) for k in range(21)]
    assert build_traffic(*((t, 0x80, b"") for t in stamps)).sync_period_s == pytest.approx(1e-3)
    assert build_traffic(*((t, 0x703, b"\x7f") for t in stamps)).measure_heartbeat_s(3) == pytest.approx(1e-3)


def test_node_appearing_during_listing_causes_no_error(
    virtual_threads: VirtualThreads, request: pytest.FixtureRequest
) -> None:
    virtual_threads.release_all()
    request.addfinalizer(partial(sys.setswitchinterval, sys.getswitchinterval()))
    sys.setswitchinterval(1e-6)  # threads switch as often as possible
    ids = range(0x181, 0x1FF)
    for _ in range(30):
        received = BusTraffic()
        coming = threading.Thread(
            target=received.add_frames, args=(pack_frames([(0, can_id, bytes(8)) for can_id in ids]),)
        )
        coming.start()
        while coming.is_alive():
            assert len(received.sending_nodes) <= len(ids)
        coming.join()
        assert len(received.sending_nodes) == len(ids)
    assert build_traffic((0, 0x80, b"")).sync_period_s is None


@pytest.mark.parametrize(
    ("found", "fit"),
    [
        ((1, 2, 3), "exact"),
        ((1, 2, None), "exact"),
        ((1, 2, 9), "other revision"),
        ((1, 9, 3), None),
        ((9, 2, 3), None),
        ((None, None, None), None),
        ((1, None, 3), "any product"),
        ((1, 0, None), "any product"),
        ((1, 0xFFFFFFFF, 0xFFFFFFFF), "any product"),
        ((1, 2, 0xFFFFFFFF), "exact"),
        ((9, None, None), None),
    ],
)
def test_eds_matches_by_vendor_product_and_revision(found: tuple[int | None, ...], fit: str | None) -> None:
    assert DeviceDescription(Path("drive.eds"), *found).match_identity(WHO) == fit


def test_node_without_identity_matches_no_eds() -> None:
    assert DeviceDescription(Path("drive.eds"), 0, None, None).match_identity(DeviceIdentity(0, 0, 0, 0)) is None


def test_eds_files_are_read_and_others_ignored(tmp_path: Path) -> None:
    text = "[DeviceInfo]\nVendorNumber=0x1\nProductNumber=2\nRevisionNumber=3\n[1000]\nParameterName=Type\nDataType=7\n"
    (tmp_path / "good.eds").write_text(text)
    (tmp_path / "bad.dcf").write_text("nothing")
    (tmp_path / "readme.txt").write_text("nothing")
    found, faults = read_descriptions([tmp_path])
    assert [(d.path.name, d.match_identity(WHO)) for d in found] == [("good.eds", "exact")]
    text = f"{tmp_path}/bad.dcf: line 1: it has no object; this is not an EDS file"
    assert [str(fault) for fault in faults] == [text]


@pytest.mark.parametrize("text", [b"\x1b]0;owned\x07", b"a\rb\nc", b"\xff\xfe", b"x" * 500])
@pytest.mark.fault("G12")
def test_drive_text_cannot_control_terminal(text: bytes) -> None:
    assert replace_unprintable(text).isprintable()
    assert len(replace_unprintable(text)) <= 80


def test_node_without_optional_objects_is_listed(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, settings = peer
    exact = DeviceDescription(Path("b.eds"), 0x46444849, 0x402, 0x10000)
    other = DeviceDescription(Path("a.eds"), 0x46444849, 0x402, 7)
    vendors = DeviceDescription(Path("0.eds"), 0x46444849, 0xFFFFFFFF, 7)
    found = scan_bus("can0", settings, [vendors, other, exact])
    assert [(node.node_id, node.axis) for node in found.nodes] == [(1, "X")]
    answers = found.nodes[0].answers
    assert answers is not None
    assert answers.eds == EdsMatch("b.eds", "exact")
    assert answers.is_drive
    with BusScanner("can0", settings.bus["can0"]) as bus:
        assert bus.read_object(1, 0x5FFF) is None
        monkeypatch.setattr("fdhil.drivers.can.sdo_channel.RESPONSE_TIMEOUT_S", 0.01)  # receives nothing
        assert bus.read_object(9, 0x1000) is None


def test_nothing_is_sent_when_master_is_detected(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    with (
        can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as nc,
        BusScanner("can0", settings.bus["can0"]) as bus,
    ):
        nc.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        while bus.traffic.master is None:
            bus.listen_for(0.1)
        with pytest.raises(ForeignMaster, match=r"an NC is sending SYNC .* nothing more was sent"):
            bus.find_answering_nodes()
        with pytest.raises(ForeignMaster, match="start again"):
            bus.read_object(1, 0x1000)
    while not drive.heard:
        time.sleep(0.01)
    assert drive.heard == [0x80]


def test_silent_bus_is_reported() -> None:
    settings = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with pytest.raises(ConnectError, match="no node sent a frame and none answered"):
        scan_bus("can0", settings, [])


DIFFERENT: dict[str, tuple[Callable[[DrivePeer], None], str]] = {
    "heartbeat": (lambda p: p.drive.overwrite_object(0x1017, 0, 0), "none"),
    "TPDO1": (lambda p: p.drive.overwrite_object(0x1800, 2, 255), "181, type 255: 60640020, 606C0020"),
    "communication lost": (lambda p: p.drive.overwrite_object(0x6007, 0, 0), "0x6007 = 0"),
    "following error": (lambda p: p.drive.overwrite_object(0x6065, 0, 0), "off"),
    "mode": (lambda p: p.drive.overwrite_object(0x6502, 0, 1), "0x6502 = 00000001"),
}


@pytest.mark.parametrize("point", DIFFERENT)
def test_missing_setup_is_the_only_difference(point: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    spoil, shown = DIFFERENT[point]
    spoil(drive)
    wrong = [finding for _, finding in check_machine(settings) if not finding.ok]
    assert [(finding.point, finding.found) for finding in wrong] == [(point, shown)]
    assert wrong[0].cause
    assert wrong[0].advice
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive.heard)


def remove_objects(drive: DrivePeer, *indices: int) -> None:
    for index in indices:
        for key in [key for key in drive.drive.dictionary.entries if key >> 8 == index]:
            del drive.drive.dictionary.entries[key]


LACKING = {
    "mode": (0x6502,),
    "cycle": (0x60C2,),
    "communication lost": (0x6007,),
    "stop by a ramp": (0x605A, 0x605E),
    "following error": (0x6065,),
}


@pytest.mark.parametrize("point", LACKING)
def test_missing_objects_are_not_compared(point: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    remove_objects(drive, *LACKING[point])
    (finding,) = [finding for _, finding in check_machine(settings) if not finding.ok]
    shown = " and ".join(f"0x{index:04X}" for index in LACKING[point])
    assert (finding.point, finding.ok, finding.found) == (point, None, f"no {shown}")
    assert finding.cause == f"it has no {shown} that can be read"


@pytest.mark.parametrize("code", [AbortCode.NO_DATA, AbortCode.DEVICE_STATE, AbortCode.READ_WRITE_ONLY])
def test_refused_object_does_not_end_check(code: AbortCode, peer: tuple[DrivePeer, MachineConfig]) -> None:
    """Some drives have objects without a value, and one refusal must not hide everything else."""
    drive, settings = peer

    def refuse_read() -> int:
        raise TransferAbort(code)

    for key in (0x100000, 0x101804, 0x600700, 0x607D01):
        if key in drive.drive.dictionary.entries:
            drive.drive.dictionary.read_hooks[key] = refuse_read
    remove_objects(drive, 0x67FF)
    found = {finding.point: finding for _, finding in check_machine(settings)}
    assert {point for point, finding in found.items() if not finding.ok} == {"device", "communication lost"}
    assert found["device"].ok is found["communication lost"].ok is None
    assert (found["TPDO1"].ok, found["following error"].ok) == (True, True)


def test_drive_without_identity_is_not_compared_with_vendor_profile() -> None:
    profile = replace(load_profile(Drive()), vendor_id=0xFB)
    reported = {vendor: compare_identity(profile, DeviceIdentity(vendor, 2, 3, 4)).ok for vendor in (0xFB, 0xFC, 0)}
    assert reported == {0xFB: True, 0xFC: False, 0: None}


def test_coasting_drive_is_reported_although_other_object_is_missing(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    remove_objects(drive, 0x605A)
    drive.drive.overwrite_object(0x605E, 0, 0)
    (finding,) = [finding for _, finding in check_machine(settings) if not finding.ok]
    assert (finding.ok, finding.found) == (False, "0x605A = missing, 0x605E = 0")


def test_drive_without_following_error_window_is_not_commissioned(peer: tuple[DrivePeer, MachineConfig]) -> None:
    """Nothing would stop it when it leaves its path, and offsets could not be compared with the window."""
    drive, settings = peer
    remove_objects(drive, 0x6065)
    with (
        Master(settings, "X") as master,
        pytest.raises(DriveFault, match=r"it has no 0x6065 that can be read; see its manual"),
    ):
        check_axis(master)


def test_device_that_is_not_a_drive_is_reported(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    remove_objects(drive, 0x67FF)
    drive.drive.overwrite_object(0x1000, 0, 0x00030191)
    found = {finding.point: finding for place, finding in check_machine(settings) if place == "axis X"}
    assert {point for point, finding in found.items() if finding.ok is False} == {"device"}
    assert found["device"].cause == "it is not a CiA 402 drive: 0x1000 reports CiA 401, an I/O module"
    assert found["cycle"].ok is None
    with Master(settings, "X") as master, pytest.raises(DriveFault, match="it is not a CiA 402 drive"):
        check_axis(master)


@pytest.mark.parametrize(
    ("device_type", "first", "ok"), [(0x192, None, True), (0xFFFF0191, 0x20192, True), (0, 0, None)]
)
def test_drive_is_recognised_by_own_or_first_device_type(
    device_type: int, first: int | None, ok: bool | None, peer: tuple[DrivePeer, MachineConfig]
) -> None:
    drive, settings = peer
    remove_objects(drive, 0x67FF)
    if first is not None:
        own = drive.drive.dictionary.entries[0x100000]
        drive.drive.dictionary.entries[0x67FF00] = replace(own, index=0x67FF)
        drive.drive.overwrite_object(0x67FF, 0, first)
    drive.drive.overwrite_object(0x1000, 0, device_type)
    (finding,) = [finding for _, finding in check_machine(settings) if finding.point == "device"]
    assert finding.ok is ok


def test_nothing_is_sent_on_bus_with_other_bit_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    for where in ("scan", "config_check"):
        monkeypatch.setattr(f"fdhil.commissioning.{where}.LISTEN_S", 2.0)
    settings = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as loud:
        stop = threading.Event()

        def send_error_frames() -> None:
            while not stop.wait(0.01):
                loud.send(can.Message(arbitration_id=0x4, data=bytes(8), is_error_frame=True))

        thread = threading.Thread(target=send_error_frames)
        thread.start()
        try:
            for ask in (lambda: scan_bus("can0", settings, []), lambda: check_machine(settings)):
                with pytest.raises(
                    ConnectError,
                    match="only error frames are received, so the bit rate is probably wrong; nothing was sent",
                ):
                    ask()
        finally:
            stop.set()
            thread.join()
        assert loud.recv(0) is None


def listen_to_nc(config: MachineConfig, wire: FrameBuilder, *more: Row) -> dict[str, Finding]:
    return {
        finding.point: finding for finding in compare_by_traffic(build_traffic(*wire.build_rows(), *more), config, "X")
    }


def test_traffic_of_nc_is_compared() -> None:
    found = listen_to_nc(build_machine_config(), FrameBuilder(400), *((int(k * 1e8), 0x701, b"\x05") for k in range(4)))
    assert {point for point, finding in found.items() if finding.ok} == {
        "drive", "heartbeat", "identifiers", "offset writers",
        "TPDO1", "TPDO2", "TPDO3", "TPDO4", "RPDO1", "rapid signal",
    }  # fmt: skip
    assert not [point for point, finding in found.items() if finding.ok is False]


def test_drive_on_other_node_id_is_reported() -> None:
    found = listen_to_nc(build_machine_config(), FrameBuilder(400, node_id=5))
    assert found["drive"].ok is False
    assert found["TPDO1"].cause == "TPDO1 (181) was received 0 times in 400 SYNC, 400 are due"


@pytest.mark.parametrize(("bit", "state"), [(16, "on now"), (3, "off now")])
def test_rapid_signal_is_reported(bit: int, state: str) -> None:
    config = build_machine_config(g0={"source": "digital_input", "input_bit": bit})
    assert listen_to_nc(config, FrameBuilder(400))["rapid signal"].found == state
