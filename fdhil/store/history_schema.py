"""The tables of the history, their upgrades, and the detection of damaged files and rows.

Every row carries a digest of all its fields and its number. The file's structure is checked when it is opened. There
are no indexes: a damaged index would hide rows, a damaged row is detected by its digest.
"""

import hashlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from fdhil.errors import StoreError
from fdhil.store.atomic_file import CAUSES, is_full, make_store_error, sync_folder

_CODES = {"SQLITE_FULL": "DiskFull", "SQLITE_READONLY": "ReadOnlyStore", "SQLITE_CANTOPEN": "ReadOnlyStore"}
_NOT_WRITABLE = ("SQLITE_READONLY", "SQLITE_CANTOPEN")
# SQLITE_ERROR: the statements are correct, so the tables do not match their version
_DAMAGE = {"SQLITE_NOTADB", "SQLITE_CORRUPT", "SQLITE_ERROR"}
_STAMP = "wall_s REAL NOT NULL, boot TEXT NOT NULL, monotonic_ns INTEGER NOT NULL"
_REVISION = f"""(id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, revision INTEGER NOT NULL,
  R REAL NOT NULL, L REAL NOT NULL, K REAL NOT NULL, Jt REAL NOT NULL, ft REAL NOT NULL, Cd REAL NOT NULL,
  covariance TEXT NOT NULL, windows INTEGER NOT NULL, window_ids TEXT NOT NULL, config_digest TEXT NOT NULL,
  tick INTEGER NOT NULL, temperature_c REAL, {_STAMP}"""
