"""An RPDO of the drive that writes the offset and is not ours is found and refused, whatever its number and COB-ID."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest

from fdhil.commissioning.config_check import check_machine
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.master import Master
from fdhil.commissioning.offset_writers import POINT
from fdhil.commissioning.steps import check_axis, commission
from fdhil.commissioning.survey import Survey, survey
from fdhil.config import MachineConfig
from fdhil.errors import DriveFault
from tests.drivers.peer import DrivePeer
from tests.drivers.wire import machine

pytestmark = pytest.mark.usefixtures("quick_commissioning")
POSITION_OFFSET, SPEED_OFFSET, TORQUE_OFFSET, OUTPUTS = 0x60B00020, 0x60B10020, 0x60B20010, 0x60FE0120


def config(**sections: Any) -> MachineConfig:
    return machine(bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"}, **sections)


@pytest.fixture
def peer() -> Iterator[tuple[DrivePeer, MachineConfig]]:
    settings = config()
    with DrivePeer(settings) as running:
        yield running, settings


def give_rpdo(peer: DrivePeer, number: int, cob_id: int, words: Sequence[int], count: int | None = None) -> None:
    """Give the drive an RPDO as another master would have set it up; its places are made of those of the fourth."""
    dictionary = peer.drive.dictionary
    for base in (0x1403, 0x1603):
        index = base + number - 4
        for entry in [entry for entry in dictionary.entries.values() if entry.index == base and index != base]:
            dictionary.entries[index << 8 | entry.sub] = replace(entry, index=index)
            dictionary.numbers[index << 8 | entry.sub] = 0
        dictionary.indices.add(index)
    peer.drive.set_object(0x1400 + number - 1, 1, cob_id)
    for sub, word in enumerate(words, 1):
        peer.drive.set_object(0x1600 + number - 1, sub, word)
    peer.drive.set_object(0x1600 + number - 1, 0, len(words) if count is None else count)


def surveyed(settings: MachineConfig) -> tuple[Survey, Finding]:
    with Master(settings, "X") as master:
        found = survey(master)
    return found, next(each for each in found.findings if each.point == POINT)


@pytest.mark.parametrize(
    ("number", "cob_id", "words", "says"),
    [
        (4, 0x501, [POSITION_OFFSET], "RPDO4 (COB-ID 501) writes 60B0"),
        (4, 0x7, [OUTPUTS, SPEED_OFFSET], "RPDO4 (COB-ID 007) writes 60B1"),
        (17, 0x37F, [TORQUE_OFFSET, POSITION_OFFSET], "RPDO17 (COB-ID 37F) writes 60B0 and 60B2"),
        (512, 0x2000_0000 | 0x12345, [POSITION_OFFSET], "RPDO512 (COB-ID 12345) writes 60B0"),
        (100, 0x301, [OUTPUTS], "RPDO100 (COB-ID 301) has the COB-ID of an RPDO of the profile and maps 60FE0120"),
    ],
)
def test_second_writer_of_an_offset_is_found(
    number: int,
    cob_id: int,
    words: list[int],
    says: str,
    peer: tuple[DrivePeer, MachineConfig],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive, settings = peer
    monkeypatch.setattr("fdhil.commissioning.offset_writers.MOST_RPDOS", 512)
    give_rpdo(drive, number, cob_id, words)
    _, finding = surveyed(settings)
    assert (finding.ok, says in finding.cause) == (False, True), finding
    assert f"bit 31 of 0x{0x1400 + number - 1:04X}:01" in finding.advice


def test_multiplexed_rpdo_is_a_writer(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    give_rpdo(drive, 4, 0x501, [], count=254)
    assert "RPDO4 (COB-ID 501) is multiplexed and can write 60B0 and 60B1 and 60B2" in surveyed(settings)[1].cause


def test_other_rpdos_are_kept_for_the_record_and_not_refused(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    give_rpdo(drive, 4, 0x501, [OUTPUTS])
    give_rpdo(drive, 5, 0x8000_0333, [POSITION_OFFSET])
    give_rpdo(drive, 6, 0x8000_0000, [OUTPUTS])
    found, finding = surveyed(settings)
    assert finding.ok is True
    assert found.rpdos == {"1403": 0x501, "1404": 0x8000_0333}


def test_rpdo_that_cannot_be_read_is_reported(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    dictionary = drive.drive.dictionary
    dictionary.entries[0x140301] = replace(dictionary.entries[0x140301], access="wo")
    _, finding = surveyed(settings)
    assert finding.ok is None
    assert "not all of its RPDOs can be read" in finding.cause


def test_second_writer_is_refused_by_check_and_commission_and_nothing_is_sent(
    peer: tuple[DrivePeer, MachineConfig],
) -> None:
    drive, settings = peer
    give_rpdo(drive, 4, 0x501, [POSITION_OFFSET])
    [finding] = [found for place, found in check_machine(settings) if found.point == POINT and place == "axis X"]
    assert finding.ok is False
    with pytest.raises(DriveFault, match=r"^drive X: its RPDO4 \(COB-ID 501\) writes 60B0"):
        commission(settings, "X")
    assert set(drive.heard) == {0x601}


def test_record_keeps_the_other_rpdos(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    give_rpdo(drive, 4, 0x501, [OUTPUTS])
    record = commission(settings, "X")
    assert record.options["1403"] == 0x501
    give_rpdo(drive, 4, 0x8000_0501, [OUTPUTS])
    with Master(settings, "X") as master:
        assert check_axis(master).fingerprint == record.mapping_fingerprint


# sizes of mapped objects


def own_profile(folder: Any, entries: str) -> dict[str, Any]:
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
            "6078:00 has 16 bits (by SDO), and TPDO2 maps it with 32",
        ),
        (
            "[[0x6041, 0, 8, false], [0x6078, 0, 16, true]]",
            [(0x6041, 0, 8), (0x6078, 0, 16)],
            "6041:00 has 16 bits (by SDO), and TPDO2 maps it with 8",
        ),
    ],
)
def test_object_that_is_mapped_in_another_size_is_found(
    entries: str, mapped: list[tuple[int, int, int]], says: str, tmp_path: Any
) -> None:
    settings = config(drive=own_profile(tmp_path, entries))
    with DrivePeer(settings) as drive, Master(settings, "X") as master:
        drive.drive.remap(0x1A01, mapped)
        drive.drive.remap(0x1A03, [(0x6061, 0, 8)])
        findings = {each.point: each for each in survey(master).findings}
    assert findings["TPDO2"].ok is True  # drive and profile agree, and are both wrong
    assert findings["object sizes"].ok is False
    assert says in findings["object sizes"].cause


def test_sizes_of_a_drive_that_is_right_are_as_mapped(peer: tuple[DrivePeer, MachineConfig]) -> None:
    findings = {each.point: each for each in surveyed(peer[1])[0].findings}
    assert (findings["object sizes"].ok, findings["object sizes"].found) == (True, "15 as mapped")
