"""The history: revisions of the parameters, analysed windows, skills and notices, in SQLite.

Rows are ordered by their running number, never by the wall clock; the time is kept beside it with the boot it belongs
to. One writer (the daemon), any number of readers.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from fdhil.errors import StoreError
from fdhil.records import PARAMETERS, Float, Notice, Parameters, ParameterSet, Skill, WindowOutcome, frozen

FILE_NAME = "history.sqlite"
KEEP_NOTICES = 100_000
KEEP_COMPARISONS = 10_000
_CODES = {"SQLITE_FULL": "DiskFull", "SQLITE_READONLY": "ReadOnlyStore", "SQLITE_CANTOPEN": "ReadOnlyStore"}
_STAMP = "wall_s REAL NOT NULL, boot TEXT NOT NULL, monotonic_ns INTEGER NOT NULL"
_FIRST = f"""
CREATE TABLE windows (id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, file TEXT NOT NULL,
  start_tick INTEGER NOT NULL, direction INTEGER NOT NULL, accepted INTEGER NOT NULL, fit_percent REAL,
  reasons TEXT NOT NULL, method TEXT, result TEXT, parameters TEXT, temperature_c REAL, {_STAMP});
CREATE TABLE revisions (id INTEGER PRIMARY KEY AUTOINCREMENT, axis TEXT NOT NULL, revision INTEGER NOT NULL,
  R REAL NOT NULL, L REAL NOT NULL, K REAL NOT NULL, Jt REAL NOT NULL, ft REAL NOT NULL, Cd REAL NOT NULL,
  covariance TEXT NOT NULL, windows INTEGER NOT NULL, window_ids TEXT NOT NULL, config_digest TEXT NOT NULL,
  tick INTEGER NOT NULL, temperature_c REAL, {_STAMP}, UNIQUE (axis, revision));
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
# what leads from each schema to the next, in order: a new one is added at the end, an old one never changes
_STEPS = (_FIRST, _COMPARISONS)
SCHEMA_VERSION = len(_STEPS)


@dataclass(frozen=True, slots=True)
class Stamp:
    """When a row was written: wall clock (s since 1970, may be wrong), boot identifier, monotonic clock."""

    wall_s: float
    boot: str
    monotonic_ns: int


@dataclass(frozen=True, slots=True)
class Revision:
    """A published parameter set as stored: ``window_ids`` are the rows of the windows it was pooled from."""

    number: int
    set: ParameterSet
    window_ids: tuple[int, ...]
    stamp: Stamp


@dataclass(frozen=True, slots=True)
class StoredWindow:
    """An analysed window as stored; ``parameters`` maps a symbol to {"value", "std"} or {"value": None, "reason"}."""

    number: int
    axis: str
    file: str
    start_tick: int
    direction: int
    accepted: bool
    fit_percent: float | None
    reasons: tuple[str, ...]
    parameters: dict[str, dict[str, Any]] | None
    temperature_c: float | None
    stamp: Stamp


@dataclass(frozen=True, slots=True)
class UsedParameters:
    """An axis' parameters as a prediction used them: ``revision`` 0 where none was published."""

    revision: int
    parameters: Parameters


@dataclass(frozen=True, slots=True)
class Comparison:
    """What was predicted of a program: ``program`` is its digest, ``zones`` as ``fdhil predict --json`` has them."""

    program: str
    name: str
    config_digest: str
    used: Mapping[str, UsedParameters]
    rms_um: float
    zones: tuple[Mapping[str, Any], ...]


