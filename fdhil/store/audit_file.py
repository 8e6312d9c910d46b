"""Keeps the audit log: each request to the machine with its client and answer, one chained line each, append only.

``audit.jsonl`` in the store: each line carries the SHA-256 of itself and of the line before it, so that changed,
missing and moved lines are detected. Removal of the newest lines, or a complete rewrite, is not: the daemon's journal
has each answer too and may be forwarded; ``chattr +a`` protects the file itself.
"""

import errno
import fcntl
import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fdhil.errors import StoreError
from fdhil.json_lines import decode_line, encode_line
from fdhil.store.atomic_file import make_store_error, sync_folder, write_all
from fdhil.store.history_rows import TimeStamp
from fdhil.system_clock import SYSTEM_CLOCK, Clock

AUDIT_FILE_NAME = "audit.jsonl"
TAIL_BYTES = 16 * 1024
LOCKED_S, LOOK_S = 10.0, 0.01  # wait for another writer; every reader of the file can lock it, too
BEGIN = "0" * 64  # the seal before the first line
BROKEN = "is not an intact audit line: it was changed, removed or moved"


def append_entry(folder: Path, entry: Mapping[str, Any], clock: Clock = SYSTEM_CLOCK) -> None:
    """Append one entry and wait until it is on the disk. Raises StoreError.

    A line that a power cut left incomplete is terminated first; ``entries`` reports it.
    """
    path = folder / AUDIT_FILE_NAME
    try:
        with _open_for_append(path) as descriptor:
            before, whole = _read_last_seal(descriptor)
            stamp = TimeStamp.now(clock)
            time_utc = datetime.fromtimestamp(stamp.wall_s, UTC).isoformat(timespec="milliseconds")
            body = {"time": time_utc, "boot": stamp.boot, "monotonic_ns": stamp.monotonic_ns, **entry}
            line = encode_line({**body, "seal": _compute_seal(before, body)})
            write_all(descriptor, line if whole else b"\n" + line)
            os.fsync(descriptor)
            if before == BEGIN:
                sync_folder(folder)
    except OSError as error:
        raise make_store_error(path, error) from None


@contextmanager
def _open_for_append(path: Path) -> Iterator[int]:
    """Open the file for one writer at a time; a file created by root gets the folder's owner."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(path, flags, 0o640)
    try:
        _wait_for_lock(descriptor)
        if os.getuid() == 0 and not os.fstat(descriptor).st_size:
            owner = path.parent.stat()
            os.fchown(descriptor, owner.st_uid, owner.st_gid)
        yield descriptor
    finally:
        os.close(descriptor)


def _wait_for_lock(descriptor: int) -> None:
    until_s = time.monotonic() + LOCKED_S
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > until_s:
                raise OSError(errno.EBUSY, "another process holds its lock") from None
            time.sleep(LOOK_S)


def _read_last_seal(descriptor: int) -> tuple[str, bool]:
    """Return the seal that the next line is chained to, and whether the file ends with a complete line."""
    size = start = os.fstat(descriptor).st_size
    tail = last = b""
    while start and len(last) == len(tail.removesuffix(b"\n")):  # its beginning is not read yet
        start = max(0, start - max(TAIL_BYTES, size - start))
        tail = os.pread(descriptor, size - start, start)
        last = tail.removesuffix(b"\n").rpartition(b"\n")[2]
    return (_get_seal(last) if tail else BEGIN), not tail or tail.endswith(b"\n")


def _get_seal(line: bytes) -> str:
    """Return a line's own seal; without one its SHA-256, so that the chain continues and shows the damage."""
    seal = (decode_line(line) or {}).get("seal")
    return seal if isinstance(seal, str) else hashlib.sha256(line).hexdigest()


def _compute_seal(before: str, body: Mapping[str, Any]) -> str:
    return hashlib.sha256((before + json.dumps(body)).encode()).hexdigest()


def read_entries(folder: Path) -> Iterator[tuple[dict[str, Any], str | None]]:
    """Yield each entry, oldest first, and its defect, None if it is intact. Raises StoreError."""
    path = folder / AUDIT_FILE_NAME
    try:
        with path.open("rb") as file:
            before = BEGIN
            for line in file:
                yield _parse_line(line.rstrip(b"\n"), before)
                before = _get_seal(line.rstrip(b"\n"))
    except FileNotFoundError:
        return
    except OSError as error:
        text = f"{path} could not be read: {error.strerror}; check its permissions"
        raise StoreError(text) from None


def _parse_line(line: bytes, before: str) -> tuple[dict[str, Any], str | None]:
    body = decode_line(line)
    if body is None:
        return {"line": line[:200].decode("utf-8", "replace")}, BROKEN
    seal = body.pop("seal", None)
    return body, None if seal == _compute_seal(before, body) else BROKEN
