"""Vector's ASC logs, as ``log2asc`` (can-utils), python-can and CANoe write them. Their dates are local time."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from fdhil.drivers.can.frame_ring import EXTENDED_FLAG, REMOTE_FLAG
from fdhil.drivers.can.logged_frame import (
    CLASSIC_BYTES,
    ERROR_STATE,
    FD_LENGTHS,
    RATE_SWITCH,
    LoggedFrame,
    LogHeader,
    create_error_frame,
    explain_parse_error,
    format_bus_name,
    format_name_remarks,
    parse_decimal_ns,
    parse_name_remark,
    read_lines,
    round_to_us,
)
from fdhil.errors import RecordingError

OTHER_EVENTS = "events that are not CAN frames"
NO_DATE = "the date, which is unreadable"
_EVENT = re.compile(r"\s*(\d+\.\d+)\s+(\S.*)")
_HEAD = re.compile(
    r"\s*(?://\s*fdhil: start (?P<start>\d+\.\d+)|date\s+(?P<date>.+)"
    r"|begin\s+triggerblock\s+(?P<trigger>.+)|base\s+(?P<base>hex|dec)(?:\s+timestamps\s+(?P<times>absolute|relative))?)",
    re.IGNORECASE | re.ASCII,
)
_DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_MONTHS = {
    name: month
    for names in ("Jan Feb Mar Apr May Jun Jul Aug Sep Oct Nov Dec", "Jan Feb Mär Apr Mai Jun Jul Aug Sep Okt Nov Dez")
    for month, name in enumerate(names.split(), 1)
}
_DATE = re.compile(
    r"\s*\S+\s+(?P<month>\w{3})\S*\s+(?P<day>\d{1,2})\s+(?P<h>\d{1,2}):(?P<m>\d\d):(?P<s>\d\d)(?:\.(?P<part>\d{1,6}))?"
    r"\s*(?P<half>[ap]m)?\s+(?P<year>\d{4})",
    re.IGNORECASE,
)
_REMOTE, _FD, _RATE_SWITCH, _ERROR_STATE = 1 << 4, 1 << 12, 1 << 13, 1 << 14  # of a CANFD event


def parse_date_ns(text: str) -> int | None:
    """Parse a header's date, local time, into ns since 1970; None where it is invalid.

    >>> parse_date_ns("Wed May  1 10:00:00 2024") == parse_date_ns("Mit Mai 1 10:00:00.000 am 2024")
    True
    """
    match = _DATE.match(text)
    if match is None or (month := _MONTHS.get(match["month"].capitalize())) is None:
        return None
    hour = int(match["h"])
    if match["half"]:
        hour = hour % 12 + 12 * (match["half"].lower() == "pm")
    try:
        day = datetime(int(match["year"]), month, int(match["day"]), hour, int(match["m"]), int(match["s"]))
        return int(day.timestamp()) * 1_000_000_000 + int((match["part"] or "0").ljust(9, "0"))
    except (ValueError, OverflowError):
        return None


class _AscHeader:
    def __init__(self) -> None:
        self.names: dict[int, str] = {}
        self.base = 16
        self.relative = False
        self._exact_ns: int | None = None
        self._date_ns: int | None = None
        self._trigger_ns: int | None = None
        self._from_trigger = False

    def read_line(self, line: str) -> None:
        self.names |= dict(parse_name_remark(line))
        match = _HEAD.match(line)
        if match is None:
            return
        if match["start"]:
            self._exact_ns = parse_decimal_ns(match["start"])
        elif match["base"]:
            self.base = 16 if match["base"].lower() == "hex" else 10
            self.relative = (match["times"] or "").lower() == "relative"
        elif match["date"]:
            self._date_ns = parse_date_ns(match["date"])
        elif self._trigger_ns is None:
            self._trigger_ns = parse_date_ns(match["trigger"])

    def begin_measurement(self) -> None:
        """Count times from the trigger's date."""
        self._from_trigger = True

    @property
    def start_ns(self) -> int | None:
        """Start time, ns since 1970; None where no date can be read."""
        dates = [self._exact_ns, self._date_ns, self._trigger_ns]
        if self._from_trigger:
            dates.insert(1, self._trigger_ns)
        return next((date for date in dates if date is not None), None)


def read_frames(path: Path, skipped: Counter[str]) -> Iterator[LoggedFrame]:
    """Yield the frames of a log; RecordingError names the first line of a frame that cannot be read."""
    head, now_ns, begun = _AscHeader(), 0, False
    for number, line in read_lines(path, "utf-8"):
        event = _EVENT.match(line)
        if event is None:
            head.read_line(line)
            continue
        now_ns = now_ns + parse_decimal_ns(event[1]) if head.relative else parse_decimal_ns(event[1])
        if event[2].lower().startswith("start of measurement"):
            head.begin_measurement()
            continue
        if not begun and head.start_ns is None:
            skipped[NO_DATE] += 1
        begun = True
        try:
            frame = _parse_event(event[2].split(), (head.start_ns or 0) + now_ns, head)
        except (ValueError, IndexError) as error:
            raise RecordingError(f"{path}, line {number}: {explain_parse_error(error)}; copy the log again") from None
        if frame is None:
            skipped[OTHER_EVENTS] += 1
        else:
            yield frame


