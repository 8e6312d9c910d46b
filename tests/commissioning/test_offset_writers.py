"""A foreign RPDO of the drive that writes the offset is detected and refused, whatever its number and COB-ID."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.commissioning.commissioning_record import CommissioningRecord, save_record
from fdhil.commissioning.commissioning_steps import check_axis, commission_axis
from fdhil.commissioning.config_check import check_machine, compare_by_traffic
from fdhil.commissioning.drive_survey import DriveSurvey, survey_drive
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.master import Master
from fdhil.commissioning.offset_writers import POINT, compare_traffic_writers, read_other_rpdos
from fdhil.commissioning.record_comparison import verify_commissioned_drives
from fdhil.commissioning.traffic_listener import BusTraffic
from fdhil.commissioning.void_mark import is_record_void
from fdhil.config import MachineConfig, parse_config
from fdhil.errors import DriveFault
from fdhil.sim.drive.eds_writer import format_eds
from tests.bench import bench_document
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer

pytestmark = pytest.mark.usefixtures("fast_commissioning")
RECORD = CommissioningRecord(
    "X", 1, 2, 3, 4, "c0ffee", "f1f2", {}, 1e4, True, 9.8, True, "proven", "2026-01-01T00:00:00+00:00"
)
POSITION_OFFSET, SPEED_OFFSET, TORQUE_OFFSET, OUTPUTS = 0x60B00020, 0x60B10020, 0x60B20010, 0x60FE0120


def build_config(**sections: Any) -> MachineConfig:
    return build_machine_config(
        bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"}, **sections
    )


@pytest.fixture
def peer() -> Iterator[tuple[DrivePeer, MachineConfig]]:
    settings = build_config()
    with DrivePeer(settings) as running:
        yield running, settings


def add_rpdo(peer: DrivePeer, number: int, cob_id: int, words: Sequence[int], count: int | None = None) -> None:
    """Give the drive an RPDO as another master would set it up, with object indices derived from the fourth's."""
    dictionary = peer.drive.dictionary
    for base in (0x1403, 0x1603):
        index = base + number - 4
        for entry in [entry for entry in dictionary.entries.values() if entry.index == base and index != base]:
            dictionary.entries[index << 8 | entry.sub] = replace(entry, index=index)
            dictionary.numbers[index << 8 | entry.sub] = 0
        dictionary.indices.add(index)
    peer.drive.overwrite_object(0x1400 + number - 1, 1, cob_id)
    for sub, word in enumerate(words, 1):
        peer.drive.overwrite_object(0x1600 + number - 1, sub, word)
    peer.drive.overwrite_object(0x1600 + number - 1, 0, len(words) if count is None else count)


def build_corrected_config(folder: Path) -> MachineConfig:
    document = bench_document("X") | {"bus": {"can0": {"interface": "virtual", "channel": uuid.uuid4().hex}}}
    return parse_config(document | {"guard": {"clock": "sync"}}, folder=folder)


def survey_bench_drive(settings: MachineConfig) -> tuple[DriveSurvey, Finding]:
    with Master(settings, "X") as master:
        found = survey_drive(master)
    return found, next(each for each in found.findings if each.point == POINT)


@pytest.mark.parametrize(
    ("number", "cob_id", "words", "says"),
    [
        (4, 0x501, [POSITION_OFFSET], "RPDO4 (COB-ID 501) writes 60B0"),
        (4, 0x7, [OUTPUTS, SPEED_OFFSET], "RPDO4 (COB-ID 007) writes 60B1"),
        (17, 0x37F, [TORQUE_OFFSET, POSITION_OFFSET], "RPDO17 (COB-ID 37F) writes 60B0 and 60B2"),
        (66, 0x2000_0000 | 0x12345, [POSITION_OFFSET], "RPDO66 (COB-ID 12345) writes 60B0"),
        (449, 0x301, [OUTPUTS], "RPDO449 (COB-ID 301) has the COB-ID of an RPDO of the profile and maps 60FE0120"),
    ],
)
def test_second_writer_of_offset_is_detected(
    number: int,
    cob_id: int,
    words: list[int],
    says: str,
    peer: tuple[DrivePeer, MachineConfig],
) -> None:
    drive, settings = peer
    add_rpdo(drive, number, cob_id, words)
    _, finding = survey_bench_drive(settings)
    assert (finding.ok, says in finding.cause) == (False, True), finding
    assert f"bit 31 of 0x{0x1400 + number - 1:04X}:01" in finding.advice


