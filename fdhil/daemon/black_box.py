"""Keeps the frames on the buses before and after the guard stopped a correction, one file per trip.

Files are numbered, so that their order does not depend on the wall clock.
"""

import heapq
import io
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.records import Notice
from fdhil.store import make_folder, make_store_error, write_file
from fdhil.system_clock import SYSTEM_CLOCK, Clock

BLACK_BOX_FOLDER = "blackbox"
KEPT_FILES = 8
_TIME = "%Y%m%dT%H%M%S.%fZ"
_NAME = re.compile(r"(?:(\d{6})-)?(\d{8}T\d{6}\.\d{6}Z)-([A-Za-z0-9_]{1,40})\.log")


@dataclass(frozen=True, slots=True)
class BlackBoxFile:
    """One file: its running ``number`` (0 in files of older versions), its date and its class."""

    path: Path
    number: int
    written: datetime
    code: str


def find_black_boxes(store: Path) -> list[BlackBoxFile]:
    """Return the black boxes of a store, oldest first; files with other names are ignored."""
    found = []
    for path in sorted((store / BLACK_BOX_FOLDER).glob("*.log")):
        match = _NAME.fullmatch(path.name)
        if match is None or path.is_symlink() or not path.is_file():
            continue
        try:
            written = datetime.strptime(match[2], _TIME).replace(tzinfo=UTC)
        except ValueError:  # no such date
            continue
        found.append(BlackBoxFile(path, int(match[1] or 0), written, match[3]))
    return sorted(found, key=lambda box: box.number)


def write_black_box(
    store: Path, code: str, frames: Callable[[], Mapping[str, str]], clock: Clock = SYSTEM_CLOCK
) -> Notice:
    """Write ``frames``, each bus' candump log, to ``blackbox/`` in the store; delete the oldest files.

    Returns a notice even when the disk refuses: the correction is already off.
    """
    folder, logs = store / BLACK_BOX_FOLDER, frames()
    try:
        make_folder(folder)
        before = find_black_boxes(store)
        number = max((box.number for box in before), default=0) + 1
        file = folder / f"{number:06d}-{datetime.fromtimestamp(clock.wall_s(), UTC).strftime(_TIME)}-{code}.log"
        write_file(file, _merge_logs(logs.values()).encode("ascii"))
        for old in before[: max(0, len(before) + 1 - KEPT_FILES)]:
            old.path.unlink()
    except (OSError, StoreError) as error:
        trouble = make_store_error(folder, error) if isinstance(error, OSError) else error
        return Notice(trouble.code, "minor", f"the frames around the trip could not be stored: {trouble}")
    lines = sum(log.count("\n") for log in logs.values())
    return Notice("BlackBox", "info", f"the last {lines} frames are in {file}")


def _merge_logs(logs: Iterable[str]) -> str:
    """Merge the lines of several buses by time, as ``candump -l`` writes them."""
    merged = io.StringIO()  # not a list: a flood has hundreds of thousands of lines
    merged.writelines(heapq.merge(*map(io.StringIO, logs), key=lambda line: float(line[1 : line.index(")")])))
    return merged.getvalue()