class History:
    """The history of one store directory. Every method raises StoreError when the database refuses."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._db = connection
        self._path = path

    @classmethod
    def open(cls, directory: Path) -> History:
        """Open for writing, and create where needed. StoreError with code SchemaVersion, CorruptFile, ReadOnlyStore."""
        path = directory / FILE_NAME
        with _told(path):
            try:
                directory.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                text = f"{directory} cannot be made: {error.strerror}; check [store] directory"
                raise StoreError(text, "ReadOnlyStore") from None
            db = sqlite3.connect(path, timeout=5.0, isolation_level=None, check_same_thread=False)
            try:
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = FULL")
                _check_version(db, path)
                _bring_up(db)
            except (sqlite3.Error, StoreError):
                db.close()
                raise
        return cls(db, path)

    @classmethod
    def read(cls, directory: Path) -> History:
        """Open for reading only, also from a read-only disk. StoreError when there is none or it is unusable."""
        path = directory / FILE_NAME
        if not path.is_file():
            raise StoreError(f"{path} does not exist: nothing was recorded yet; run the daemon first", "NoHistory")
        with _told(path):
            for flags in ("mode=ro", "mode=ro&immutable=1"):  # without a shared-memory file only the latter opens
                db = sqlite3.connect(f"{path.resolve().as_uri()}?{flags}", uri=True, timeout=5.0)
                try:
                    _check_version(db, path, least=1)
                except sqlite3.OperationalError:
                    db.close()
                    continue
                except (sqlite3.Error, StoreError):
                    db.close()
                    raise
                return cls(db, path)
        raise StoreError(f"{path} cannot be opened; check its rights", "StoreFault")

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def __enter__(self) -> History:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _insert(self, table: str, row: dict[str, Any], stamp: Stamp) -> int:
        row = row | {"wall_s": stamp.wall_s, "boot": stamp.boot, "monotonic_ns": stamp.monotonic_ns}
        names = ", ".join(row)
        marks = ", ".join(f":{name}" for name in row)
        with _told(self._path):
            cursor = self._db.execute(f"INSERT INTO {table} ({names}) VALUES ({marks})", row)
        return int(cursor.lastrowid or 0)

    def _select(self, query: str, arguments: Sequence[Any] = ()) -> list[sqlite3.Row]:
        with _told(self._path), closing(self._db.cursor()) as cursor:
            cursor.row_factory = sqlite3.Row
            return cursor.execute(query, arguments).fetchall()

    def add_window(self, outcome: WindowOutcome, file: str, stamp: Stamp) -> int:
        """Store an analysed window and return its number; ``file`` is its Parquet file's name, empty when not kept."""
        window, estimate, verdict = outcome.window, outcome.estimate, outcome.verdict
        row = {
            "axis": window.axis,
            "file": file,
            "start_tick": window.start_tick,
            "direction": window.direction,
            "accepted": int(verdict.accepted),
            "fit_percent": verdict.fit_percent,
            "reasons": json.dumps([str(reason) for reason in verdict.reasons]),
            "method": estimate and estimate.method,
            "result": estimate and estimate.result.value,
            "parameters": json.dumps(described(outcome)) if estimate else None,
            "temperature_c": window.temperature_c,
        }
        return self._insert("windows", row, stamp)

    def add_revision(self, published: ParameterSet, window_ids: Sequence[int], stamp: Stamp) -> int:
        """Store a published parameter set and return its running number."""
        row: dict[str, Any] = published.parameters.as_dict() | {
            "axis": published.axis,
            "revision": published.revision,
            "covariance": json.dumps(published.covariance.tolist()),
            "windows": published.windows,
            "window_ids": json.dumps(list(window_ids)),
            "config_digest": published.config_digest,
            "tick": published.tick,
            "temperature_c": published.temperature_c,
        }
        return self._insert("revisions", row, stamp)

    def add_skill(self, skill: Skill, stamp: Stamp) -> int:
        """Store how well a move was predicted."""
        names = ("axis", "tick", "rms_um", "max_um", "delay_ms", "measured_rms_um")
        return self._insert("skills", {name: getattr(skill, name) for name in names}, stamp)

    def add_notice(self, notice: Notice, stamp: Stamp) -> int:
        """Store a notice; the oldest beyond ``KEEP_NOTICES`` go."""
        names = ("axis", "code", "severity", "text", "tick")
        number = self._insert("notices", {name: getattr(notice, name) for name in names}, stamp)
        if number % 1000 == 0:
            with _told(self._path):
                self._db.execute("DELETE FROM notices WHERE id <= ?", (number - KEEP_NOTICES,))
        return number

    def add_comparison(self, found: Comparison, stamp: Stamp) -> int:
        """Store what was predicted of a program; the oldest beyond ``KEEP_COMPARISONS`` go."""
        used = {axis: {"revision": u.revision, **u.parameters.as_dict()} for axis, u in found.used.items()}
        row = {
            "program": found.program,
            "name": found.name,
            "config_digest": found.config_digest,
            "parameters": json.dumps(used),
            "rms_um": found.rms_um,
            "zones": json.dumps(list(found.zones)),
        }
        number = self._insert("comparisons", row, stamp)
        with _told(self._path):
            self._db.execute("DELETE FROM comparisons WHERE id <= ?", (number - KEEP_COMPARISONS,))
        return number

    def comparisons(self, program: str, limit: int) -> list[tuple[Stamp, Comparison]]:
        """Return what was predicted of a program (its digest), newest first."""
        with _told(self._path):
            version = _version(self._db)
        if version <= _STEPS.index(_COMPARISONS):
            return []  # a reader does not bring an older store up
        query = "SELECT * FROM comparisons WHERE program = ? ORDER BY id DESC LIMIT ?"
        return [(_stamp(row), _comparison(row)) for row in self._select(query, (program, limit))]

    def revisions(self, axis: str | None = None, limit: int | None = None) -> list[Revision]:
        """Return the published parameter sets, oldest first; with ``limit`` the newest so many."""
        return [_revision(row) for row in self._newest("revisions", axis, limit)]

    def first_revision(self, axis: str) -> Revision | None:
        """Return the first parameter set that was ever published of an axis."""
        rows = self._select("SELECT * FROM revisions WHERE axis = ? ORDER BY id LIMIT 1", (axis,))
        return _revision(rows[0]) if rows else None

    def windows(self, axis: str | None = None, limit: int | None = None) -> list[StoredWindow]:
        """Return the analysed windows, oldest first; with ``limit`` the newest so many."""
        return [_stored_window(row) for row in self._newest("windows", axis, limit)]

    def skills(self, axis: str | None = None, limit: int | None = None) -> list[Skill]:
        """Return the skills of recorded moves, oldest first."""
        rows = self._newest("skills", axis, limit)
        figures = ("rms_um", "max_um", "delay_ms", "measured_rms_um")
        return [Skill(row["axis"], row["tick"], *(_number(row[name]) for name in figures)) for row in rows]

    def notices(self, axis: str | None = None, limit: int | None = None) -> list[tuple[Stamp, Notice]]:
        """Return the notices with their time, oldest first."""
        rows = self._newest("notices", axis, limit)
        names = ("code", "severity", "text", "axis", "tick")
        return [(_stamp(row), Notice(*(row[name] for name in names))) for row in rows]

    def counts(self, axis: str) -> tuple[int, int]:
        """Return how many windows of an axis were accepted and refused."""
        rows = self._select("SELECT accepted, COUNT(*) AS n FROM windows WHERE axis = ? GROUP BY accepted", (axis,))
        found = {row["accepted"]: int(row["n"]) for row in rows}
        return found.get(1, 0), found.get(0, 0)

    def last_window_number(self) -> int:
        """Return the largest number a stored window file may have had, 0 when there was none."""
        rows = self._select("SELECT file FROM windows WHERE file != '' ORDER BY id DESC LIMIT 1")
        digits = "".join(c for c in rows[0]["file"].partition("-")[0] if c.isdigit()) if rows else ""
        return int(digits or 0)

    def _newest(self, table: str, axis: str | None, limit: int | None) -> list[sqlite3.Row]:
        query = f"SELECT * FROM {table}" + (" WHERE axis = ?" if axis else "") + " ORDER BY id DESC LIMIT ?"
        rows = self._select(query, ([axis] if axis else []) + [-1 if limit is None else limit])
        return rows[::-1]