def test_second_writer_listed_only_in_eds_is_detected(tmp_path: Path) -> None:
    plain = build_config()
    eds, more = tmp_path / "twin.eds", ""
    with DrivePeer(plain) as drive:
        for index, subs in ((0x15FF, (1, 2)), (0x17FF, (0, 1))):
            more += f"\n[{index:04X}]\nParameterName=a\nObjectType=9\n"
            more += "".join(f"[{index:04X}sub{sub}]\nParameterName=a\nDataType=7\nAccessType=rw\n" for sub in subs)
        eds.write_text(format_eds(drive.drive) + more)
    settings = build_config(drive={"eds": str(eds)})
    with DrivePeer(settings) as drive:
        add_rpdo(drive, 512, 0x7F, [POSITION_OFFSET])
        _, finding = survey_bench_drive(settings)
    assert "RPDO512 (COB-ID 07F) writes 60B0" in finding.cause


def test_rpdo_scan_ends_after_missing_rpdos(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    with Master(settings, "X") as master:
        read_other_rpdos(master)
    assert len(drive.heard) < 60


def test_multiplexed_rpdo_counts_as_writer(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    add_rpdo(drive, 4, 0x501, [], count=254)
    assert (
        "RPDO4 (COB-ID 501) is multiplexed and can write 60B0 and 60B1 and 60B2"
        in survey_bench_drive(settings)[1].cause
    )


def test_harmless_rpdos_are_recorded_and_accepted(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    add_rpdo(drive, 4, 0x501, [OUTPUTS])
    add_rpdo(drive, 5, 0x8000_0333, [POSITION_OFFSET])
    add_rpdo(drive, 6, 0x8000_0000, [OUTPUTS])
    found, finding = survey_bench_drive(settings)
    assert finding.ok is True
    assert found.rpdos == {"1403": 0x501, "1404": 0x8000_0333}


def test_rpdo_that_cannot_be_read_is_reported(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    dictionary = drive.drive.dictionary
    dictionary.entries[0x140301] = replace(dictionary.entries[0x140301], access="wo")
    _, finding = survey_bench_drive(settings)
    assert finding.ok is None
    assert "not all of its RPDOs can be read" in finding.cause


def test_second_writer_is_refused_by_check_and_commission(
    peer: tuple[DrivePeer, MachineConfig],
) -> None:
    drive, settings = peer
    add_rpdo(drive, 4, 0x501, [POSITION_OFFSET])
    [finding] = [found for place, found in check_machine(settings) if found.point == POINT and place == "axis X"]
    assert finding.ok is False
    with pytest.raises(DriveFault, match=r"^drive X: its RPDO4 \(COB-ID 501\) writes 60B0"):
        commission_axis(settings, "X")
    assert set(drive.heard) == {0x601}


def test_record_stores_other_rpdos(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    add_rpdo(drive, 4, 0x501, [OUTPUTS])
    record = commission_axis(settings, "X")
    assert record.options["1403"] == 0x501
    add_rpdo(drive, 4, 0x8000_0501, [OUTPUTS])
    with Master(settings, "X") as master:
        assert check_axis(master).fingerprint == record.mapping_fingerprint


def test_record_is_voided_by_new_second_writer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.record_comparison.LISTEN_S", 0.2)
    settings, reported = build_corrected_config(tmp_path), list[str]()
    with DrivePeer(settings) as drive:
        record = commission_axis(settings, "X")
        save_record(record, settings.store.directory)
        verify_commissioned_drives(settings, "can0", reported.append)
        assert reported == []
        assert make_guard_settings(settings, "can0", tmp_path, "").axes[0].record_void is False
        add_rpdo(drive, 20, 0x3F0, [POSITION_OFFSET])
        verify_commissioned_drives(settings, "can0", reported.append)
    assert reported[0].startswith("RecordVoid: axis X: its RPDO20 (COB-ID 3F0) writes 60B0, as fdhil does")
    [axis] = make_guard_settings(settings, "can0", tmp_path, "").axes
    assert axis.record_void is True
    assert axis.void_reason.startswith("its RPDO20 (COB-ID 3F0) writes 60B0")


def test_guard_receives_cob_ids_of_record(tmp_path: Path) -> None:
    settings = build_corrected_config(tmp_path)
    save_record(RECORD, settings.store.directory)
    assert make_guard_settings(settings, "can0", tmp_path, "").axes[0].writers == (
        0x401,
        0x501,
    )  # by default, not valid
    kept = {"1403": 0x501, "1404": 0x8000_0333, "1405": 0xA001_2345, "1406": 0x8000_0000}
    save_record(replace(RECORD, options=kept), settings.store.directory)
    assert make_guard_settings(settings, "can0", tmp_path, "").axes[0].writers == (0x333, 0x401)


def test_bit_30_of_rpdo_cob_id_is_ignored(tmp_path: Path) -> None:
    settings = build_corrected_config(tmp_path)
    kept = {"1403": 0x4000_0501, "1404": 0xC000_0333}
    save_record(replace(RECORD, options=kept), settings.store.directory)
    assert make_guard_settings(settings, "can0", tmp_path, "").axes[0].writers == (0x333, 0x401)


def test_rpdo_with_high_number_is_recorded(tmp_path: Path) -> None:
    settings, plain = build_corrected_config(tmp_path), replace(RECORD, options={"6007": 1})
    record = replace(plain, options={**plain.options, "1500": 0x401, "15FF": 0x8000_0333})
    assert record.fingerprint == plain.fingerprint
    save_record(record, settings.store.directory)
    assert make_guard_settings(settings, "can0", tmp_path, "").axes[0].writers == (0x333, 0x501)


def test_drive_on_another_bus_makes_no_cob_id_harmless(tmp_path: Path) -> None:
    document = bench_document("XY") | {
        "bus": {name: {"interface": "virtual", "channel": name} for name in ("can0", "can1")}
    }
    document["axis"]["X"]["drive"] = {**document["axis"]["X"].get("drive", {}), "bus": "can0", "node_id": 1}
    document["axis"]["Y"]["drive"] = {**document["axis"]["Y"].get("drive", {}), "bus": "can1", "node_id": 1}
    document["axis"]["Y"]["table"] = {"cob_id": 0x501}
    del document["axis"]["Y"]["correction"]
    settings = parse_config(document, folder=tmp_path)
    assert make_guard_settings(settings, "can0", tmp_path, "").axes[0].writers == (0x401, 0x501)


def test_rpdo_with_29_bit_id_is_not_of_the_profile(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    drive.drive.dictionary.numbers[0x140101] = 0x2000_0301
    findings = {each.point: each for each in survey_bench_drive(settings)[0].findings}
    assert findings["RPDO2"].ok is False
    assert "RPDO2 has the COB-ID 20000301, not 301" in findings["RPDO2"].cause


def build_traffic(held: int, frames: Mapping[int, bytes]) -> BusTraffic:
    """Build the traffic of a drive with an offset while an NC also sends these frames."""
    sent = {0x381: struct.pack("<ii", held + 7, held), 0x201: struct.pack("<Hi", 15, 7), **frames}
    data = {cob_id: int.from_bytes(frame.ljust(8, b"\0"), "little") for cob_id, frame in sent.items()}
    return BusTraffic(count=dict.fromkeys(sent, 9), length={key: len(frame) for key, frame in sent.items()}, data=data)


@pytest.mark.parametrize(
    ("held", "frames", "found"),
    [
        (197, {0x3F0: struct.pack("<i", 197)}, "60.1 um, which the frame 3F0"),
        (-197, {0x41: b"", 0x57F: struct.pack("<Hi", 0xC5C5, -197)}, "60.1 um, which the frame 57F"),
        (197, {0x3F0: struct.pack("<i", 198), 0x3F1: b"\xc5\0\0"}, ""),
        (197, {0x601: struct.pack("<i", 197), 0x301: struct.pack("<i", 197)}, ""),
        (1, {0x3F0: b"\1\0\0\0"}, ""),
        (197, {0x501: struct.pack("<i", 197)}, ""),  # according to the record it writes another object
    ],
)
def test_frame_carrying_drive_offset_voids_record(
    held: int, frames: Mapping[int, bytes], found: str, tmp_path: Path
) -> None:
    record = replace(RECORD, options={"1403": 0x4000_0501, "1404": 0x8000_03F0})
    settings, traffic = build_corrected_config(tmp_path), build_traffic(held, frames)
    finding = compare_traffic_writers(settings, "X", record, traffic)
    assert (finding.ok, found in finding.cause) == (not found, True)
    save_record(record, settings.store.directory)
    checked = {each.point: each for each in compare_by_traffic(traffic, settings, "X")}
    assert checked[POINT] == finding


def test_frame_of_nc_carrying_offset_voids_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, reported = build_corrected_config(tmp_path), list[str]()
    save_record(RECORD, settings.store.directory)
    traffic = build_traffic(197, {0x3F0: struct.pack("<i", 197)})
    monkeypatch.setattr("fdhil.commissioning.record_comparison._listen_to_bus", lambda *_: traffic)
    verify_commissioned_drives(settings, "can0", reported.append)
    assert "the axis cannot be armed or adopted" in reported[0]
    assert is_record_void(settings.store.directory, "X")


# sizes of mapped objects


def write_profile(folder: Path, entries: str) -> dict[str, Any]:
    path = folder / "own.toml"
    path.write_text(
        'base = "fdhil_twin"\n'
        '[[tpdos]]\nname = "TPDO1"\ncob_base = 0x180\nentries = [[0x6064, 0, 32, true], [0x606C, 0, 32, true]]\n'
        f'[[tpdos]]\nname = "TPDO2"\ncob_base = 0x280\nentries = {entries}\n'
        '[[tpdos]]\nname = "TPDO3"\ncob_base = 0x380\nentries = [[0x6062, 0, 32, true], [0x60B0, 0, 32, true]]\n'
        "every_sync = 10\n"
        '[[tpdos]]\nname = "TPDO4"\ncob_base = 0x480\nentries = [[0x6061, 0, 8, true]]\nevery_sync = 10\n'
    )
    return {"profile": str(path)}


@pytest.mark.parametrize(
    ("entries", "mapped", "says"),
    [
        (
            "[[0x6078, 0, 32, true], [0x6041, 0, 16, false]]",
            [(0x6078, 0, 32), (0x6041, 0, 16)],
            "6078:00 has 16 bits (by SDO), but TPDO2 maps it with 32",
        ),
        (
            "[[0x6041, 0, 8, false], [0x6078, 0, 16, true]]",
            [(0x6041, 0, 8), (0x6078, 0, 16)],
            "6041:00 has 16 bits (by SDO), but TPDO2 maps it with 8",
        ),
    ],
)
def test_object_mapped_with_wrong_size_is_detected(
    entries: str, mapped: list[tuple[int, int, int]], says: str, tmp_path: Path
) -> None:
    settings = build_config(drive=write_profile(tmp_path, entries))
    with DrivePeer(settings) as drive, Master(settings, "X") as master:
        drive.drive.overwrite_mapping(0x1A01, mapped)
        drive.drive.overwrite_mapping(0x1A03, [(0x6061, 0, 8)])
        findings = {each.point: each for each in survey_drive(master).findings}
    assert findings["TPDO2"].ok is True  # drive and profile agree but are both wrong
    assert findings["object sizes"].ok is False
    assert says in findings["object sizes"].cause


def test_sizes_of_correct_mapping_are_accepted(peer: tuple[DrivePeer, MachineConfig]) -> None:
    findings = {each.point: each for each in survey_bench_drive(peer[1])[0].findings}
    assert (findings["object sizes"].ok, findings["object sizes"].found) == (True, "15 as mapped")