_FIRST = f"""
CREATE TABLE windows (id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, file TEXT NOT NULL,
  start_tick INTEGER NOT NULL, direction INTEGER NOT NULL, accepted INTEGER NOT NULL, fit_percent REAL,
  reasons TEXT NOT NULL, method TEXT, result TEXT, parameters TEXT, temperature_c REAL, {_STAMP});
CREATE TABLE revisions {_REVISION}, UNIQUE (axis, revision));
CREATE TABLE skills (id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, tick INTEGER NOT NULL,
  rms_um REAL, max_um REAL, delay_ms REAL, measured_rms_um REAL, {_STAMP});
CREATE TABLE notices (id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, code TEXT NOT NULL,
  severity TEXT NOT NULL, text TEXT NOT NULL, tick INTEGER NOT NULL, {_STAMP});
CREATE INDEX windows_axis ON windows (axis, id);
CREATE INDEX revisions_axis ON revisions (axis, id);
"""
_COMPARISONS = f"""
CREATE TABLE comparisons (id INTEGER PRIMARY KEY AUTOINCREMENT, program TEXT NOT NULL, name TEXT NOT NULL,
  config_digest TEXT NOT NULL, parameters TEXT NOT NULL, rms_um REAL NOT NULL, zones TEXT NOT NULL, {_STAMP});
CREATE INDEX comparisons_program ON comparisons (program, id);
"""
_WITH_DIGESTS = ("windows", "revisions", "skills", "notices", "comparisons")
# the number of a damaged revision is reused, so that axis and revision need not be unique
_DIGESTS = (
    "DROP INDEX windows_axis; DROP INDEX revisions_axis; DROP INDEX comparisons_program;"
    f"CREATE TABLE renewed {_REVISION}); INSERT INTO renewed SELECT * FROM revisions;"
    "DROP TABLE revisions; ALTER TABLE renewed RENAME TO revisions;"
    + "".join(f"ALTER TABLE {table} ADD COLUMN digest TEXT NOT NULL DEFAULT '';" for table in _WITH_DIGESTS)
    + "CREATE TABLE quarantine (id INTEGER PRIMARY KEY, of TEXT NOT NULL, row INTEGER NOT NULL, content TEXT NOT NULL);"
)
# ``told`` is a window's contribution to a pool; older histories have none
_TERMS = f"""
ALTER TABLE windows ADD COLUMN unexplained_um REAL; ALTER TABLE windows ADD COLUMN warnings TEXT;
ALTER TABLE windows ADD COLUMN friction TEXT; ALTER TABLE windows ADD COLUMN told TEXT;
ALTER TABLE revisions ADD COLUMN terms TEXT; ALTER TABLE revisions ADD COLUMN unexplained_um REAL;
ALTER TABLE revisions ADD COLUMN warnings TEXT;
CREATE TABLE loops (id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, structure TEXT NOT NULL,
  accepted INTEGER NOT NULL, gains TEXT NOT NULL, covariance TEXT NOT NULL, unexplained_um REAL, reasons TEXT NOT NULL,
  warnings TEXT NOT NULL, {_STAMP}, digest TEXT NOT NULL DEFAULT '')
"""
_NC = "ALTER TABLE windows ADD COLUMN nc TEXT"
# ``notices`` are the numbers of the rows that one person acknowledged at once
_ACKNOWLEDGEMENTS = f"""
CREATE TABLE acknowledgements (id INTEGER PRIMARY KEY AUTOINCREMENT, notices TEXT NOT NULL, who TEXT NOT NULL,
  note TEXT NOT NULL, {_STAMP}, digest TEXT NOT NULL DEFAULT '')
"""
# rows for the fleet server: ``message`` is the row's digest at the time; ``store`` identifies this file
_OUTBOX = """
CREATE TABLE outbox (id INTEGER PRIMARY KEY AUTOINCREMENT, of TEXT NOT NULL, row INTEGER NOT NULL, axis TEXT NOT NULL,
  message TEXT NOT NULL, with_file INTEGER NOT NULL);
CREATE TABLE outbox_of (store TEXT NOT NULL, dropped INTEGER NOT NULL);
INSERT INTO outbox_of VALUES (lower(hex(randomblob(16))), 0)
"""
_SET_LOOPS = "ALTER TABLE revisions ADD COLUMN loops TEXT"
TABLES = (*_WITH_DIGESTS, "loops", "acknowledgements")
_BESIDE = ("quarantine", "outbox", "outbox_of")
# the upgrade from each schema to the next: a new one is appended, an old one never changes; one that changes the
# columns of a table is listed with it in _CHANGED
_STEPS = (_FIRST, _COMPARISONS, _DIGESTS, _TERMS, _NC, _ACKNOWLEDGEMENTS, _OUTBOX, _SET_LOOPS)
_CHANGED = {7: "revisions"}  # old schema -> table whose rows, and outbox entries, get new digests
SCHEMA_VERSION = len(_STEPS)
WITH_COMPARISONS, WITH_DIGESTS, WITH_TERMS, WITH_ACKNOWLEDGEMENTS, WITH_OUTBOX = 2, 3, 4, 6, 7
# findings about single values: the row's digest detects them, and only the row is lost
_OF_ONE_ROW = (" value in ", "CHECK constraint failed")


@contextmanager
def translate_errors(path: Path) -> Iterator[None]:
    """Translate SQLite's errors into a StoreError."""
    try:
        yield
    except UnicodeDecodeError:
        raise _make_damaged_error(path, "a name in it is not valid text") from None
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or ""
        raise (
            _make_damaged_error(path, str(error))
            if _DAMAGE & {name, name[:14]}
            else _make_unusable_error(path, name, error)
        ) from None


def _make_unusable_error(path: Path, name: str, error: sqlite3.Error) -> StoreError:
    code = next((code for prefix, code in _CODES.items() if name.startswith(prefix)), "StoreFault")
    if name.startswith("SQLITE_IOERR") and is_full(path):  # SQLite reports a full disk only while a table grows
        code = "DiskFull"
    cause = CAUSES.get(code, "check the disk; the history is unchanged")
    return StoreError(f"{path} cannot be used ({error}): {cause}", code)


def _make_damaged_error(path: Path, what: str) -> StoreError:
    text = f"{path} is damaged ({what}) and not used; start the daemon, which keeps it and begins a new one"
    return StoreError(text, "CorruptFile")


