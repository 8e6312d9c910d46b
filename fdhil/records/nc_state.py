"""State of a numerical controller, as it reports it."""

from collections.abc import Mapping
from dataclasses import dataclass

from fdhil.records.signal_records import MoveKind


@dataclass(frozen=True, slots=True)
class NcState:
    """State of an NC at one instant; None is what its source does not report.

    ``stamp_ns`` is CLOCK_MONOTONIC of this computer; the instant lies within ``error_ns`` of it on either side, which
    covers the age of the answer. ``motion`` is UNKNOWN while nothing is received from the NC, HOLD during a feed hold.
    ``line`` is the 1-based source line of ``program`` that is being executed. Overrides are 1.0 at 100 %. ``demand_mm``
    are the NC's own set-points by axis, valid at ``nc_tick``, its cycle counter with period ``nc_period_s``: they are
    aligned with the set-points on the bus, so that clocks do not matter.
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
        """Escape non-Unicode bytes in the program's name (a Latin-1 file), which nothing could encode."""
        if self.program is not None:
            object.__setattr__(self, "program", self.program.encode("utf-8", "backslashreplace").decode())

    @property
    def is_held(self) -> bool:
        """Whether a feed hold certainly stops the NC."""
        return self.motion is MoveKind.HOLD or bool(self.feed_hold)
