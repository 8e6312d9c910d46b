"""A drive's PDOs are written according to its profile, or remain unchanged."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.commissioning.drive_survey import read_pdos, survey_drive
from fdhil.commissioning.master import Master
from fdhil.commissioning.pdo_setup import PdoSetup, set_up_pdos
from fdhil.config import MachineConfig
from fdhil.drivers.can.sdo_channel import SdoChannel
from fdhil.errors import DriveFault
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.tiers import sampled
from tests.vendor_drives.vendor_machines import OUTFITS, VendorDrive, build_vendor_config

pytestmark = pytest.mark.usefixtures("fast_commissioning")


def build_config(**sections: Any) -> MachineConfig:
    return build_machine_config(
        bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"}, **sections
    )


@pytest.fixture
def peer() -> Iterator[tuple[DrivePeer, MachineConfig]]:
    settings = build_config()
    with DrivePeer(settings) as running:
        yield running, settings


SPOILT: Mapping[str, tuple[Callable[[DrivePeer], object], str]] = {
    "order": (
        lambda p: p.drive.overwrite_mapping(0x1A01, [(0x6041, 0, 16), (0x2101, 0, 16), (0x6078, 0, 16)]),
        "TPDO2",
    ),
    "event driven": (lambda p: p.drive.overwrite_object(0x1800, 2, 255), "TPDO1"),
    "another COB-ID": (lambda p: p.drive.overwrite_object(0x1401, 1, 0x305), "RPDO2"),
    "switched off": (lambda p: p.drive.overwrite_object(0x1401, 1, 0x80000301), "RPDO2"),
}


@pytest.mark.parametrize("what", SPOILT)
def test_differing_pdos_are_written(what: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    spoil, name = SPOILT[what]
    spoil(drive)
    with Master(settings, "X") as master:
        assert set_up_pdos(master).written == (name,)
        points = {finding.point: finding.ok for finding in survey_drive(master).findings}
    assert points[name] is True
    assert not {0x080, 0x201, 0x301} & set(drive.heard)  # no SYNC, no set-point: nothing can move


def test_transmission_type_of_fixed_mapping_is_set(peer: tuple[DrivePeer, MachineConfig]) -> None:
    """The drive refuses every write to its mappings, as in its EDS, but accepts transmission types."""
    drive, settings = peer
    entries = drive.drive.dictionary.entries
    fixed = {key: replace(entry, access="ro") for key, entry in entries.items() if 0x1600 <= key >> 8 < 0x1800}
    fixed |= {key: replace(entry, access="ro") for key, entry in entries.items() if 0x1A00 <= key >> 8 < 0x1C00}
    entries |= fixed
    drive.drive.overwrite_object(0x1800, 2, 255)
    with Master(settings, "X") as master:
        assert set_up_pdos(master).written == ("TPDO1",)
        assert set_up_pdos(master) == PdoSetup((), None)
        drive.drive.overwrite_object(0x1A00, 1, 0x60620020)
        drive.drive.overwrite_object(0x1800, 2, 255)
        with pytest.raises(DriveFault, match="it refuses TPDO1 with 6064:00, 606C:00"):
            set_up_pdos(master)
    assert drive.drive.dictionary.get_number(0x1800, 2) == 255


@pytest.mark.parametrize("outfit", sampled(OUTFITS, every=3), ids=lambda outfit: outfit.name)
def test_drive_of_every_vendor_is_set_up_from_defaults(outfit: VendorDrive, tmp_path: Path) -> None:
    settings = build_vendor_config(
        outfit, tmp_path, bus={"can0": {"interface": "virtual", "channel": uuid.uuid4().hex}}
    )
    with DrivePeer(settings), Master(settings, "X") as master:
        done = set_up_pdos(master)
        assert done.written
        assert set_up_pdos(master) == PdoSetup((), None)


def test_correct_drive_is_not_written(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    with Master(settings, "X") as master:
        assert set_up_pdos(master) == PdoSetup((), None)
    assert set(drive.heard) == {0x601}


@pytest.mark.fault("A25")
def test_pdos_are_restored_when_drive_refuses_object(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text(
        'base = "fdhil_twin"\n'
        '[[tpdos]]\nname = "TPDO1"\ncob_base = 0x180\nentries = [[0x606C, 0, 32, true], [0x6064, 0, 32, true]]\n'
        '[[tpdos]]\nname = "TPDO2"\ncob_base = 0x280\n'
        "entries = [[0x6041, 0, 16, false], [0x6078, 0, 16, true], [0x605A, 0, 16, true]]\n"
    )
    settings = build_config(drive={"profile": str(own)})
    with DrivePeer(settings), Master(settings, "X") as master:
        before = [found for _, found in read_pdos(master)]
        with pytest.raises(DriveFault, match="it refuses TPDO2 with 6041:00, 6078:00, 605A:00"):
            set_up_pdos(master)
        assert [found for _, found in read_pdos(master)] == before


def test_enabled_drive_is_not_written(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    drive.drive.overwrite_object(0x1800, 2, 255)
    drive.drive.overwrite_object(0x6041, 0, 0x1237)
    with Master(settings, "X") as master, pytest.raises(DriveFault, match="Operation enabled"):
        set_up_pdos(master)
    assert drive.drive.dictionary.get_number(0x1800, 2) == 255


def test_objects_of_second_axis_are_offset_by_0x800(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def record_upload(_link: SdoChannel, index: int, _sub: int) -> bytes:
        asked.append(index)
        return bytes(2)

    monkeypatch.setattr(SdoChannel, "_upload_object", record_upload)
    with Master(build_config(drive={"logical_axis": 2, "node_id": 1}), "X") as master:
        for index in (0x6041, 0x68B0, 0x1018):
            master.sdo.read_int(index)
    assert asked == [0x6841, 0x68B0, 0x1018]
