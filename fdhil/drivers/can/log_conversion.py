"""Converts logs of all frames of a bus between formats: candump, BLF, ASC, TRC.

A log is read twice, so that the header is known before the first frame is written and no frame need be kept.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fdhil.drivers.can.logged_frame import LoggedFrame, LogHeader, assign_bus_numbers, create_error_frame
from fdhil.errors import RecordingError

_MILLISECOND_NS = 1_000_000
ERROR_FRAMES = "error frames"
ERROR_DETAILS = "class and data of error frames"
FINE_TIMES = "times finer than 1 us"
BUS_NAMES = "names of buses"


@dataclass(frozen=True, slots=True)
class ConvertedLog:
    """A log in another format. ``frames`` are in ``content``; ``left_out`` counts frames that the format cannot hold,
    ``reduced`` those that lost a part, by kind; ``buses`` has the number (candump: the name) of each bus of the log."""

    content: bytes
    frames: int
    left_out: Mapping[str, int]
    reduced: Mapping[str, int]
    buses: Mapping[str, int | str]

    def report_conversion(self) -> dict[str, Any]:
        """Return the fields of the ``--json`` report."""
        names = ("frames", "left_out", "reduced", "buses")
        return {name: getattr(self, name) for name in names}


@dataclass(slots=True)
class _LogSurvey:
    source: str
    format_name: str
    frames: int = 0
    first_ns: int = 0
    is_sent: bool = False
    is_fine: bool = False
    buses: dict[str, None] = field(default_factory=dict)
    left_out: Counter[str] = field(default_factory=Counter)
    reduced: Counter[str] = field(default_factory=Counter)

    def add_frame(self, frame: LoggedFrame) -> None:
        if _is_left_out(frame, self.format_name):
            self.left_out[ERROR_FRAMES] += 1
            return
        self.first_ns = min(self.first_ns, frame.t_ns) if self.frames else frame.t_ns
        self.frames += 1
        self.is_sent |= bool(frame.sent)
        self.buses[frame.bus] = None
        fine = frame.t_ns % 1000 != 0
        self.is_fine |= fine
        if self.format_name != "blf" and not self.keeps_fine_times:
            self.reduced[FINE_TIMES] += fine
        if self.format_name == "asc" and frame.is_error:
            generic = create_error_frame(frame.t_ns, frame.bus, frame.sent)
            self.reduced[ERROR_DETAILS] += frame != generic

    @property
    def keeps_fine_times(self) -> bool:
        """Whether nine digits are written: only where they were read, since most readers of candump logs take the
        digits for microseconds, however many there are."""
        return self.source == self.format_name == "candump"

    def build_header(self) -> LogHeader:
        start_ns = self.first_ns // _MILLISECOND_NS * _MILLISECOND_NS
        shows_received = self.is_sent or self.source == "candump"
        digits = 9 if self.is_fine and self.keeps_fine_times else 6
        return LogHeader(start_ns, assign_bus_numbers(self.buses), shows_received, digits)


def convert_log(path: Path, source: str, target: str) -> ConvertedLog:
    """Convert a log from the format ``source`` to ``target``; RecordingError when it is invalid."""
    survey, skipped = _LogSurvey(source, target), Counter[str]()
    for frame in _read_frames(path, source, skipped):
        survey.add_frame(frame)
    if not survey.frames:
        lost = "".join(f"; {count} {what}, which {target} cannot hold" for what, count in survey.left_out.items())
        raise RecordingError(f"{path} has no frame{lost}: it is not a bus log, or the bus was silent")
    header = survey.build_header()
    with TemporaryDirectory() as folder:
        part = Path(folder) / "log"
        frames = (frame for frame in _read_frames(path, source, Counter()) if not _is_left_out(frame, target))
        _load_format(target).write_frames(part, frames, header)
        content = part.read_bytes()
    reduced = survey.reduced + Counter({what: n for what, n in skipped.items() if what.startswith("the date")})
    left_out = survey.left_out + Counter({what: n for what, n in skipped.items() if what not in reduced})
    buses: Mapping[str, int | str] = header.buses
    if target == "candump":
        buses = {name: name for name in header.buses}
    elif target == "blf":
        reduced[BUS_NAMES] = sum(name != f"can{number - 1}" for name, number in header.buses.items())
    return ConvertedLog(content, survey.frames, dict(+left_out), dict(+reduced), buses)


def _is_left_out(frame: LoggedFrame, format_name: str) -> bool:
    return format_name == "trc" and frame.is_error


def _read_frames(path: Path, format_name: str, skipped: Counter[str]) -> Iterator[LoggedFrame]:
    try:
        yield from _load_format(format_name).read_frames(path, skipped)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the file and its permissions") from None


def _load_format(format_name: str) -> Any:
    return import_module(f"fdhil.drivers.can.{format_name}_log")