def read_file_stamp(path: Path) -> tuple[int, ...]:
    """Return what identifies a file and its content; empty if there is none."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def read_version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def check_file(db: sqlite3.Connection, path: Path, least: int = 0, *, pages: bool = True) -> int:
    """Return the file's schema version. StoreError if it is another program's, inconsistent or damaged.

    Checking all ``pages`` takes a second for some hundred megabytes.
    """
    db.text_factory = lambda raw: raw.decode("utf-8", "replace")  # a damaged text is detected by its digest
    version = read_version(db)
    if not least <= version <= SCHEMA_VERSION:
        text = f"{path} has schema {version}, this fdhil supports {SCHEMA_VERSION}; use the fdhil that wrote it"
        raise StoreError(text, "SchemaVersion")
    if _list_columns(db) != _list_schema_columns(version):
        raise _make_damaged_error(path, f"its tables are not those of schema {version}")
    for (found,) in db.execute("PRAGMA quick_check(20)") if pages else ():
        if found != "ok" and not any(part in found for part in _OF_ONE_ROW):
            raise _make_damaged_error(path, " ".join(found.split())[:120])
    return version


def open_to_read(path: Path, checked: set[tuple[int, int]] | None = None) -> tuple[sqlite3.Connection, int]:
    """Open a file for reading only, also from a read-only disk; return it with its schema version. StoreError.

    A caller that reopens it often keeps in ``checked`` the files that were intact (device and inode).
    """
    if not path.is_file():
        raise StoreError(f"{path} does not exist: nothing was recorded yet; run the daemon first", "NoHistory")
    place = path.stat()
    if not place.st_size:
        raise StoreError(f"{path} is empty: nothing was recorded yet; run the daemon first", "NoHistory")
    known = checked is not None and (place.st_dev, place.st_ino) in checked
    with translate_errors(path):
        # the second only if no shared-memory file can be created: it ignores locks
        for flags in ("mode=ro", "mode=ro&immutable=1"):
            db = sqlite3.connect(f"{path.resolve().as_uri()}?{flags}", uri=True, timeout=5.0)
            try:
                version = check_file(db, path, least=1, pages=not known)
            except BaseException as error:
                db.close()
                if str(getattr(error, "sqlite_errorname", "")).startswith(_NOT_WRITABLE):
                    continue
                raise
            if checked is not None:
                checked.add((place.st_dev, place.st_ino))
            return db, version
    raise StoreError(f"{path} cannot be opened; check its permissions", "StoreFault")


def _list_columns(db: sqlite3.Connection) -> list[list[tuple[Any, ...]]]:
    return [db.execute(f"PRAGMA table_info({table})").fetchall() for table in (*TABLES, *_BESIDE)]


@cache
def _list_schema_columns(version: int) -> list[list[tuple[Any, ...]]]:
    with closing(sqlite3.connect(":memory:")) as db:
        for step in _STEPS[:version]:
            db.executescript(step)
        return _list_columns(db)


def upgrade(db: sqlite3.Connection, path: Path) -> None:
    """Upgrade an older schema, or an empty file, to the current one; every step is atomic.

    An older file is copied next to it before each step, under its name and its schema version.
    """
    new = read_version(db) == 0
    while (version := read_version(db)) < SCHEMA_VERSION:
        if not new:
            _keep_copy(db, path.with_name(f"{path.name}.schema-{version}"))
        with _open_transaction(db):
            if read_version(db) == version:  # else another process made the same step in between
                sound = _find_sound_rows(db) if version >= WITH_DIGESTS else None
                for statement in _STEPS[version].split(";"):
                    db.execute(statement)
                if version + 1 >= WITH_DIGESTS:
                    _sign_rows(db, sound)
                if table := _CHANGED.get(version):
                    renewed = f"(SELECT digest FROM {table} WHERE id = outbox.row)"
                    db.execute(f"UPDATE outbox SET message = coalesce({renewed}, message) WHERE of = '{table}'")
                db.execute(f"PRAGMA user_version = {version + 1}")


@contextmanager
def _open_transaction(db: sqlite3.Connection) -> Iterator[None]:
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        db.rollback()
        raise


def _keep_copy(db: sqlite3.Connection, path: Path) -> None:
    part = path.with_name(path.name + ".part")
    try:
        part.unlink(missing_ok=True)
        with closing(sqlite3.connect(part)) as copy:
            db.backup(copy)
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise make_store_error(path, error) from None


def _read_rows(db: sqlite3.Connection, table: str) -> Iterator[dict[str, Any]]:
    cursor = db.execute(f"SELECT * FROM {table}")
    names = [column[0] for column in cursor.description]
    return (dict(zip(names, row, strict=True)) for row in cursor)


def _find_sound_rows(db: sqlite3.Connection) -> set[tuple[str, int]]:
    return {
        (table, row["id"])
        for table in _WITH_DIGESTS
        for row in _read_rows(db, table)
        if row["digest"] == compute_digest(table, row)
    }


def _sign_rows(db: sqlite3.Connection, sound: set[tuple[str, int]] | None) -> None:
    """Set the digests of rows of an older schema: of all rows, or of those that were ``sound``."""
    for table in _WITH_DIGESTS:
        rows = [row for row in _read_rows(db, table) if sound is None or (table, row["id"]) in sound]
        signed = [(compute_digest(table, row), row["id"]) for row in rows]
        db.executemany(f"UPDATE {table} SET digest = ? WHERE id = ?", signed)


def compute_digest(table: str, row: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a row, over its table, its number and all its fields."""
    values = [(name, value) for name, value in row.items() if name != "digest"]
    return hashlib.sha256(ascii((table, values)).encode()).hexdigest()


