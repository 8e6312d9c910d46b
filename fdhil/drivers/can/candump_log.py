"""Reads and writes logs of ``candump -l`` and ``-L`` (can-utils); the black box uses this format too."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from fdhil.drivers.can.logged_frame import (
    CLASSIC_BYTES,
    IDENTIFIER_MASK,
    LoggedFrame,
    LogHeader,
    encode_fd_dlc,
    parse_decimal_ns,
    read_lines,
    round_to_us,
)
from fdhil.errors import RecordingError

_LINE = re.compile(
    r"\((?P<time>\d{1,12}\.\d{1,9})\)\s+(?P<bus>\S{1,64})\s+(?P<id>[0-9A-F]{8}|[0-9A-F]{3})#"
    r"(?:R(?P<asked>[0-8]?)|(?:\#(?P<fd>[0-9A-F]))?(?P<data>(?:[0-9A-F]{2})*))(?:_(?P<raw>[9A-F]))?"
    r"(?:\s+(?P<way>[RT]))?",
    re.ASCII | re.IGNORECASE,
)
_SCREEN = re.compile(r"(\(.{1,40}\))?\s*\S+\s+([RT]X [B-] [E-]\s+)?[0-9A-F]{3,8}\s+\[\d+\]", re.ASCII)
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_RAW_FLAGS = REMOTE_FLAG | EXTENDED_FLAG  # in black boxes of former versions


def parse_line(line: str) -> LoggedFrame:
    """Parse one line; ValueError when it is not a frame."""
    match = _LINE.fullmatch(line.strip())
    if match is None:
        raise ValueError("a line that is not a frame")
    name, asked, flags, raw = match["id"], match["asked"], match["fd"], match["raw"]
    data = b"" if asked is not None else bytes.fromhex(match["data"])
    fd = None if flags is None else int(flags, 16)
    if raw is not None:
        dlc = int(raw, 16)
    elif asked is not None:
        dlc = int(asked or "0")
    else:
        dlc = encode_fd_dlc(len(data)) if fd is not None else len(data)
    if dlc > CLASSIC_BYTES and fd is None and raw is None:
        raise ValueError(f"{dlc} bytes in a classic frame")
    can_id = _add_extended_flag(int(name, 16), len(name) > 3) | (0 if asked is None else REMOTE_FLAG)
    sent = None if match["way"] is None else match["way"] in "Tt"
    return LoggedFrame(parse_decimal_ns(match["time"]), match["bus"], can_id, dlc, data, fd, sent)


def _add_extended_flag(can_id: int, is_long: bool) -> int:
    return can_id | EXTENDED_FLAG if is_long and not can_id & (ERROR_FLAG | _RAW_FLAGS) else can_id


def format_frame(frame: LoggedFrame, header: LogHeader) -> str:
    second, fraction = divmod(frame.t_ns if header.digits == 9 else round_to_us(frame.t_ns), 10**header.digits)
    stamp = f"({second}.{fraction:0{header.digits}d})"
    raw = f"_{frame.dlc:X}" if frame.fd is None and frame.dlc > CLASSIC_BYTES else ""
    way = " T" if frame.sent else " R" if frame.sent is False and header.shows_received else ""
    return f"{stamp} {frame.bus} {format_id(frame.can_id)}#{_format_data(frame)}{raw}{way}\n"


def format_id(can_id: int) -> str:
    """Format an identifier with the flags of SocketCAN as candump does.

    >>> format_id(0x181), format_id(REMOTE_FLAG | 0x701), format_id(EXTENDED_FLAG | 0x123), format_id(ERROR_FLAG | 4)
    ('181', '701', '00000123', '20000004')
    """
    if can_id & ERROR_FLAG:
        return f"{can_id & (ERROR_FLAG | IDENTIFIER_MASK):08X}"
    return f"{can_id & IDENTIFIER_MASK:08X}" if can_id & EXTENDED_FLAG else f"{can_id & 0x7FF:03X}"


def _format_data(frame: LoggedFrame) -> str:
    if frame.is_remote:
        return f"R{min(frame.dlc, CLASSIC_BYTES)}" if frame.dlc else "R"
    return ("" if frame.fd is None else f"#{frame.fd:X}") + frame.data.hex().upper()


def read_frames(path: Path, _skipped: Counter[str]) -> Iterator[LoggedFrame]:
    """Yield the frames of a log; RecordingError names the first invalid line."""
    for number, line in read_lines(path, "ascii"):
        if not line.strip():
            continue
        try:
            yield parse_line(line)
        except (ValueError, IndexError) as error:
            raise RecordingError(f"{path}, line {number}: {_explain_line(line, error)}") from None


def _explain_line(line: str, error: Exception) -> str:
    if _SCREEN.match(_COLOUR.sub("", line).strip()):
        text = "this is candump's screen output, not its log; record with candump -l, or with "
        return text + "candump -L can0 > bus.log"
    return f"{error}, so the log cannot be read; copy it again, or remove what candump -l did not write"


def write_frames(path: Path, frames: Iterable[LoggedFrame], header: LogHeader) -> None:
    """Write a log as ``candump -l`` does; frames are marked R and T where the log distinguishes them."""
    with path.open("w", encoding="ascii", errors="replace") as file:
        file.writelines(format_frame(frame, header) for frame in frames)
