"""What a numerical controller says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fdhil.records.signals import MoveKind


@dataclass(frozen=True, slots=True)
class NcState:
    """What an NC does at one instant; what its source cannot tell is None.

    ``stamp_ns`` is CLOCK_MONOTONIC of this computer, and the instant lies within ``error_ns`` of it, to either side:
    how old an answer may be is in it. ``motion`` is UNKNOWN while the NC is not heard, HOLD while a feed hold keeps it
    still. ``line`` is the 1-based source line of ``program`` that moves now. Overrides are 1.0 at 100 %. ``demand_mm``
    are the NC's own set-points by axis, true at ``nc_tick``, its own cycle counter, which counts ``nc_period_s``:
    where an NC tells them, they are laid on the set-points of the bus, and clocks do not matter.
    """

    stamp_ns: int
    error_ns: int
    motion: MoveKind
    line: int | None = None
    programmed_feed_mm_min: float | None = None
    feed_mm_min: float | None = None
    feed_override: float | None = None
    rapid_override: float | None = None
    feed_hold: bool | None = None
    tool: int | None = None
    program: str | None = None
    demand_mm: Mapping[str, float] | None = None
    nc_tick: int | None = None
    nc_period_s: float | None = None

    def __post_init__(self) -> None:
        """Escape what is no Unicode in the program's name, as of a Latin-1 file: nothing that tells or keeps it can."""
        if self.program is not None:
            object.__setattr__(self, "program", self.program.encode("utf-8", "backslashreplace").decode())

    @property
    def held(self) -> bool:
        """Whether a feed hold is known to keep the NC still."""
        return self.motion is MoveKind.HOLD or bool(self.feed_hold)