Also = Callable[[sqlite3.Connection, str, Mapping[str, Any]], None]
"""Adds what belongs to a new row (its table, what the file holds of it), in the same transaction."""


def insert_row(db: sqlite3.Connection, table: str, row: Mapping[str, Any], also: Also | None = None) -> int:
    """Insert a row with its digest, and what ``also`` adds; return its number."""
    names = ", ".join(row)
    marks = ", ".join(f":{name}" for name in row)
    row = {name: _escape_text(value) for name, value in row.items()}
    with _open_transaction(db):
        number = int(db.execute(f"INSERT INTO {table} ({names}, digest) VALUES ({marks}, '')", row).lastrowid or 0)
        cursor = db.execute(f"SELECT * FROM {table} WHERE id = ?", (number,))
        stored = dict(zip([column[0] for column in cursor.description], cursor.fetchone(), strict=True))
        stored["digest"] = compute_digest(table, stored)
        db.execute(f"UPDATE {table} SET digest = ? WHERE id = ?", (stored["digest"], number))
        if also is not None:
            also(db, table, stored)
    return number


def _escape_text(value: Any) -> Any:
    """Escape invalid Unicode, as from a Latin-1 file name, so that SQLite accepts it."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def quarantine_row(db: sqlite3.Connection, table: str, row: Mapping[str, Any]) -> None:
    with _open_transaction(db):
        content = (table, row["id"], ascii(dict(row)))
        db.execute("INSERT INTO quarantine (of, row, content) VALUES (?, ?, ?)", content)
        db.execute(f"DELETE FROM {table} WHERE id = ?", (row["id"],))


def format_row_names(rows: Mapping[tuple[str, int], Any]) -> str:
    """Return which rows of which tables these are, in a short phrase; empty for none."""
    tables: dict[str, list[int]] = {}
    for table, number in sorted(rows):
        tables.setdefault(table, []).append(number)
    parts = [
        f"{len(numbers)} of {table} (row {', '.join(map(str, numbers[:5]))}{', ...' if len(numbers) > 5 else ''})"
        for table, numbers in tables.items()
    ]
    return " and ".join(parts)
