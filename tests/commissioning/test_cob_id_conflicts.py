"""A drive whose PDO has another node's COB-ID is refused before a frame is sent."""

from __future__ import annotations

import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest

from fdhil import config as machine_config
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.commissioning.cob_id_conflicts import POINT, find_conflict
from fdhil.commissioning.commissioning_record import CommissioningRecord, save_record
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.commissioning.drive_survey import survey_drive
from fdhil.commissioning.master import Master
from fdhil.commissioning.pdo_setup import set_up_pdos
from fdhil.commissioning.record_comparison import verify_commissioned_drives
from fdhil.config import MachineConfig
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.errors import ConfigError, DriveFault
from tests.bench import bench_document
from tests.drivers.cia402.eds_text import COMMON, CURRENT, OFFSETS, U8, Variable, build_pdo_objects, format_eds
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer

pytestmark = pytest.mark.usefixtures("fast_commissioning")
RECORD = CommissioningRecord(
    "X", 1, 2, 3, 4, "c0ffee", "f1f2", {}, 1e4, True, 9.8, True, "proven", "2026-01-01T00:00:00+00:00"
)
MAPPED = {
    0x1600: (0x60400010, 0x607A0020),
    0x1601: (0x60B00020,),
    0x1A00: (0x60640020, 0x606C0020),
    0x1A01: (0x60410010, 0x60780010),
    0x1A02: (0x60620020, 0x60B00020),
    0x1A03: (0x60610008,),
}


def write_dcf_of_node_5(folder: Path, offset_rpdo: int) -> Path:
    """Write a DCF of node 5 with a fixed mapping and absolute COB-IDs; RPDO2 carries the offset."""
    variables: list[Variable] = [*COMMON, *OFFSETS, *CURRENT, *build_pdo_objects(4, 2, "ro", MAPPED)]
    lines = ["[DeviceComissioning]", "NodeID=5"]
    for line in format_eds(
        [(*each[:5], 1) if each[2] == U8 and each[1] == 2 else each for each in variables]
    ).splitlines():
        lines.append(line)
        if line.startswith("DefaultValue=$NODEID+"):
            absolute = int(line.partition("+")[2], 16) + 5
            lines.append(f"ParameterValue={offset_rpdo if absolute == 0x305 else absolute:#x}")
    path = folder / "node5.dcf"
    path.write_text("\n".join(lines))
    return path


def build_config(folder: Path, offset_rpdo: int, axes: str = "X", **second: Any) -> MachineConfig:
    document = bench_document(axes)
    eds = str(write_dcf_of_node_5(folder, offset_rpdo))
    document["axis"]["X"]["drive"] = {**document["axis"]["X"].get("drive", {}), "profile": "cia402", "eds": eds}
    document["axis"]["X"]["drive"]["node_id"] = 5
    for axis in axes[1:]:
        document["axis"][axis].setdefault("drive", {}).update(second)
    return machine_config.parse_config(document, folder=folder)


def test_guard_sends_cob_ids_of_dcf(tmp_path: Path) -> None:
    [axis] = make_guard_settings(build_config(tmp_path, 0x305), "can0", tmp_path, "").axes
    assert (axis.offset.cob_id, axis.target.cob_id) == (0x305, 0x205)
    assert [pdo.cob_id for pdo in axis.tpdos] == [0x185, 0x285, 0x385, 0x485]


@pytest.mark.parametrize(
    ("offset_rpdo", "whose"),
    [
        (0x309, "RPDO2 of axis Y"),
        (0x409, "RPDO3 of axis Y"),
        (0x189, "TPDO1 of axis Y"),
        (0x205, "its own RPDO"),
        (0x700 + 100, "heartbeat of node-ID 100"),
        (0x605, "SDO of node-ID 5"),
        (0x589, "SDO of node-ID 9"),
        (0x085, "EMCY of node-ID 5"),
        (0x080, "SYNC"),
        (0x100, "TIME"),
    ],
)
def test_guard_with_cob_id_in_use_is_refused(offset_rpdo: int, whose: str, tmp_path: Path) -> None:
    config = build_config(tmp_path, offset_rpdo, "XY", node_id=9)
    with pytest.raises(
        ConfigError, match=f"COB-ID {offset_rpdo:03X}, with which the guard sends offsets, also belongs to {whose}"
    ):
        make_guard_settings(config, "can0", tmp_path, "")


