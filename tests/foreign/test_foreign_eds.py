"""The EDS written by the simulated drive, also with a vendor's EDS, as another CANopen stack reads it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from fdhil.sim.drive.eds_writer import write_eds
from fdhil.sim.drive.object_dictionary import SIGNED
from tests.eds import SHEETS
from tests.eds import write_eds as write_sheet
from tests.foreign.peers import FOLDER, NODE
from tests.sim.drive_rig import DriveRig, build_machine_config

pytestmark = pytest.mark.debian


@pytest.mark.parametrize("sheet", [None, *SHEETS])
def test_foreign_eds_files_are_read_as_intended(sheet: str | None, tmp_path: Path) -> None:
    worn: dict[str, Any] = {} if sheet is None else {"eds": str(write_sheet(sheet, tmp_path))}
    drive = DriveRig(build_machine_config(**worn)).drive
    path = write_eds(drive, tmp_path / "drive.eds")
    command = [NODE, str(FOLDER / "read_eds.js"), json.dumps({"file": str(path)})]
    read = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert int(read["vendor"], 16) == drive.emulation.vendor
    for entry in drive.dictionary.entries.values():
        found = read["objects"][f"{entry.index}:{entry.sub}"]
        assert found["type"] == entry.type
        assert found["access"] == entry.access
        if entry.type in SIGNED and not entry.node_relative:
            assert found["value"] == entry.default, f"{entry.index:04X}:{entry.sub:02X}"
