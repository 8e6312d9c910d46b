"""Recordings as CSV text."""

from __future__ import annotations

from tests.fuzz.targets import recording
from tests.fuzz.tasting import Target


def target() -> Target:
    return recording.target_of("csv", 4000, [b"# ", b",", b"\\n"])
