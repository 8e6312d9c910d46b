"""Stands for a library that a damaged file leads astray: the content says how, the child of the process under test."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time

import numpy as np

from fdhil.store.recording_table import RecordingTable


def read(content: bytes, source: str) -> RecordingTable:
    """Do what the content says."""
    match content:
        case b"crash":
            ctypes.string_at(0)
        case b"abort":
            os.abort()
        case b"hang":
            while True:
                pass
        case b"fill":
            bytearray(1 << 33)
        case b"talk":
            os.write(int(sys.argv[1]), b"\0\0\0\4what")  # a message as the process itself sends them
        case b"interrupt":
            os.kill(os.getppid(), signal.SIGINT)
            time.sleep(600)
    return RecordingTable({"of": source}, {"time_s": np.arange(3.0)})
