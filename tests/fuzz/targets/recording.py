"""Recordings of every format: read, or a RecordingError with advice.

The product reads each file in a fork. Here one fork reads until a file ends it, which is ten times as fast; that a
fork's end is reported as a refusal is tested elsewhere.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

from fdhil import tables
from fdhil.errors import FdhilError, RecordingError
from fdhil.store import reading_process
from fdhil.store.recording_table import RecordingTable, make_recording
from fdhil.store.window_export import convert_window
from tests.fuzz.input_assessment import Target
from tests.store.sample_records import make_window

WORDS = [b"fdhil-recording-1", b"sample_rate_hz", b"time_s", b"nan", b"inf", b"1e999", b"voltage_samples_V", b"\0" * 8]
RAISED = 1
_FORKS = multiprocessing.get_context("fork")


class _FormatReader:
    """The fork that reads with the module of a format."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module
        self._fork: Any = None
        self._asked: Connection

    @property
    def pid(self) -> int | None:
        return self._fork.pid if self._fork is not None and self._fork.is_alive() else None

    def start_fork(self) -> None:
        if self.pid is None:
            self._asked, there = _FORKS.Pipe()
            self._fork = _FORKS.Process(target=_read_all, args=(self._module, there, self._asked), daemon=True)
            self._fork.start()
            there.close()

    def read_file(self, data: bytes) -> RecordingTable | FdhilError:
        self.start_fork()
        try:
            self._asked.send_bytes(data)
            return reading_process.receive_table(self._asked)
        except (EOFError, OSError, ValueError):
            self._fork.join()
            self._asked.close()
            assert self._fork.exitcode != RAISED, f"{self._module.__name__}.read raised what it must not, see above"
            return RecordingError("its reader crashed")


def _read_all(module: Any, asked: Connection, others: Connection) -> None:
    others.close()  # its end must be detected
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        signal.signal(number, signal.SIG_DFL)  # the fuzzer has its own handlers
    faulthandler.disable()
    reported = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries report damage there
    module.library()
    while True:
        try:
            content = asked.recv_bytes()
        except EOFError:
            return
        try:
            reading_process.send_table(asked, module, content, "r", reading_process.LONGEST_S)
        except BaseException:  # noqa: BLE001 - whatever is not declared is what is looked for
            traceback.print_exc(file=reported)
            reported.flush()
            sys.exit(RAISED)


def target_of(name: str, longest: int, words: list[bytes]) -> Target:
    form = tables.load_entry(tables.RECORDING_FORMATS, name)
    whole = convert_window(make_window(n=120))
    few = RecordingTable(whole.headers, {key: values[:20] for key, values in whole.columns.items()})
    reader = _FormatReader(form) if hasattr(form, "library") else None

    def taste(data: bytes) -> None:
        if not data:
            return  # every reader checks that first
        try:
            table = form.decode(data, "r") if reader is None else reader.read_file(data)
            if isinstance(table, FdhilError):
                raise table
            make_recording(table, "r")
        except RecordingError as error:
            assert len(str(error)) < 2000

    given = (f"recording_{name}", [form.encode(few)], taste, [*WORDS, *words], longest)
    return Target(*given) if reader is None else Target(*given, worker=lambda: reader.pid, ready=reader.start_fork)
