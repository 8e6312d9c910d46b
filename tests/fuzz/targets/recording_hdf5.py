"""Recordings as HDF5 files."""

from __future__ import annotations

from tests.fuzz.input_assessment import Target
from tests.fuzz.targets import recording


def target() -> Target:
    return recording.target_of("hdf5", 12000, [b"TREE", b"SNOD", b"HEAP", b"OHDR", b"GCOL"])
