"""Logs of all frames of a bus, from one program's format to another's: candump, BLF, ASC, TRC (python-can's own)."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory

import can

from fdhil.errors import RecordingError

_UNREADABLE = (
    can.CanError,
    ValueError,
    LookupError,
    OSError,
    EOFError,
    TypeError,
    AttributeError,
    struct.error,
    zlib.error,
)


def converted_log(path: Path, suffix: str) -> tuple[bytes, int]:
    """Return a log in the format of ``suffix``, and how many frames it has; RecordingError when it is none."""
    with TemporaryDirectory() as folder:
        part = Path(folder) / f"log{suffix}"
        frames = 0
        try:
            with can.LogReader(path) as reader, can.Logger(part) as writer:
                for message in reader:
                    writer.on_message_received(message)
                    frames += 1
        except _UNREADABLE as error:
            first = (str(error).splitlines() or [type(error).__name__])[0][:200]
            raise RecordingError(f"{path} is no log of a bus that can be read: {first}; copy it again") from None
        if not frames:
            raise RecordingError(f"{path} has no frame: it is no log of a bus, or nothing was on it")
        return part.read_bytes(), frames
