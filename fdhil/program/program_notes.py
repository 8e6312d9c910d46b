"""Note implausible motions of a program, often caused by numbers that another NC reads differently. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fdhil.program.motions import Dwell, Motion, Probe
from fdhil.program.nc_dialect import Dialect
from fdhil.records import Reason

LONG_DWELL_S = 60.0
FAR_MM = 2000.0
MOST_OF_A_KIND = 10


class ProgramNotes:
    """Collects notes while motions pass: long dwells, positions metres away, and consequences of a probe."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._found: dict[tuple[str, int], Reason] = {}

    @property
    def notes(self) -> tuple[Reason, ...]:
        """The notes so far, in the order of the motions; ten of a kind at most."""
        return tuple(self._found.values())

    def watch_motions(self, motions: Iterable[Motion]) -> Iterator[Motion]:
        """Yield the motions unchanged."""
        for motion in motions:
            if isinstance(motion, Dwell):
                if motion.seconds > LONG_DWELL_S:
                    self._add_note("LongDwell", motion.line, *self._describe_dwell(motion.seconds))
            else:
                for axis, value in zip("XYZ", motion.end, strict=True):
                    if abs(value) > FAR_MM:
                        self._add_note("FarPosition", motion.line, *self._describe_position(axis, value))
                if isinstance(motion, Probe):
                    self._add_note("UnknownAfterProbe", motion.line, *_AFTER_PROBE)
            yield motion

    def _add_note(self, code: str, line: int, text: str, advice: str) -> None:
        if sum(kind == code for kind, _ in self._found) < MOST_OF_A_KIND:
            self._found.setdefault((code, line), Reason(code, f"line {line}: {text}", advice))

    def _describe_dwell(self, seconds: float) -> tuple[str, str]:
        unit = self._dialect.dwell_unit
        how = "as LinuxCNC does" if unit == "s" else f'by [nc] dwell_unit = "{unit}"'
        other = 'if the NC reads milliseconds, set [nc] dwell_unit = "ms" or "ms_without_point"'
        text = f"the axes dwell for {seconds:g} s; P is read in {'seconds' if unit == 's' else 'that unit'}, {how}"
        return text, other if unit == "s" else "compare it with the NC's manual"

    def _describe_position(self, axis: str, value: float) -> tuple[str, str]:
        text = f"axis {axis} moves to {value:g} mm, beyond the reach of most machines"
        if not self._dialect.is_plain:
            return f"{text}; numbers are read by [nc] integers", "compare it with the NC's manual"
        text += "; a number without a decimal point is read as whole units, as LinuxCNC does"
        return text, 'if the NC reads thousandths, set [nc] integers = "thousandths"'


_AFTER_PROBE = (
    "the touch point of the probe is unknown: the following path, and all uses of #5061 to #5070, assume that the"
    " probe reaches its target without a touch",
    "record the demand of a real run if the path after the probe matters",
)
