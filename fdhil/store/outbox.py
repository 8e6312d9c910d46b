"""The outbox: the rows of the history that are to be sent to the fleet server, in the order of writing.

An entry is written in the same transaction as its row, and only if the configuration has [uplink]; earlier rows are
entered when the daemon first starts with it. The sender (``fdhil uplink``) reads the history and writes its own
position next to it; the daemon never waits. An entry is deleted once it was sent, or when more than ``keep_unsent``
wait: then the oldest are dropped and counted.
"""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fdhil.config import Uplink
from fdhil.errors import StoreError
from fdhil.store import HISTORY_FILE, history_schema
from fdhil.store.atomic_file import write_file

POSITION_FILE = "position.json"
LARGEST_POSITION = 4096  # bytes of that file
PRUNE_EVERY = 1_000  # entries
PRUNE_AT_MOST = 5_000  # entries at once: a few milliseconds
# table -> kind of its rows at the fleet server
KINDS: Mapping[str, str] = {
    "windows": "window",
    "revisions": "parameters",
    "skills": "skill",
    "loops": "loops",
    "notices": "notice",
    "acknowledgements": "acknowledgement",
}


# [uplink] windows, as a condition on a window's row
_WHOLE = {
    "all": "file <> ''",
    "refused": "file <> '' AND NOT accepted",
    "some": "file <> '' AND id % {every} = 1 % {every}",
    "none": "0",
}
_NEW_IDENTITY = """
BEGIN IMMEDIATE; DELETE FROM outbox; UPDATE sqlite_sequence SET seq = 0 WHERE name = 'outbox';
UPDATE outbox_of SET store = lower(hex(randomblob(16))), dropped = 0; COMMIT
"""
_OF_NO_AXIS = {"acknowledgements": "''"}


@dataclass(frozen=True, slots=True)
class OutboxPosition:
    """How far the outbox of ``store`` is sent: the last entry and its message; ``about``: the machine's description."""

    store: str = ""
    entry: int = 0
    message: str = ""
    about: str = ""

    def is_beyond(self, newest: int, store: str) -> bool:
        """Return whether more was sent than the store has: it is an older copy, all of which was sent."""
        return self.store == store and self.entry > newest


def read_position(folder: Path) -> OutboxPosition:
    """Return how far the outbox was sent; the beginning if unknown, so that everything is sent again."""
    try:
        with (folder / POSITION_FILE).open("rb") as file:
            document = json.loads(file.read(LARGEST_POSITION))
        position = OutboxPosition(**document)
    except (OSError, ValueError, TypeError, RecursionError):
        return OutboxPosition()
    kinds = all(isinstance(getattr(position, name), str) for name in ("store", "message", "about"))
    return position if kinds and type(position.entry) is int and 0 <= position.entry < 1 << 63 else OutboxPosition()


def write_position(folder: Path, position: OutboxPosition) -> None:
    write_file(folder / POSITION_FILE, json.dumps(asdict(position)).encode())


class Outbox:
    """Adds an outbox entry to each row of the history (``History.open(directory, also=outbox.enter)``)."""

    def __init__(self, settings: Uplink, folder: Path) -> None:
        self._settings = settings
        self._folder = folder
        self._windows = Counter[str]()

    def add_entry(self, db: sqlite3.Connection, table: str, row: Mapping[str, Any]) -> None:
        if table not in KINDS:
            return
        axis = row.get("axis") or ""
        entry = (table, row["id"], axis, row["digest"], int(table == "windows" and self._is_sent_whole(row)))
        added = db.execute("INSERT INTO outbox (of, row, axis, message, with_file) VALUES (?, ?, ?, ?, ?)", entry)
        number = int(added.lastrowid or 0)
        if number % PRUNE_EVERY == 0:
            self._prune(db, number)

    def add_earlier_rows(self, db: sqlite3.Connection) -> None:
        """Add entries once for the newest rows recorded before there was an [uplink]. Raises sqlite3.Error.

        An older copy of the history, of which more was sent than it has, gets an identity of its own.
        """
        if begun := db.execute("SELECT seq, store FROM sqlite_sequence, outbox_of WHERE name = 'outbox'").fetchone():
            position = read_position(self._folder)
            if position.is_beyond(*begun):
                db.executescript(_NEW_IDENTITY)
            return
        whole = _WHOLE[self._settings.windows].format(every=self._settings.every_window)
        tables = " UNION ALL ".join(
            f"SELECT '{table}' AS of, id AS row, {_OF_NO_AXIS.get(table, 'axis')} AS axis, digest AS message, "
            f"{whole if table == 'windows' else 0} AS with_file, {place} AS place, "
            f"max(wall_s) OVER (ORDER BY id) AS at FROM {table} WHERE digest <> ''"
            for place, table in enumerate(KINDS)
        )  # a clock that was set back must not change a table's order
        newest = f"SELECT * FROM ({tables}) ORDER BY at DESC, place DESC, row DESC LIMIT ?"
        db.execute(
            "INSERT INTO outbox (of, row, axis, message, with_file) "
            f"SELECT of, row, axis, message, with_file FROM ({newest}) ORDER BY at, place, row",
            (self._settings.keep_unsent,),
        )

    def _is_sent_whole(self, window: Mapping[str, Any]) -> bool:
        self._windows[window["axis"]] += 1
        if not window["file"]:
            return False
        if self._settings.windows == "some":
            return self._windows[window["axis"]] % self._settings.every_window == 1 % self._settings.every_window
        return self._settings.windows == "all" or (self._settings.windows == "refused" and not window["accepted"])

    def _prune(self, db: sqlite3.Connection, newest: int) -> None:
        """Delete sent entries and the oldest beyond the limit; the last sent entry stays as a reference."""
        sent = _find_last_sent(db, read_position(self._folder))
        (oldest,) = db.execute("SELECT min(id) FROM outbox").fetchone()
        until = min(max(sent, newest - self._settings.keep_unsent + 1), oldest + PRUNE_AT_MOST)
        db.execute("DELETE FROM outbox WHERE id < ?", (until,))
        if (dropped := until - max(sent + 1, oldest)) > 0:
            db.execute("UPDATE outbox_of SET dropped = dropped + ?", (dropped,))


