"""The simulated drive with a vendor's EDS: field variants of the file, and the resulting behaviour on the bus."""

from __future__ import annotations

import configparser
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fdhil import config
from fdhil.errors import EdsError
from fdhil.sim.drive.drive_objects import compute_serial_number
from fdhil.sim.drive.eds_file import EdsFile, read_eds_file
from fdhil.sim.drive.eds_writer import format_eds as own_eds_text
from fdhil.sim.drive.object_dictionary import DataType
from tests.bench import bench_document
from tests.eds import SHEETS, format_eds, write_eds
from tests.sim.bench_simulator import SteppedSimulator, build_corner_rows
from tests.sim.canopen_peer import connect_directly
from tests.sim.drive_rig import NO_NOISE, Abort, DriveRig, build_machine_config

RPM = 65536 / 60  # increments/s
NODE = 1


def create_emulated_drive(eds: Path, **axis: Any) -> config.MachineConfig:
    document = bench_document("X")
    document["axis"]["X"].update(axis)
    document["sim"] = {"axis": {"X": {"eds": str(eds)}}, "noise": NO_NOISE}
    return config.parse_config(document)


@pytest.fixture
def emulate(tmp_path: Path) -> Callable[[str], DriveRig]:
    return lambda sheet: DriveRig(create_emulated_drive(write_eds(sheet, tmp_path)))


@pytest.fixture
def epos4(emulate: Callable[[str], DriveRig]) -> DriveRig:
    return emulate("epos4")


def remap_pdo(rig: DriveRig, index: int, cob_id: int, kind: int, *mapped: int) -> None:
    """Configure a PDO like a master (CiA 301, 7.5.2.36): off, mapping, on."""
    rig.write_object(index, 1, cob_id | 1 << 31, 4)
    rig.write_object(index, 2, kind, 1)
    rig.write_object(index + 0x200, 0, 0, 1)
    for sub, word in enumerate(mapped, 1):
        rig.write_object(index + 0x200, sub, word, 4)
    rig.write_object(index + 0x200, 0, len(mapped), 1)
    rig.write_object(index, 1, cob_id, 4)


# -- the sheet


def read_eds_of(tmp_path: Path, text: str | bytes) -> EdsFile:
    path = tmp_path / "odd.eds"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_eds_file(path, 5)


def read_number(sheet: EdsFile, index: int, sub: int = 0) -> int | bytes:
    (entry,) = [e for item in sheet.objects for e in item.entries if (e.index, e.sub) == (index, sub)]
    return entry.default


VAR = "[{}]\nParameterName=x\nObjectType=7\nDataType={}\nAccessType=rw\nDefaultValue={}\n"


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        ("0x0007", "$NODEID+0x180", 0x185),
        ("7", "0x40000180+$NODEID", 0x40000185),
        ("0x7", "$NodeID", 5),
        ("0x0006", "001", 1),
        ("0x0006", "  # a comment", 0),
        ("0x0006", "0x07 # VAR", 7),
        ("0x0002", "0xfd", -3),
        ("0x0003", "-32768", -32768),
        ("0x0008", "0.5", 0x3F000000),
        ("0x0009", "Gold Drive", b"Gold Drive"),
        ("0x0007", "nonsense", 0),
        ("0x0007", "0x10L", 16),
    ],
)
def test_eds_defaults_in_field_notations_are_read(tmp_path: Path, kind: str, text: str, value: int | bytes) -> None:
    assert read_number(read_eds_of(tmp_path, VAR.format("2000", kind, text)), 0x2000) == value


def test_eds_in_windows_encoding_with_duplicate_section_and_key_is_read(tmp_path: Path) -> None:
    text = "\ufeff[DeviceInfo]\nVendorNumber=\nProductNumber=001\nProductName=“quoted”\n[Comments]\nLines=5\nLine1=a\n"
    text += VAR.format("6040", "6", "0") + "DataType=0x0006\n[6040]\nPDOMapping=1\n"
    sheet = read_eds_of(tmp_path, text.encode("utf-8"))
    assert (sheet.vendor, sheet.product, sheet.name) == (0, 1, "“quoted”")
    assert sheet.objects[0].entries[0].mappable
    assert read_eds_of(tmp_path, text[1:].encode("cp1252")) == sheet


