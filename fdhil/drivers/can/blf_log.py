"""Vector's BLF logs, by python-can."""

import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import can
from can.io.blf import BLFParseError

from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from fdhil.drivers.can.logged_frame import (
    ERROR_STATE,
    FD_LENGTHS,
    RATE_SWITCH,
    LoggedFrame,
    LogHeader,
    create_error_frame,
    encode_fd_dlc,
    format_bus_name,
)
from fdhil.errors import RecordingError

OTHER_OBJECTS = "objects that are not CAN frames"
NO_DATE = "the date, which is not in the header"
_DATED_S = 631152000  # python-can cannot write a date before 1990: times count from 1970 then
_APPLICATION = 8  # header byte that names the program: others store an identifier in error frames
_UNREADABLE = (BLFParseError, ValueError, LookupError, EOFError, TypeError, OSError, struct.error, zlib.error)


def read_frames(path: Path, skipped: Counter[str]) -> Iterator[LoggedFrame]:
    """Yield the frames of a log; RecordingError."""
    frames = 0
    try:
        with path.open("rb") as file:
            of_socketcan = file.read(_APPLICATION + 1)[_APPLICATION:] == bytes([can.BLFWriter.application_id])
            file.seek(0)
            reader = can.BLFReader(file)
            start_ns = round(reader.start_timestamp * 1e3) * 1_000_000
            reader.start_timestamp = 0.0  # a float of seconds since 1970 loses microseconds
            for message in reader:
                frames += 1
                yield _convert_message(message, start_ns, of_socketcan)
            skipped[OTHER_OBJECTS] += max(0, reader.object_count - frames)
    except _UNREADABLE as error:
        what = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise RecordingError(f"{path} is not a readable BLF log ({what}); copy it again") from None


def _convert_message(message: can.Message, start_ns: int, of_socketcan: bool) -> LoggedFrame:
    can_id = message.arbitration_id | (EXTENDED_FLAG if message.is_extended_id else 0)
    can_id |= REMOTE_FLAG if message.is_remote_frame else 0
    data, fd = bytes(message.data), None
    dlc = message.dlc
    if message.is_fd:
        fd = (RATE_SWITCH if message.bitrate_switch else 0) | (ERROR_STATE if message.error_state_indicator else 0)
        dlc = encode_fd_dlc(len(data))
    t_ns = start_ns + round(message.timestamp * 1e9)
    bus = format_bus_name(message.channel + 1 if isinstance(message.channel, int) else 1)
    if message.is_error_frame:
        if not of_socketcan:
            return create_error_frame(t_ns, bus)
        return LoggedFrame(t_ns, bus, ERROR_FLAG | message.arbitration_id, dlc, data)
    return LoggedFrame(t_ns, bus, can_id, dlc, data, fd, not message.is_rx)


def write_frames(path: Path, frames: Iterable[LoggedFrame], header: LogHeader) -> None:
    """Write a log; bus names become numbers."""
    start_ns = header.start_ns if header.start_ns >= _DATED_S * 1_000_000_000 else 0
    writer = can.BLFWriter(path)
    writer.start_timestamp = 0.0  # offsets without seconds since 1970 are exact
    try:
        for frame in frames:
            writer.on_message_received(_create_message(frame, start_ns, header.buses[frame.bus]))
        writer.start_timestamp = start_ns / 1e9
        writer.stop_timestamp = start_ns / 1e9 + (writer.stop_timestamp or 0.0)
    finally:
        writer.stop()


def _create_message(frame: LoggedFrame, start_ns: int, bus: int) -> can.Message:
    fd = frame.fd or 0
    return can.Message(
        timestamp=(frame.t_ns - start_ns + 0.5) / 1e9,  # the library cuts what is below 1 ns
        arbitration_id=frame.identifier,
        is_extended_id=frame.is_extended,
        is_remote_frame=frame.is_remote,
        is_error_frame=frame.is_error,
        is_fd=frame.fd is not None,
        bitrate_switch=bool(fd & RATE_SWITCH),
        error_state_indicator=bool(fd & ERROR_STATE),
        is_rx=not frame.sent,
        channel=bus - 1,
        dlc=FD_LENGTHS[frame.dlc] if frame.fd is not None else frame.dlc,
        data=frame.data,
    )