def test_cob_id_of_received_node_is_in_use(tmp_path: Path) -> None:
    config = build_config(tmp_path, 0x309)
    assert find_conflict(config, "X") is None
    for received in (0x709, 0x089, 0x589, 0x189):
        clash = find_conflict(config, "X", [0x185, 0x705, received])
        assert clash is not None, hex(received)
        assert (
            clash.cause
            == "its RPDO2 has the COB-ID 309, which belongs to RPDO2 of node-ID 9, which was received on the bus"
        )
    assert find_conflict(config, "X", [0x609, 0x309 | 0x80000000, 0x18A]) is None


def test_axes_of_one_device_have_distinct_cob_ids() -> None:
    document = bench_document("XYZ")
    for axis, logical, node in (("X", 1, 1), ("Y", 2, 1), ("Z", 1, 3)):
        document["axis"][axis]["drive"] = {"node_id": node, "logical_axis": logical}
    config = machine_config.parse_config(document)
    assert [find_conflict(config, axis) for axis in "XYZ"] == [None] * 3


def test_nothing_is_sent_to_drive_with_conflicting_cob_id(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that is not configured uses 0x301: its heartbeat is received while the drive is off."""
    settings = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"})
    plain = load_profile(settings.axis["X"].drive)
    moved = replace(plain, rpdos=(plain.rpdos[0], replace(plain.rpdos[1], cob_base=0x308)))
    monkeypatch.setattr("fdhil.commissioning.cob_id_conflicts.load_profile", lambda _drive: moved)
    with DrivePeer(settings) as drive, Master(settings, "X") as master:
        master.receive_frame(0x709, b"\x05")
        points = {each.point: each for each in survey_drive(master).findings}
        assert points[POINT].ok is False
        drive.heard.clear()
        with pytest.raises(DriveFault, match="its RPDO2 has the COB-ID 309, which belongs to RPDO2 of node-ID 9"):
            set_up_pdos(master)
        assert drive.heard == []


def test_commissioning_is_refused_on_cob_id_conflict(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = build_machine_config(
        axes="XY", bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"}
    )
    profile = load_profile(settings.axis["X"].drive)
    elsewhere = replace(profile, rpdos=(replace(profile.rpdos[0], cob_base=0x201), *profile.rpdos[1:]))
    monkeypatch.setattr("fdhil.commissioning.master.load_profile", lambda _drive: elsewhere)
    monkeypatch.setattr("fdhil.commissioning.cob_id_conflicts.load_profile", lambda _drive: elsewhere)
    with (
        DrivePeer(settings) as drive,
        pytest.raises(DriveFault, match="its RPDO1 has the COB-ID 202, which belongs to"),
    ):
        commission_axis(settings, "X")
    assert drive.heard == []


def test_guard_does_not_start_on_cob_id_conflict(tmp_path: Path) -> None:
    document = bench_document("X")
    channel = uuid.uuid4().hex
    document["bus"] = {"can0": {"interface": "virtual", "channel": channel}}
    document["axis"]["X"]["drive"] = build_config(tmp_path, 0x309).axis["X"].drive.model_dump(exclude_unset=True)
    config = machine_config.parse_config(document, folder=tmp_path)
    save_record(RECORD, config.store.directory)
    with can.Bus(interface="virtual", channel=channel) as bus, pytest.MonkeyPatch.context() as patch:
        received = can.Message(arbitration_id=0x709, data=b"\x05", is_extended_id=False)
        sender = bus.send_periodic(received, 0.02)
        patch.setattr("fdhil.commissioning.record_comparison.LISTEN_S", 0.3)
        with pytest.raises(ConfigError, match="RPDO2 of node-ID 9, which was received on the bus"):
            verify_commissioned_drives(config, "can0", lambda _text: None)
        sender.stop()