def test_dcf_parameter_values_become_power_on_values(tmp_path: Path) -> None:
    sheet = read_eds_of(tmp_path, VAR.format("6065", "7", "2000") + "ParameterValue=500\n")
    assert read_number(sheet, 0x6065) == 500


def test_compact_array_has_all_its_sub_objects(tmp_path: Path) -> None:
    text = "[2010]\nParameterName=list\nObjectType=8\nDataType=6\nAccessType=ro\nDefaultValue=7\nCompactSubObj=3\n"
    sheet = read_eds_of(tmp_path, text + "[2010Value]\nNrOfEntries=1\n2=9\n")
    assert [entry.default for entry in sheet.objects[0].entries] == [3, 7, 9, 7]
    assert sheet.objects[0].entries[1].type is DataType.UNSIGNED16


@pytest.mark.parametrize("text", ["", "[FileInfo]\nFileName=x\n", "no sections at all", b"\xff\0\x01"])
def test_eds_without_objects_is_refused(tmp_path: Path, text: str | bytes) -> None:
    with pytest.raises(EdsError, match=r"odd.eds.*no object"):
        read_eds_of(tmp_path, text)


def test_missing_eds_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(EdsError, match="cannot be read"):
        read_eds_file(tmp_path / "none.eds", 1)


LINES = st.sampled_from([line for sheet in SHEETS for line in format_eds(sheet).splitlines() if line])
ODD = st.sampled_from(
    [
        "DataType=0x0009",
        "DataType=0x0008",
        "DefaultValue=",
        "DefaultValue=0xFFFFFFFFFF",
        "SubNumber=300",
        "ObjectType=2",
        "AccessType=",
        "LowLimit=5",
        "CompactSubObj=9",
        "[1018]",
        "[6040]",
        "[1A00sub1]",
        "[1A00sub0]",
        "[6064]",
        "[60C2]",
        "[1016sub1]",
        "[6502]",
        "[60A9]",
    ]
)


@pytest.mark.usefixtures("long_computation")
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(LINES | ODD, min_size=1, max_size=60), st.integers(0, 500))
def test_drive_runs_with_any_eds_or_refuses_it(tmp_path: Path, lines: list[str], place: int) -> None:
    """Otherwise the file is refused in one sentence."""
    whole = format_eds("nanotec").splitlines()
    path = tmp_path / "odd.eds"
    path.write_text("\n".join([*whole[:place], *lines, *whole[place:]]), encoding="utf-8")
    try:
        rig = DriveRig(create_emulated_drive(path))
    except EdsError:
        return
    rig.send_nmt(0x01)
    rig.send_sync()
    for index in (0x1000, 0x1018, 0x6040, 0x6064, 0x1A00):
        ((cob_id, data),) = rig.send_frame(0x601, bytes([0x40, index & 0xFF, index >> 8, 0, 0, 0, 0, 0]))
        assert (cob_id, len(data)) == (0x581, 8)  # the value, or an abort
    assert "[DeviceInfo]" in own_eds_text(rig.drive)


# -- what the wire sees


def test_identity_types_access_and_defaults_come_from_eds(epos4: DriveRig) -> None:
    assert [epos4.read_object(0x1018, sub) for sub in (1, 2, 3)] == [0xFB, 0x60500000, 0x01500000]
    assert epos4.read_object(0x1018, 4) == compute_serial_number(build_machine_config(), "X")
    assert epos4.read_object(0x605A) == 6
    assert epos4.read_object(0x6007) == 3
    assert epos4.read_object(0x1014) == 0x81
    assert epos4.read_object(0x1000) & 0xFFFF == 402
    with pytest.raises(Abort, match="06010002"):
        epos4.write_object(0x1014, 0, 0x82, 4)


@pytest.mark.parametrize("index", [0x6078, 0x6079, 0x6075, 0x608F, 0x1019, 0x1006, 0x2101, 0x6063])
def test_objects_missing_in_eds_do_not_exist(epos4: DriveRig, index: int) -> None:
    with pytest.raises(Abort, match="06020000"):
        epos4.read_object(index)
    with pytest.raises(Abort, match="06040041"):
        remap_pdo(epos4, 0x1800, 0x181, 1, index << 16 | 0x10)


