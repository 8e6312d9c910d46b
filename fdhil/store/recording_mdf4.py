"""Recordings as ASAM MDF 4 files, which measurement programs of the vehicle and machine world open.

The columns are one group of channels over ``time``; the headers stand as JSON in the comment of the file.

The library that reads them goes where a damaged file points, beyond its own memory too: it does so in a process of its
own, so that whoever reads a file lives on.
"""

from __future__ import annotations

import contextlib
import gc
import html
import io
import json
import logging
import re
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any
from xml.parsers.expat import ExpatError

import numpy as np

from fdhil.errors import FdhilError, RecordingError
from fdhil.records import Float
from fdhil.store.recording_table import UNITS, UNREADABLE, RecordingTable, check_size, unreadable

_COMMENT = re.compile(r"<TX>(.*?)</TX>", re.DOTALL)


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of an MDF 4.10 file. FdhilError without the extra ``mdf``."""
    asammdf = _asammdf()
    time_s = table.columns["time_s"]
    signals = [
        asammdf.Signal(samples=values, timestamps=time_s, name=name, unit=UNITS.get(name, ""))
        for name, values in table.columns.items()
        if name != "time_s"
    ]
    content = io.BytesIO()
    with asammdf.MDF(version="4.10") as file:
        file.append(signals, comment="feed drive", common_timebase=True)
        file.header.comment = json.dumps(dict(table.headers))
        file.save(content)
    return content.getvalue()


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the channels of the largest group, and of those sampled with it; ``time_s`` is the group's own time.

    RecordingError when it is no MDF file.
    """
    _require()
    if not content.startswith(b"MDF ") or content[64:68] != b"##HD":  # its reader cannot tell this quietly
        raise unreadable(source, "MDF 4 file", ValueError("it does not begin as one"))
    reader = _reader()
    try:
        reader.send((content, source))
        read = reader.recv()
    except (EOFError, OSError):
        _reader.cache_clear()
        raise unreadable(source, "MDF 4 file", EOFError("its reader did not survive it")) from None
    if isinstance(read, RecordingError):
        raise read
    table: RecordingTable = read
    return table


@cache
def _reader() -> Connection:
    """Return the way to the process that reads; it is begun with the first file and ends with this one."""
    spawning = get_context("spawn")
    here, there = spawning.Pipe()
    spawning.Process(target=_serve, args=(there,), daemon=True).start()
    there.close()
    return here


def _serve(asked: Connection) -> None:
    """Read one file after another, until nobody asks any more."""
    while True:
        try:
            content, source = asked.recv()
        except EOFError:
            return
        try:
            asked.send(_decoded(content, source))
        except RecordingError as refusal:
            asked.send(refusal)


def _decoded(content: bytes, source: str) -> RecordingTable:
    asammdf = _asammdf()
    with _quiet():
        try:
            return _read(asammdf, content, source)
        except (asammdf.blocks.utils.MdfException, ExpatError, *UNREADABLE) as error:
            refusal = unreadable(source, "MDF 4 file", error)
    raise refusal


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the reader, and its half-made objects as they go, from complaining on standard error."""
    log = logging.getLogger("asammdf")
    before, said = sys.unraisablehook, log.disabled
    sys.unraisablehook, log.disabled = (lambda _: None), True
    try:
        yield
    finally:
        gc.collect()
        sys.unraisablehook, log.disabled = before, said


def _read(asammdf: Any, content: bytes, source: str) -> RecordingTable:
    with asammdf.MDF(io.BytesIO(content)) as file:
        rows = [group.channel_group.cycles_nr for group in file.groups]
        check_size(max(rows, default=0), sum(len(group.channels) for group in file.groups), source)
        return RecordingTable(_headers(str(file.header.comment)), _channels(file, rows))


def _channels(file: Any, rows: list[int]) -> dict[str, Float]:
    if not rows:
        return {}
    time_s = np.asarray(file.get_master(int(np.argmax(rows))), dtype=np.float64)
    columns: dict[str, Float] = {"time_s": time_s}
    for k, group in enumerate(file.groups):
        if rows[k] != time_s.size or not np.array_equal(file.get_master(k), time_s):
            continue  # sampled at other times
        for j, channel in enumerate(group.channels):
            values = np.asarray(file.get(group=k, index=j).samples)
            if values.ndim == 1 and values.dtype.kind in "fiu":
                columns.setdefault(channel.name, values.astype(np.float64))
    return columns


def _headers(comment: str) -> dict[str, str]:
    """Return the headers in a file's comment; none where another program wrote it."""
    found = _COMMENT.search(comment)
    try:
        told = json.loads(html.unescape(found[1]) if found else comment)
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in told.items()} if isinstance(told, dict) else {}


def _require() -> None:
    """Raise FdhilError where what reads them is not installed."""
    if find_spec("asammdf") is None:
        raise FdhilError("MDF 4 files need the extra 'mdf': pip install 'fdhil[mdf]'")


def _asammdf() -> Any:
    _require()
    import asammdf

    return asammdf
