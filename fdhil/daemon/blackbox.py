"""Keeps the frames that were on the buses before and after the guard stopped a correction, one file per trip.

Files are numbered: which one is the newest does not hang on the wall clock.
"""

from __future__ import annotations

import heapq
import io
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.records import Notice
from fdhil.store.atomic import make_folder, store_error, write_file
from fdhil.system_clock import SYSTEM_CLOCK, Clock

FOLDER = "blackbox"
KEPT_FILES = 8
_TIME = "%Y%m%dT%H%M%S.%fZ"
_NAME = re.compile(r"(?:(\d{6})-)?(\d{8}T\d{6}\.\d{6}Z)-([A-Za-z0-9_]{1,40})\.log")


@dataclass(frozen=True, slots=True)
class BlackBox:
    """One file: its running ``number`` (0 in those of before there were numbers), when it was written, the class."""

    path: Path
    number: int
    written: datetime
    code: str


def kept(store: Path) -> list[BlackBox]:
    """Return the black boxes of a store, oldest first; a file of another name is none."""
    found = []
    for path in sorted((store / FOLDER).glob("*.log")):
        match = _NAME.fullmatch(path.name)
        if match is None or path.is_symlink() or not path.is_file():
            continue
        try:
            written = datetime.strptime(match[2], _TIME).replace(tzinfo=UTC)
        except ValueError:  # no such date
            continue
        found.append(BlackBox(path, int(match[1] or 0), written, match[3]))
    return sorted(found, key=lambda box: box.number)


def dump(store: Path, code: str, frames: Callable[[], Mapping[str, str]], clock: Clock = SYSTEM_CLOCK) -> Notice:
    """Write what ``frames`` gives, each bus' candump log, to ``blackbox/`` in the store; the oldest files go.

    Returns what is to be told, also when the disk refuses: the correction is off already.
    """
    folder, logs = store / FOLDER, frames()
    try:
        make_folder(folder)
        before = kept(store)
        number = max((box.number for box in before), default=0) + 1
        file = folder / f"{number:06d}-{datetime.fromtimestamp(clock.wall_s(), UTC).strftime(_TIME)}-{code}.log"
        write_file(file, _in_order(logs.values()).encode("ascii"))
        for old in before[: max(0, len(before) + 1 - KEPT_FILES)]:
            old.path.unlink()
    except (OSError, StoreError) as error:
        trouble = store_error(folder, error) if isinstance(error, OSError) else error
        return Notice(trouble.code, "minor", f"the frames around the trip are not kept: {trouble}")
    lines = sum(log.count("\n") for log in logs.values())
    return Notice("BlackBox", "info", f"the last {lines} frames are in {file}")


def _in_order(logs: Iterable[str]) -> str:
    """Return the lines of several buses as ``candump -l`` writes them: in one order of time."""
    merged = io.StringIO()  # not a list: a flood has hundreds of thousands of lines
    merged.writelines(heapq.merge(*map(io.StringIO, logs), key=lambda line: float(line[1 : line.index(")")])))
    return merged.getvalue()