def test_drive_has_only_pdos_of_its_eds(emulate: Callable[[str], DriveRig]) -> None:
    pdo = emulate("schunk").drive.pdo
    assert (list(pdo.list_numbers("rpdo")), list(pdo.list_numbers("tpdo"))) == ([1, 2], [1, 2, 3, 4])
    assert [p.number for p in pdo.list_configured("tpdo")] == [1, 2, 3]


def test_machine_specific_objects_are_preset(epos4: DriveRig) -> None:
    """The window in increments, the rated torque in uN.m, the interpolation period, ramps in rpm/s."""
    assert epos4.read_object(0x6065) == 32768
    assert epos4.read_object(0x6076) == pytest.approx(0.8 * 50 * 1e6)
    assert (epos4.read_object(0x60C2, 1), epos4.read_object(0x60C2, 2, signed=True)) == (1, -3)
    assert epos4.read_object(0x6081) == 1500
    assert epos4.read_object(0x6083) == 12000


def test_drive_without_heartbeat_default_sends_none(epos4: DriveRig) -> None:
    assert [frame for n in range(5) for frame in epos4.drive.run_timers(n * 0.3)] == []
    epos4.write_object(0x1017, 0, 100, 2)
    assert epos4.drive.run_timers(2.0) == [(0x701, b"\x7f")]


def test_default_mapping_comes_from_eds_and_can_be_changed(epos4: DriveRig) -> None:
    epos4.send_nmt(0x01)
    assert dict(epos4.send_sync()).keys() == {0x181}  # event-driven: the statusword, once
    assert epos4.send_sync() == []
    epos4.send_nmt(0x80)
    remap_pdo(epos4, 0x1802, 0x381, 1, 0x60640020, 0x30D10220)
    epos4.send_nmt(0x01)
    assert len(dict(epos4.send_sync())[0x381]) == 8
    epos4.send_nmt(0x80)
    epos4.write_object(0x1802, 1, 0x80000381, 4)
    with pytest.raises(Abort, match="06040042"):
        epos4.write_object(0x1A02, 0, 13, 1)


def test_vendor_objects_report_signals_in_vendor_units(epos4: DriveRig) -> None:
    """Speed in rpm, current in mA, the unsigned duty cycle, the supply in tenths of a volt."""
    epos4.enable_drive()
    drive = epos4.drive
    targets = [round(5.0 * n * 65536 / 1000) for n in range(400)]  # 5 revolutions/s
    for target in targets:
        epos4.send_frame(0x401, struct.pack("<Hi", 0x0F, target))
        duty = drive.physics.sensed.voltage_v / 300
        epos4.send_sync()
    shown = epos4.read_object(0x606C, signed=True)
    assert shown == pytest.approx(drive.dictionary.get_number(0x606C) / RPM, abs=0.5)
    assert 250 < shown < 350
    assert epos4.read_object(0x30D1, 2, signed=True) == epos4.read_object(0x30D1, 1, signed=True)
    assert epos4.read_object(0x30D1, 2, signed=True) == pytest.approx(1e3 * (5.0 + 0.05 * 31.4) / 0.8, rel=0.1)
    assert epos4.read_object(0x3203, 1) == round(1e3 * duty) > 50
    assert epos4.read_object(0x2200, 1) == 3000


def test_speed_offset_is_in_vendor_unit(epos4: DriveRig) -> None:
    remap_pdo(epos4, 0x1403, 0x501, 1, 0x60B10020, 0x60B20010)
    epos4.send_nmt(0x01)
    epos4.send_frame(0x501, struct.pack("<ih", -60, 5))
    epos4.send_sync()
    assert epos4.drive.dictionary.get_number(0x60B1) == -65536
    assert epos4.read_object(0x60B1, signed=True) == -60
    assert epos4.read_object(0x60B2, signed=True) == 5


