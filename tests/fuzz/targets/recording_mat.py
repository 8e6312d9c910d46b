"""Recordings as MAT files."""

from __future__ import annotations

from tests.fuzz.input_assessment import Target
from tests.fuzz.targets import recording


def target() -> Target:
    return recording.target_of("mat", 4000, [b"\\x0e\\x00\\x00\\x00", b"\\x09\\x00\\x00\\x00", b"\\x00\\x01IM"])
