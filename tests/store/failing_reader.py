"""A format library that fails as the file's content says, in the child of the process under test."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from fdhil.store.recording_table import RecordingTable

TIME_S = np.arange(3.0)


def read(content: bytes, source: str) -> RecordingTable:
    match content:
        case b"crash":
            ctypes.string_at(0)
        case b"abort":
            os.abort()
        case b"hang":
            while True:
                pass
        case b"sleep":
            time.sleep(600)
        case b"fill":
            bytearray(300 << 20)
        case b"break":
            globals()["TIME_S"] += 1.0
            return RecordingTable({"of": source}, {"time_s": TIME_S - 1.0})
        case b"talk":
            for descriptor in list(Path("/proc/self/fd").iterdir()):
                with suppress(OSError):
                    os.write(int(descriptor.name), b"\0\0\0\4what")  # a message as the process itself sends them
        case b"interrupt":
            forking = Path(f"/proc/{os.getppid()}/stat").read_text("ascii")
            os.kill(int(forking.rpartition(")")[2].split()[1]), signal.SIGINT)  # the parent's parent
            time.sleep(600)
    return RecordingTable({"of": source}, {"time_s": TIME_S})


def library() -> None:
    """Load nothing."""