def _parse_event(words: Sequence[str], t_ns: int, head: _AscHeader) -> LoggedFrame | None:
    is_fd = words[0] == "CANFD"
    words = words[1:] if is_fd else words
    if not words[0].isdecimal() or len(words) < 2:
        return None
    bus = head.names.get(int(words[0])) or format_bus_name(int(words[0]))
    if "errorframe" in (word.lower() for word in words[1:3]):
        return create_error_frame(t_ns, bus)
    name, way = (words[2], words[1]) if is_fd else (words[1], words[2] if len(words) > 2 else "")
    if way not in ("Rx", "Tx"):
        return None
    can_id = int(name.rstrip("xX"), head.base) | (EXTENDED_FLAG if name[-1] in "xX" else 0)
    parse = _parse_fd_frame if is_fd else _parse_classic_frame
    return parse(words[3:], t_ns, bus, can_id, head.base, way == "Tx")


def _parse_classic_frame(words: Sequence[str], t_ns: int, bus: str, can_id: int, base: int, sent: bool) -> LoggedFrame:
    if words[0] == "r":
        asked = int(words[1], base) if len(words) > 1 and words[1] != "Length" else 0
        return LoggedFrame(t_ns, bus, can_id | REMOTE_FLAG, asked, sent=sent)
    if words[0] != "d":
        raise ValueError(f"{words[0]!r} where d or r is expected")
    dlc = int(words[1], base)
    data = bytes(int(word, base) for word in words[2 : 2 + min(dlc, CLASSIC_BYTES)])
    return LoggedFrame(t_ns, bus, can_id, dlc, data, sent=sent)


def _parse_fd_frame(words: Sequence[str], t_ns: int, bus: str, can_id: int, base: int, sent: bool) -> LoggedFrame:
    words = words if words[0] in ("0", "1") else words[1:]  # a symbolic name
    dlc, length = int(words[2], 16), int(words[3])
    data, rest = bytes(int(word, base) for word in words[4 : 4 + length]), words[4 + length :]
    flags = int(rest[2], 16) if len(rest) > 2 else _FD
    if flags & _REMOTE:
        return LoggedFrame(t_ns, bus, can_id | REMOTE_FLAG, dlc, sent=sent)
    fd = (RATE_SWITCH if words[0] == "1" else 0) | (ERROR_STATE if words[1] == "1" else 0)
    return LoggedFrame(t_ns, bus, can_id, dlc, data, fd if flags & _FD else None, sent)


def write_frames(path: Path, frames: Iterable[LoggedFrame], header: LogHeader) -> None:
    """Write a log with absolute times, counted from the date in its header."""
    start = datetime.fromtimestamp(header.start_ns // 1_000_000_000, UTC).astimezone()
    month = next(name for name, number in _MONTHS.items() if number == start.month)
    day = _DAYS[start.weekday()]
    part = header.start_ns // 1_000_000 % 1000
    date = f"{day} {month} {start:%d %H:%M:%S}.{part:03d} {start.year}"
    exact = f"fdhil: start {header.start_ns // 1_000_000_000}.{part:03d} s since 1970, UTC"
    lines = [f"date {date}", "base hex  timestamps absolute", "internal events logged"]
    lines += [f"// {remark}" for remark in (exact, *format_name_remarks(header))]
    lines += [f"Begin Triggerblock {date}", "   0.000000 Start of measurement"]
    with path.open("w", encoding="utf-8") as file:
        file.writelines(f"{line}\n" for line in lines)
        for frame in frames:
            second, micro = divmod(round_to_us(frame.t_ns - header.start_ns), 1_000_000)
            file.write(f"{second:4d}.{micro:06d} {_format_event(frame, header.buses[frame.bus])}\n")
        file.write("End TriggerBlock\n")


def _format_event(frame: LoggedFrame, bus: int) -> str:
    way = "Tx" if frame.sent else "Rx"
    name = f"{frame.identifier:X}{'x' if frame.is_extended else ''}"
    data = frame.data.hex(" ").upper()
    if frame.is_error:
        return f"{bus}  ErrorFrame"
    if frame.fd is None:
        what = f"r {frame.dlc:x}" if frame.is_remote else f"d {frame.dlc:x} {data}"
        return f"{bus}  {name:<15} {way}   {what}".rstrip()
    switch, state = frame.fd & RATE_SWITCH, frame.fd & ERROR_STATE
    flags = _FD | (_RATE_SWITCH if switch else 0) | (_ERROR_STATE if state else 0)
    head = f"CANFD {bus:>3} {way} {name:>10} {'':>32} {int(bool(switch))} {int(bool(state))} {frame.dlc:x}"
    return f"{head} {FD_LENGTHS[frame.dlc]:>2} {data} {0:>8} {0:>4} {flags:>8X} 0 0 0 0 0"
