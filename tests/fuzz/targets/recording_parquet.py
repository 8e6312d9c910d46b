"""Recordings as Parquet files."""

from __future__ import annotations

from tests.fuzz.input_assessment import Target
from tests.fuzz.targets import recording


def target() -> Target:
    return recording.target_of("parquet", 6000, [b"PAR1", b"\\x15\\x00", b"\\xff\\xff\\xff\\x0f"])
