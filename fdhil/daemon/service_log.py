"""Writes one readable log line per outcome; under systemd with the priority that the journal understands."""

import os
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Literal, TextIO

from fdhil.json_lines import encode_line
from fdhil.records import PARAMETERS, UNITS, LoopEstimate, Notice, Outcome, ParameterSet, Skill, WindowOutcome, get_unit
from fdhil.system_clock import SYSTEM_CLOCK, Clock

Severity = Literal["info", "minor", "MAJOR"]
# syslog priorities, see sd-daemon(3)
_PRIORITY = {"info": 6, "minor": 4, "MAJOR": 3}
BURST = 20  # lines of one class that are written before a flood is only counted
REFILL_PER_S = 1.0

_for_programs = threading.Event()  # whether lines are JSON
_clocks = [SYSTEM_CLOCK]  # the last one dates the lines
_dropped = {"lines": 0}  # since the last line that was written


def escape_unprintable(text: str) -> str:
    """Escape what could control a terminal or forge a line: names, EMCY texts and file names come from outside."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


@contextmanager
def write_lines_as_json(wanted: bool) -> Iterator[None]:
    """Write each line as a JSON object to stdout meanwhile, when ``wanted``."""
    if wanted:
        _for_programs.set()
    try:
        yield
    finally:
        _for_programs.clear()


@contextmanager
def date_lines_by(clock: Clock) -> Iterator[None]:
    """Date each line by this clock meanwhile."""
    _clocks.append(clock)
    try:
        yield
    finally:
        _clocks.remove(clock)


def write_line(text: str, severity: Severity = "info") -> None:
    """Write one line to stderr with its time in UTC; to the journal, which adds the time, with its priority.

    Never waits for the reader: when the pipe or the disk is full, the line is dropped and counted, and the count is
    reported later.
    """
    lost = _dropped["lines"]
    if lost and _write_available(*_format_line(f"{lost} lines could not be written before this one", "minor")):
        _dropped["lines"] = 0
    if not _write_available(*_format_line(text, severity)):
        _dropped["lines"] += 1


def _format_line(text: str, severity: Severity) -> tuple[TextIO, str]:
    now = datetime.fromtimestamp(_clocks[-1].wall_s(), UTC)
    if _for_programs.is_set():
        line = {"time": now.isoformat(timespec="milliseconds"), "severity": severity, "text": text}
        return sys.stdout, encode_line(line).decode()
    stamp = f"{now:%Y-%m-%d %H:%M:%S}.{now.microsecond // 1000:03d} UTC "
    prefix = f"<{_PRIORITY[severity]}>" if os.environ.get("JOURNAL_STREAM") else stamp
    return sys.stderr, f"{prefix}{escape_unprintable(text)}\n"


def _write_available(stream: TextIO, line: str) -> bool:
    """Write a line as far as possible without blocking: a full pipe or a stopped terminal must not delay the daemon."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):  # a text in memory
        stream.write(line)
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    left = line.encode(stream.encoding, "replace")
    try:
        while left and poll.poll(0) == [(descriptor, select.POLLOUT)]:
            left = left[os.write(descriptor, left[: select.PIPE_BUF]) :]
    except OSError:
        return False
    return not left


def format_outcome(outcome: Outcome) -> tuple[str, Severity]:
    """Format an outcome as one line for the operator, with its severity."""
    if isinstance(outcome, Notice):
        axis = f"{outcome.axis}: " if outcome.axis else ""
        return f"{axis}{outcome.code}: {outcome.text}", outcome.severity
    if isinstance(outcome, WindowOutcome):
        return _format_window(outcome), "info"
    if isinstance(outcome, ParameterSet):
        return _format_parameter_set(outcome), "info"
    if isinstance(outcome, LoopEstimate):
        return _format_loops(outcome), "info"
    return _format_skill(outcome), "info"


def _format_window(outcome: WindowOutcome) -> str:
    window, verdict = outcome.window, outcome.verdict
    head = f"{window.axis}: G0 {'+' if window.direction > 0 else '-'} at {window.start_s:.2f} s ({window.n} samples)"
    if window.nc is not None and window.nc.line is not None:
        head += f", line {window.nc.line}"
    fit = "" if verdict.fit_percent is None else f", fit {verdict.fit_percent:.2f} %"
    if verdict.accepted:
        warned = "; ".join(str(warning) for warning in verdict.warnings)
        return f"{head} accepted{fit}" + (f", but {warned}" if warned else "")
    return f"{head} refused{fit}: " + ("; ".join(str(reason) for reason in verdict.reasons) or "no reason given")


def _format_parameter_set(published: ParameterSet) -> str:
    values = (f"{name} {getattr(published.parameters, name):.5g} {UNITS[name]}" for name in PARAMETERS)
    windows = f"{published.windows} window" + ("" if published.windows == 1 else "s")
    terms = (f"{name} {value:.5g} {get_unit(name)}" for name, value in published.parameters.terms)
    shown = ", ".join((*values, *terms))
    return f"{published.axis}: parameters, revision {published.revision} from {windows}: {shown}"


def _format_loops(found: LoopEstimate) -> str:
    gains = ", ".join(f"{name} {value:.5g}" for name, value in zip(found.names, found.values, strict=True))
    verdict = found.verdict
    result = "accepted" if verdict.accepted else "refused: " + "; ".join(str(reason) for reason in verdict.reasons)
    return f"{found.axis}: loops of structure {found.structure}, {gains}; {result}"


def _format_skill(skill: Skill) -> str:
    return (
        f"{skill.axis}: following error of the move at tick {skill.tick} predicted within {skill.rms_um:.2f} um RMS, "
        f"{skill.max_um:.2f} um at most, of {skill.measured_rms_um:.1f} um RMS"
    )


class LogThrottle:
    """A token bucket per class of line: a flood becomes a few lines and a count (time is an input)."""

    def __init__(self) -> None:
        self._buckets: dict[str, tuple[float, float, int]] = {}

    def admit_line(self, code: str, now_s: float) -> int | None:
        """Return how many lines of this class were suppressed before this one, or None to suppress it too."""
        tokens, held = self._refill_tokens(code, now_s)
        if tokens < 1.0:
            self._buckets[code] = (tokens, now_s, held + 1)
            return None
        self._buckets[code] = (tokens - 1.0, now_s, 0)
        return held

    def can_admit(self, code: str, now_s: float) -> bool:
        """Return whether a line of this class would be admitted now."""
        return self._refill_tokens(code, now_s)[0] >= 1.0

    def _refill_tokens(self, code: str, now_s: float) -> tuple[float, int]:
        tokens, then, held = self._buckets.get(code, (float(BURST), now_s, 0))
        return min(float(BURST), tokens + (now_s - then) * REFILL_PER_S), held
