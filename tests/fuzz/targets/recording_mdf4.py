"""Recordings as ASAM MDF 4 files."""

from __future__ import annotations

from tests.fuzz.input_assessment import Target
from tests.fuzz.targets import recording


def target() -> Target:
    return recording.target_of("mdf4", 12000, [b"##HD", b"##DG", b"##CG", b"##CN", b"##DT", b"##TX", b"##DZ", b"##CC"])
