"""Reads PEAK's TRC logs, versions 1.0 to 2.1, and writes 2.1.

Source: PEAK CAN TRC file format, 2020-07-27. Start times are taken as UTC, as python-can writes them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path

from fdhil.drivers.can.frame_ring import EXTENDED_FLAG, REMOTE_FLAG
from fdhil.drivers.can.logged_frame import (
    ERROR_STATE,
    RATE_SWITCH,
    LoggedFrame,
    LogHeader,
    create_error_frame,
    encode_fd_dlc,
    explain_parse_error,
    format_bus_name,
    format_name_remarks,
    parse_name_remark,
    read_lines,
    round_to_us,
)
from fdhil.errors import RecordingError

OTHER_ROWS = "lines that are not CAN frames"
NO_DATE = "the date, which is not in the header"
_COLUMNS = {"1.0": "N,O,I,L,D", "1.1": "N,O,d,I,L,D", "1.2": "N,O,B,d,I,L,D", "1.3": "N,O,B,d,I,R,L,D"}
_FD_TYPES = {"FD": 0, "FB": RATE_SWITCH, "FE": ERROR_STATE, "BI": RATE_SWITCH | ERROR_STATE}
_TYPE_OF_FD = {flags: name for name, flags in _FD_TYPES.items()}
_DAY_NS = 86_400_000_000_000
_EPOCH_DAYS = 25569  # 1970-01-01, counted from 1899-12-30
_WARNING_ID = "FFFFFFFF"


class _TrcHeader:
    def __init__(self) -> None:
        self.columns: Sequence[str] = ()
        self.start_ns: int | None = None
        self.names: dict[int, str] = {}
        self._version = "1.0"

    def read_line(self, line: str) -> None:
        """Read one header line; InvalidOperation for an invalid start time."""
        self.names |= dict(parse_name_remark(line))
        key, _, value = line.partition("=")
        if key == ";$FILEVERSION":
            self._version = value.strip()
        elif key == ";$STARTTIME":
            days = Decimal(value.strip().replace(",", ".")) - _EPOCH_DAYS
            self.start_ns = round_to_us(int(days * _DAY_NS)) * 1000
        elif key == ";$COLUMNS":
            self.columns = value.strip().split(",")

    def determine_columns(self) -> Sequence[str]:
        """Return the columns; ValueError where neither header nor version names them."""
        columns = self.columns or _COLUMNS.get(self._version, "").split(",")
        if not {"O", "I", "D"} <= set(columns) or not {"l", "L"} & set(columns):
            raise ValueError(f"columns of version {self._version} are unknown")
        return columns


def read_frames(path: Path, skipped: Counter[str]) -> Iterator[LoggedFrame]:
    """Yield the frames of a log; RecordingError names the first line that cannot be read."""
    head = _TrcHeader()
    columns: Sequence[str] = ()
    for number, line in read_lines(path, "latin-1"):
        try:
            if line.startswith(";"):
                head.read_line(line)
                continue
            if not line.strip():
                continue
            if not columns:
                columns = head.determine_columns()
                skipped[NO_DATE] += head.start_ns is None
            frame = _parse_row(line, columns, head)
        except (ValueError, LookupError, InvalidOperation) as error:
            raise RecordingError(f"{path}, line {number}: {explain_parse_error(error)}; copy the log again") from None
        if frame is None:
            skipped[OTHER_ROWS] += 1
        else:
            yield frame


def _parse_row(line: str, columns: Sequence[str], head: _TrcHeader) -> LoggedFrame | None:
    words = line.split()
    row = dict(zip(columns, words, strict=False))
    t_ns = (head.start_ns or 0) + int(Decimal(row["O"]) * 1_000_000)
    number = row.get("B", "1")
    bus = head.names.get(int(number)) or format_bus_name(int(number)) if number.isdecimal() else format_bus_name(1)
    kind, way = row.get("T", "DT"), row.get("d", "Rx")
    rest = words[columns.index("D") :]
    if kind == "ER" or way == "Error" or "ERROR" in rest[:1]:
        return create_error_frame(t_ns, bus)
    if kind not in ("DT", "RR", *_FD_TYPES) or way not in ("Rx", "Tx") or row["I"] == _WARNING_ID:
        return None
    can_id = int(row["I"], 16) | (EXTENDED_FLAG if len(row["I"]) > 4 else 0)
    fd = _FD_TYPES.get(kind)
    dlc = _parse_dlc(row, fd)
    if kind == "RR" or rest[:1] == ["RTR"]:
        return LoggedFrame(t_ns, bus, can_id | REMOTE_FLAG, dlc, sent=way == "Tx")
    data = bytes.fromhex("".join(rest))
    return LoggedFrame(t_ns, bus, can_id, dlc, data, fd, way == "Tx")


def _parse_dlc(row: Mapping[str, str], fd: int | None) -> int:
    if "L" in row:
        return int(row["L"])
    return encode_fd_dlc(int(row["l"])) if fd is not None else int(row["l"])


def write_frames(path: Path, frames: Iterable[LoggedFrame], header: LogHeader) -> None:
    """Write a log of version 2.1, which cannot hold error frames."""
    days = Decimal(header.start_ns) / _DAY_NS + _EPOCH_DAYS
    date = datetime.fromtimestamp(header.start_ns // 1_000_000_000, UTC)
    lines = [";$FILEVERSION=2.1", f";$STARTTIME={days:.15f}", ";$COLUMNS=N,O,T,B,I,d,R,L,D", ";"]
    lines += [f";   Start time: {date:%d.%m.%Y %H:%M:%S}.{header.start_ns // 1_000_000 % 1000:03d}.0 UTC"]
    lines += [";   Generated by fdhil", *(f";   {remark}" for remark in format_name_remarks(header))]
    lines += [";---+-- ------+------ +- +- --+----- +- +- +--- +- -- -- -- -- -- -- --"]
    with path.open("w", encoding="ascii", errors="replace", newline="\r\n") as file:
        file.writelines(f"{line}\n" for line in lines)
        for number, frame in enumerate(frames, 1):
            file.write(f"{_format_row(number, frame, header)}\n")


def _format_row(number: int, frame: LoggedFrame, header: LogHeader) -> str:
    milli, micro = divmod(round_to_us(frame.t_ns - header.start_ns), 1000)
    kind = "RR" if frame.is_remote else "DT" if frame.fd is None else _TYPE_OF_FD[frame.fd & 3]
    name = f"{frame.identifier:08X}" if frame.is_extended else f"{frame.identifier:04X}"
    head = f"{number:>7} {milli:9d}.{micro:03d} {kind} {header.buses[frame.bus]:>2} {name:>8}"
    return f"{head} {'Tx' if frame.sent else 'Rx'} -  {frame.dlc:<4} {frame.data.hex(' ').upper()}".rstrip()
