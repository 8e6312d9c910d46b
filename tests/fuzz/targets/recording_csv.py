"""Recordings as CSV text."""

from __future__ import annotations

from tests.fuzz.input_assessment import Target
from tests.fuzz.targets import recording


def target() -> Target:
    return recording.target_of("csv", 4000, [b"# ", b",", b"\\n"])