def test_speed_unit_can_be_changed_and_stored(epos4: DriveRig) -> None:
    """Power of ten in 0x60A9: a thousandth of a revolution per minute (CiA 303-2)."""
    assert epos4.read_object(0x6081) == 1500
    epos4.write_object(0x60A9, 0, 0xFDB44700, 4)
    assert epos4.read_object(0x6081) == 1_500_000
    epos4.write_object(0x1010, 1, 0x65766173, 4)
    epos4.send_nmt(0x81)
    assert (epos4.read_object(0x60A9), epos4.read_object(0x6081)) == (0xFDB44700, 1_500_000)
    remap_pdo(epos4, 0x1800, 0x181, 1, 0x60810020)
    epos4.send_nmt(0x01)
    assert dict(epos4.send_sync())[0x181] == (1_500_000).to_bytes(4, "little")


def test_vendor_objects_do_not_overwrite_simulator_objects(tmp_path: Path) -> None:
    text = format_eds("epos4") + "".join(VAR.format(index, "3", "1") for index in ("2101", "2110", "2121"))
    path = tmp_path / "clash.eds"
    path.write_text(text, encoding="utf-8")
    rig = DriveRig(create_emulated_drive(path))
    rig.send_nmt(0x01)
    rig.send_sync()
    rig.drive.set_temperature(33.0)
    assert [rig.read_object(index) for index in (0x2101, 0x2110, 0x2121)] == [1, 1, 1]
    rig.write_object(0x2101, 0, -7, 2)
    rig.send_sync()
    assert rig.read_object(0x2101, signed=True) == -7


def test_nc_controls_drive_by_its_own_mapping(tmp_path: Path) -> None:
    twin = SteppedSimulator(create_emulated_drive(write_eds("epos4", tmp_path)))
    twin.switch_on()
    twin.run_cycles(20)
    (error,) = [event["text"] for event in twin.events if event["event"] == "error"]
    assert error.startswith("drive X maps 6064 in no PDO")
    rig = DriveRig.wrap_drive(twin.machine.units["X"].drive)
    remap_pdo(rig, 0x1800, 0x181, 255, 0x60410010)
    remap_pdo(rig, 0x1802, 0x381, 2, 0x30D10220, 0x60640020)
    twin.switch_on()
    rows = build_corner_rows()[:, :1]
    twin.play_rows(rows, axes="X")
    twin.run_until("finished")
    assert rig.drive.table_mm == pytest.approx(rows[-1, 0], abs=1e-2)


@pytest.mark.parametrize("sheet", SHEETS)
def test_written_eds_matches_emulated_drive(emulate: Callable[[str], DriveRig], sheet: str) -> None:
    rig = emulate(sheet)
    worn = rig.drive.dictionary.entries
    node, _ = connect_directly(rig.drive)
    assert {index << 8 for index in node.object_dictionary if index >= 0x1000} == {key & 0xFFFF00 for key in worn}
    for key, entry in worn.items():
        if entry.size and entry.access != "wo" and entry.index not in (0x1003, 0x1010, 0x1011):
            assert int.from_bytes(node.sdo.upload(entry.index, entry.sub), "little") >= 0, f"{key:06X}"
    assert isinstance(node.object_dictionary[0x6041], canopen.objectdictionary.ODVariable)
    assert f"VendorNumber=0x{rig.drive.emulation.vendor:08X}" in own_eds_text(rig.drive)


@pytest.mark.parametrize("sheet", [None, *SHEETS])
def test_written_eds_complies_with_cia306(tmp_path: Path, sheet: str | None) -> None:
    """CiA 306, read strictly: no DOMAIN is mappable, defaults are within limits, counts are correct."""
    rig = DriveRig(create_emulated_drive(write_eds(sheet, tmp_path))) if sheet else DriveRig()
    eds = configparser.ConfigParser(strict=True, interpolation=None)
    eds.read_string(own_eds_text(rig.drive))
    listed = [
        int(index, 0)
        for group in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
        for key, index in eds[group].items()
        if key != "supportedobjects"
    ]
    assert sorted(listed) == [item.index for item in rig.drive.dictionary]
    for title in eds.sections():
        section = eds[title]
        if "ObjectType" not in section:
            continue
        if section["ObjectType"] == "0x2":
            assert "PDOMapping" not in section
        if "SubNumber" in section:
            assert section.getint("SubNumber") == sum(name.startswith(f"{title}sub") for name in eds.sections())
        default = section.get("DefaultValue", "")
        for key, sign in (("LowLimit", 1), ("HighLimit", -1)):
            if key in section:
                assert sign * int(default) >= sign * int(section[key]), title
