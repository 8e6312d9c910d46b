"""EDS and DCF files: a dictionary and the device's capabilities, or an EdsError with the line."""

from __future__ import annotations

import tempfile
from pathlib import Path

from fdhil.drivers.cia402.capabilities import assess_capabilities, suggest_profile
from fdhil.drivers.cia402.device_description import read_device
from fdhil.drivers.cia402.drive_profile_file import read_profile
from fdhil.errors import EdsError
from tests.fuzz.input_assessment import Target

FILES = Path(__file__).resolve().parents[2] / "eds"
_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
_PROFILE = read_profile("fdhil_twin")


def taste(data: bytes) -> None:
    """Read the bytes as the file of a drive, and determine its capabilities."""
    path = Path(_FOLDER.name) / "drive.eds"
    path.write_bytes(data)
    try:
        device = read_device(path)
    except EdsError as error:
        assert len(str(error)) < 1000
        return
    suggest_profile(device)
    assess_capabilities(device, _PROFILE)


def target() -> Target:
    seeds = [path.read_bytes() for path in sorted(FILES.glob("*.txt"))]
    words = [
        b"[DeviceInfo]", b"[6064]", b"[1A00sub1]", b"[1A00]", b"ObjectType=0x9", b"SubNumber=", b"CompactSubObj=254",
        b"$NODEID+0x180", b"DataType=0x0004", b"DefaultValue=", b"ParameterValue=", b"NrOfEntries=254", b"[DummyUsage]",
        b"LowLimit=", b"[1018sub1]", b"[DeviceComissioning]", b"NodeID=", b"[2000Name]", b"[2000Value]",
    ]  # fmt: skip
    return Target("eds", seeds, taste, words, 3500)