def described(outcome: WindowOutcome) -> dict[str, dict[str, Any]]:
    """Return a window's parameters as JSON has them: value and std, or null and the reason."""
    estimate = outcome.estimate
    if estimate is None:
        return {}
    told: dict[str, dict[str, Any]] = {}
    for name in estimate.names:
        value, std = estimate.value(name), estimate.std(name)
        if math.isfinite(value):
            told[name] = {"value": value, "std": std if math.isfinite(std) else None}
        else:
            told[name] = {"value": None, "reason": str(estimate.missing.get(name, estimate.result.value))}
    return told


def latest_parameters(store_directory: Path) -> dict[str, Parameters]:
    """Return the newest published parameters of each axis; empty when nothing was recorded yet.

    StoreError when a history exists but cannot be read.
    """
    if not (store_directory / FILE_NAME).is_file():
        return {}
    with History.read(store_directory) as history:
        return {revision.set.axis: revision.set.parameters for revision in history.revisions()}


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into one sentence."""
    try:
        yield
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or ""
        code = next((code for prefix, code in _CODES.items() if name.startswith(prefix)), "StoreFault")
        if name in {"SQLITE_NOTADB", "SQLITE_CORRUPT"}:
            code = "CorruptFile"
        raise StoreError(f"{path} cannot be used ({error}); check the disk, or move the file away", code) from None


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def _bring_up(db: sqlite3.Connection) -> None:
    """Take an older schema, or an empty file, to the present one: every step is whole or not made at all."""
    while (version := _version(db)) < SCHEMA_VERSION:
        try:
            db.executescript(f"BEGIN IMMEDIATE;{_STEPS[version]}PRAGMA user_version = {version + 1};COMMIT;")
        except sqlite3.OperationalError:
            db.rollback()
            if _version(db) == version:  # else another process made the same step in between
                raise


def _check_version(db: sqlite3.Connection, path: Path, least: int = 0) -> None:
    version = _version(db)
    if not least <= version <= SCHEMA_VERSION:
        text = f"{path} has schema {version}, this fdhil knows {SCHEMA_VERSION}; use the fdhil that wrote it"
        raise StoreError(text, "SchemaVersion")


def _stamp(row: sqlite3.Row) -> Stamp:
    return Stamp(row["wall_s"], row["boot"], row["monotonic_ns"])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _revision(row: sqlite3.Row) -> Revision:
    parameters = Parameters(*(float(row[name]) for name in PARAMETERS))
    covariance: Float = frozen(np.array(json.loads(row["covariance"]), dtype=np.float64))
    published = ParameterSet(
        row["axis"], row["revision"], parameters, covariance, row["windows"], row["tick"], row["temperature_c"],
        row["config_digest"],
    )  # fmt: skip
    return Revision(row["id"], published, tuple(json.loads(row["window_ids"])), _stamp(row))


def _comparison(row: sqlite3.Row) -> Comparison:
    used = {
        axis: UsedParameters(int(u["revision"]), Parameters(*(float(u[name]) for name in PARAMETERS)))
        for axis, u in json.loads(row["parameters"]).items()
    }
    return Comparison(
        row["program"], row["name"], row["config_digest"], used, row["rms_um"], tuple(json.loads(row["zones"]))
    )


def _stored_window(row: sqlite3.Row) -> StoredWindow:
    parameters = None if row["parameters"] is None else json.loads(row["parameters"])
    return StoredWindow(
        row["id"], row["axis"], row["file"], row["start_tick"], row["direction"], bool(row["accepted"]),
        row["fit_percent"], tuple(json.loads(row["reasons"])), parameters, row["temperature_c"], _stamp(row),
    )  # fmt: skip
