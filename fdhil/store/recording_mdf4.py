"""Reads and writes recordings as ASAM MDF 4 files, a format of vehicle and machine measurement programs.

The columns are one channel group over ``time``; the headers are JSON in the file's comment. A damaged file may crash
the reading process, so that it is read in a separate one.
"""

import html
import io
import json
import re
from dataclasses import replace
from typing import Any
from xml.parsers.expat import ExpatError

import numpy as np

from fdhil.errors import FdhilError
from fdhil.records import Float
from fdhil.store.reading_process import read_in_process
from fdhil.store.recording_table import (
    COLUMNS,
    PATH,
    UNITS,
    UNREADABLE,
    RecordingTable,
    check_size,
    make_unreadable_error,
)

KIND = "MDF 4 file"
TIME = 1  # sync type of a master channel; others are angle, distance, index
MASTER = (2, 3)  # MDF 4 channel types of the time: recorded or virtual
_COMMENT = re.compile(r"<TX>(.*?)</TX>", re.DOTALL)


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of an MDF 4.10 file. Raises FdhilError without the extra ``mdf``."""
    asammdf = library()
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
    """Return the channels of each group, and of those sampled with it; ``time_s`` is the group's own time.

    Raises RecordingError if it is not an MDF file.
    """
    return read_in_process(__name__, KIND, content, source)


def read(content: bytes, source: str) -> RecordingTable:
    """Return the table, read in this process, which a damaged file may crash."""
    asammdf = library()
    if not content.startswith(b"MDF ") or content[64:68] != b"##HD":  # older versions and truncated files
        raise make_unreadable_error(source, KIND, ValueError("its beginning is different"))
    try:
        with asammdf.MDF(io.BytesIO(content)) as file:
            rows = [group.channel_group.cycles_nr for group in file.groups]
            check_size(max(rows, default=0), sum(len(group.channels) for group in file.groups), source)
            headers = _parse_headers(str(file.header.comment))
            units = {
                c.name: (str(c.unit or ""),) for g in file.groups for c in g.channels if c.channel_type not in MASTER
            }
            groups = _read_groups(file, rows)
            tables = [RecordingTable(headers, c, frozenset(), doubts, texts=units) for c, doubts in groups]
    except UnboundLocalError:  # a bug of the library with files marked as unfinished
        raise make_unreadable_error(source, KIND, ValueError("it is unfinished, or damaged")) from None
    except (asammdf.blocks.utils.MdfException, ExpatError, *UNREADABLE) as error:
        raise make_unreadable_error(source, KIND, error) from None
    # first the group with fdhil's own columns, else the largest
    own = {*COLUMNS, *PATH}
    tables.sort(key=lambda table: (len(own & table.columns.keys()), table.columns["time_s"].size), reverse=True)
    return replace(tables[0], others=tuple(tables[1:])) if tables else RecordingTable({}, {})


def _read_groups(file: Any, rows: list[int]) -> list[tuple[dict[str, Float], dict[str, str]]]:
    """Merge the channels of groups with equal times; return their columns with ``time_s``, and their doubts.

    Samples that the file marks as invalid are ``nan``.
    """
    groups: list[tuple[dict[str, Float], dict[str, str]]] = []
    for k, group in enumerate(file.groups):
        if not rows[k]:
            continue
        time_s = np.asarray(file.get_master(k), dtype=np.float64)
        columns, doubts = next((g for g in groups if np.array_equal(g[0]["time_s"], time_s)), ({"time_s": time_s}, {}))
        if len(columns) == 1:
            groups.append((columns, doubts))
        if not any(c.channel_type in MASTER and c.sync_type == TIME for c in group.channels):
            doubts["time_s"] = "is not a time: the samples have none; give sample_rate_hz under [headers]"
        for j, channel in enumerate(group.channels):
            samples, invalid = file.get(group=k, index=j, samples_only=True, ignore_invalidation_bits=True)
            values = np.asarray(samples)
            if values.ndim != 1 or values.dtype.kind not in "fiu":
                doubts.setdefault(channel.name, "contains texts or arrays: map a channel of numbers")
                continue
            is_time = channel.channel_type in MASTER
            if channel.name in columns and not is_time and channel.name != "time_s":
                doubts[channel.name] = "names two channels with the same times: export only the intended one"
            values = values.astype(np.float64)
            if invalid is not None:
                values[np.asarray(invalid, dtype=bool)] = np.nan
            columns.setdefault(channel.name, values)
    return groups


def _parse_headers(comment: str) -> dict[str, str]:
    found = _COMMENT.search(comment)
    try:
        headers = json.loads(html.unescape(found[1]) if found else comment)
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in headers.items()} if isinstance(headers, dict) else {}


def library() -> Any:
    try:
        import asammdf
    except ImportError:
        raise FdhilError("MDF 4 files need the extra 'mdf': pip install 'fdhil[mdf]'") from None
    return asammdf
