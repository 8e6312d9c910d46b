"""Keeps the frames that were on the buses before and after the guard stopped a correction, one file per trip."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from fdhil.records import Notice

FOLDER = "blackbox"
KEPT_FILES = 8


def dump(store: Path, code: str, frames: Callable[[], Mapping[str, str]]) -> Notice:
    """Write what ``frames`` gives, each bus' candump log, to ``blackbox/`` in the store; the oldest files go.

    Returns what is to be told, also when the disk refuses: the correction is off already.
    """
    folder, logs = store / FOLDER, frames()
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    file = folder / f"{stamp}-{code}.log"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text("".join(logs.values()), "ascii")
        for old in sorted(folder.glob("*.log"))[:-KEPT_FILES]:
            old.unlink()
    except OSError as error:
        text = f"{file}: the frames before the trip cannot be written ({error.strerror}); free the disk"
        return Notice("StoreFault", "minor", text)
    lines = sum(log.count("\n") for log in logs.values())
    return Notice("BlackBox", "info", f"the last {lines} frames are in {file}")
