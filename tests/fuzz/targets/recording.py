"""Recordings of every format: read, or a RecordingError that says what to do."""

from __future__ import annotations

import os

from fdhil import tables
from fdhil.errors import RecordingError
from fdhil.store import reading_process
from fdhil.store.export import table_of
from fdhil.store.recording_table import RecordingTable, recording_of
from tests.fuzz.tasting import Target
from tests.store.made import window

WORDS = [b"fdhil-recording-1", b"sample_rate_hz", b"time_s", b"nan", b"inf", b"1e999", b"voltage_samples_V", b"\0" * 8]


def _reader() -> int | None:
    process = reading_process._PROCESSES.get(os.getpid())
    return None if process is None or process.child.poll() is not None else process.child.pid


def target_of(name: str, longest: int, words: list[bytes]) -> Target:
    """Return the target of one format."""
    form = tables.load(tables.RECORDING_FORMATS, name)
    whole = table_of(window(n=120))
    few = RecordingTable(whole.headers, {key: values[:20] for key, values in whole.columns.items()})

    def taste(data: bytes) -> None:
        if not data:
            return  # whoever reads a file asks that first
        try:
            recording_of(form.decode(data, "r"), "r")
        except RecordingError as error:
            assert len(str(error)) < 2000
            process = reading_process._PROCESSES.get(os.getpid())
            assert process is None or process.child.returncode != 1, f"its reader raised what it must not: {error}"

    def ready() -> None:
        if _reader() is None:
            taste(true)

    true = form.encode(few)
    given = (f"recording_{name}", [true], taste, [*WORDS, *words], longest)
    if name in ("csv", "parquet"):
        return Target(*given)
    return Target(*given, worker=_reader, ready=ready)
