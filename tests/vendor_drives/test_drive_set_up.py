"""Scan, check and commissioning of drives of every vendor over a bus."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import canopen
import pytest

from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.commissioning.config_check import check_machine
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.scan import read_descriptions, scan_bus
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, DriveFault
from tests.drivers.peer import DrivePeer
from tests.eds import write_eds
from tests.short_waits import shorten_waits
from tests.vendor_drives.vendor_machines import OUTFITS, VendorDrive, build_vendor_config, set_up_drive

EVERY = pytest.mark.parametrize("outfit", OUTFITS, ids=lambda outfit: outfit.name)


@pytest.fixture(autouse=True)
def short_delays(virtual_threads: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Virtual time, and shorter waits than on a real machine."""
    shorten_waits(monkeypatch)


@contextmanager
def run_on_a_bus(outfit: VendorDrive, folder: Path) -> Iterator[tuple[DrivePeer, MachineConfig]]:
    """A drive of this vendor, set up over the bus by an independent CANopen library."""
    channel = uuid.uuid4().hex
    config = build_vendor_config(outfit, folder, bus={"can0": {"interface": "virtual", "channel": channel}})
    with DrivePeer(config) as peer:
        network = canopen.Network()
        network.connect(interface="virtual", channel=channel)
        try:
            node = network.add_node(config.get_node_id("X"), str(folder / f"{outfit.sheet}.eds"))

            def write(index: int, sub: int, value: int, size: int) -> None:
                node.sdo.download(index, sub, value.to_bytes(size, "little"))

            set_up_drive(config, "X", lambda index: index in node.object_dictionary, write)
        finally:
            network.disconnect()
        yield peer, config


def list_differences(config: MachineConfig) -> dict[str, Finding]:
    return {finding.point: finding for _, finding in check_machine(config) if finding.ok is False}


@pytest.mark.usefixtures("long_computation")
@EVERY
def test_vendor_drive_is_found_checked_and_commissioned(outfit: VendorDrive, tmp_path: Path) -> None:
    with run_on_a_bus(outfit, tmp_path) as (peer, config):
        descriptions, faults = read_descriptions([tmp_path / f"{outfit.sheet}.eds"])
        assert not faults
        (node,) = scan_bus("can0", config, descriptions).nodes
        assert node.answers is not None
        assert node.answers.identity.vendor_id == peer.drive.dictionary.get_number(0x1018, 1)
        assert {k: v for k, v in list_differences(config).items() if k not in outfit.lacks} == {}
        if outfit.on_line:
            record = commission_axis(config, "X")
            assert record.watchdog == "proven"
            assert record.sign_test_um == pytest.approx(10.0, abs=3.0)
            return
        with pytest.raises(DriveFault, match="corrected demand"):
            commission_axis(config, "X")


def test_factory_default_drive_lists_the_needed_set_up(tmp_path: Path) -> None:
    config = build_vendor_config(
        OUTFITS[0], tmp_path, bus={"can0": {"interface": "virtual", "channel": uuid.uuid4().hex}}
    )
    with DrivePeer(config):
        found = list_differences(config)
    assert {"RPDO1", "TPDO1", "TPDO2"} <= found.keys()
    assert "0x1A01" in found["TPDO2"].advice


def test_drive_without_current_is_refused(tmp_path: Path) -> None:
    from fdhil.drivers.cia402.drive_profile_file import load_profile

    config = build_vendor_config(VendorDrive("cia402", "plain"), tmp_path)
    assert write_eds("plain", tmp_path).is_file()
    with pytest.raises(ConfigError, match="current"):
        load_profile(config.axis["X"].drive)