def _find_last_sent(db: sqlite3.Connection, position: OutboxPosition) -> int:
    query = "SELECT 1 FROM outbox, outbox_of WHERE id = ? AND message = ? AND store = ?"
    known = db.execute(query, (position.entry, position.message, position.store)).fetchone()
    return position.entry if known else 0


@dataclass(frozen=True, slots=True)
class OutboxEntry:
    """An entry to be sent: ``row`` are the history's values, ``left_out`` says why there are none."""

    number: int
    kind: str
    axis: str
    message: str
    row: Mapping[str, Any]
    left_out: str
    with_file: bool


class OutboxReader:
    """Reads the outbox of a history that the daemon may be writing; every method raises StoreError."""

    def __init__(self, directory: Path, checked: set[tuple[int, int]] | None = None) -> None:
        """Open the history of a store; ``checked`` as in :func:`schema.open_to_read`."""
        self._path = directory / HISTORY_FILE
        self._db, version = history_schema.open_to_read(self._path, checked)
        if version < history_schema.WITH_OUTBOX:
            self._db.close()
            text = f"{self._path} has no outbox yet: start the daemon of this version, which upgrades it"
            raise StoreError(text, "SchemaVersion")
        self.store, self.dropped = self._query("SELECT store, dropped FROM outbox_of", ())[0]
        self._columns: dict[str, list[str]] = {}

    def __enter__(self) -> OutboxReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._db.close()

    def _query(self, query: str, values: tuple[object, ...]) -> list[tuple[Any, ...]]:
        with history_schema.translate_errors(self._path):
            return self._db.execute(query, values).fetchall()

    def resume_from(self, position: OutboxPosition) -> OutboxPosition:
        """Return where to resume: at ``position``, or at the beginning if it belongs to another file.

        Raises StoreError if the file is an older copy of what was sent.
        """
        newest = self._query("SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = 'outbox'", ())[0][0]
        if position.is_beyond(newest, self.store):
            text = f"{self._path} is an older copy: {position.entry} records were sent, and it has {newest}"
            raise StoreError(f"{text}; restart the daemon, which gives it an identity of its own", "OlderCopy")
        query = "SELECT count(*) FROM outbox WHERE id = ? AND message = ?"
        ((known,),) = self._query(query, (position.entry, position.message))
        if position.store == self.store and known:
            return position
        return OutboxPosition(self.store, 0, "", position.about)

    def count_waiting(self, after: int) -> int:
        return int(self._query("SELECT count(*) FROM outbox WHERE id > ?", (after,))[0][0])

    def read_entries(self, after: int, limit: int) -> list[OutboxEntry]:
        """Return the next entries after one, in order."""
        query = "SELECT id, of, row, axis, message, with_file FROM outbox WHERE id > ? ORDER BY id LIMIT ?"
        return [self._make_entry(*row) for row in self._query(query, (after, limit))]

    def _make_entry(self, number: int, table: str, of: int, axis: str, message: str, with_file: int) -> OutboxEntry:
        if table not in KINDS:
            return OutboxEntry(number, "unknown", "", message, {}, "damaged", False)
        values = self._query(f"SELECT * FROM {table} WHERE id = ?", (of,))
        row = dict(zip(self._read_column_names(table), values[0], strict=True)) if values else {}
        left_out = "" if row else "no longer kept"
        if row and not history_schema.compute_digest(table, row) == row["digest"] == message:
            row, left_out = {}, "damaged"
        return OutboxEntry(number, KINDS[table], axis, message, row, left_out, bool(with_file and row))

    def _read_column_names(self, table: str) -> list[str]:
        if table not in self._columns:
            rows = self._query(f"SELECT name FROM pragma_table_info('{table}') ORDER BY cid", ())
            self._columns[table] = [name for (name,) in rows]
        return self._columns[table]
