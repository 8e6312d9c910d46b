"""The history: revisions of the parameters, analysed windows, skills and notices, in SQLite.

Rows are ordered by their running number, never by the wall clock; the time is kept beside it with the boot it belongs
to. One writer (the daemon), any number of readers. A row that is not what was written is left out and told of, never
believed (:mod:`fdhil.store.schema`).
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

from fdhil.errors import StoreError
from fdhil.identification.pooling import friction_at, member
from fdhil.records import LoopEstimate, Notice, Parameters, ParameterSet, Reason, Skill, WindowOutcome
from fdhil.store import schema
from fdhil.store.rows import DECODED, Comparison, Revision, Stamp, StoredWindow
from fdhil.store.schema import told

FILE_NAME = "history.sqlite"
KEEP_NOTICES = 100_000
KEEP_COMPARISONS = 10_000


class History:
    """The history of one store directory. Every method raises StoreError when the database refuses."""

    def __init__(
        self, connection: sqlite3.Connection, path: Path, version: int, tell: Callable[[str], object] | None = None
    ) -> None:
        self._db = connection
        self._path = path
        self._version = version
        self._tell = tell
        self._damaged: dict[tuple[str, int], dict[str, Any]] = {}

    @classmethod
    def open(cls, directory: Path) -> History:
        """Open for writing, and create where needed. StoreError with code SchemaVersion, CorruptFile, ReadOnlyStore."""
        path = directory / FILE_NAME
        with told(path):
            try:
                directory.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                text = f"{directory} cannot be made: {error.strerror}; check [store] directory"
                raise StoreError(text, "ReadOnlyStore") from None
            db = sqlite3.connect(path, timeout=5.0, isolation_level=None, check_same_thread=False)
            try:
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = FULL")
                schema.check_file(db, path)
                schema.bring_up(db, path)
            except (sqlite3.Error, StoreError):
                db.close()
                raise
        return cls(db, path, schema.SCHEMA_VERSION)

    @classmethod
    def read(cls, directory: Path, tell: Callable[[str], object] | None = None) -> History:
        """Open for reading only, also from a read-only disk. StoreError when there is none or it is unusable.

        ``tell`` hears, when it is closed, of the rows that were damaged and left out.
        """
        path = directory / FILE_NAME
        if not path.is_file():
            raise StoreError(f"{path} does not exist: nothing was recorded yet; run the daemon first", "NoHistory")
        with told(path):
            for flags in ("mode=ro", "mode=ro&immutable=1"):  # without a shared-memory file only the latter opens
                db = sqlite3.connect(f"{path.resolve().as_uri()}?{flags}", uri=True, timeout=5.0)
                try:
                    version = schema.check_file(db, path, least=1)
                except sqlite3.OperationalError:
                    db.close()
                    continue
                except (sqlite3.Error, StoreError):
                    db.close()
                    raise
                return cls(db, path, version, tell)
        raise StoreError(f"{path} cannot be opened; check its rights", "StoreFault")

    def close(self) -> None:
        """Close the database; tell what was left out."""
        self._db.close()
        if self._damaged and self._tell is not None:
            places = named(self._damaged)
            self._tell(f"{self._path}: {places} damaged and left out; start the daemon, which puts them aside")
            self._damaged.clear()

    def __enter__(self) -> History:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _insert(self, table: str, row: dict[str, Any], stamp: Stamp) -> int:
        row = row | {"wall_s": stamp.wall_s, "boot": stamp.boot, "monotonic_ns": stamp.monotonic_ns}
        with told(self._path):
            return schema.insert(self._db, table, row)

    def _read(
        self, table: str, only: Mapping[str, Any], limit: int | None = None, *, oldest: bool = False
    ) -> list[Any]:
        """Return what the newest rows (or the ``oldest``) hold, oldest first; damaged ones are noted and left out.

        ``only`` is compared after a row was checked, so that damage of the very value compared is seen too.
        """
        found: list[Any] = []
        with told(self._path), closing(self._db.cursor()) as cursor:
            cursor.row_factory = sqlite3.Row
            for row in map(dict, cursor.execute(f"SELECT * FROM {table} ORDER BY id{'' if oldest else ' DESC'}")):
                if len(found) == limit:
                    break
                if self._version >= schema.WITH_DIGESTS and row.get("digest") != schema.digest_of(table, row):
                    self._damaged[table, row["id"]] = row
                    continue
                if all(row[name] == value for name, value in only.items()):
                    try:
                        found.append(DECODED[table](row))
                    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError):
                        self._damaged[table, row["id"]] = row
        return found if oldest else found[::-1]

    def put_damaged_aside(self) -> str:
        """Check every row, move the damaged ones to the table ``quarantine``, and name them; empty: all are sound."""
        for table in schema.TABLES:
            self._read(table, {})
        places = named(self._damaged)
        for (table, _), row in self._damaged.items():
            with told(self._path):
                schema.put_aside(self._db, table, row)
        self._damaged.clear()
        return places

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
            "unexplained_um": verdict.unexplained_um,
            "warnings": _dumped(verdict.warnings),
            "friction": json.dumps(friction_of(outcome)),
            "told": _told(outcome),
            "nc": None if window.nc is None else json.dumps(asdict(window.nc)),
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
            "terms": json.dumps(dict(published.parameters.terms)),
            "unexplained_um": published.unexplained_um,
            "warnings": _dumped(published.warnings),
        }
        return self._insert("revisions", row, stamp)

    def add_loops(self, found: LoopEstimate, stamp: Stamp) -> int:
        """Store what rapids showed of the drive's own loops."""
        verdict = found.verdict
        row = {
            "axis": found.axis,
            "structure": found.structure,
            "accepted": int(verdict.accepted),
            "gains": json.dumps(dict(zip(found.names, found.values.tolist(), strict=True))),
            "covariance": json.dumps(found.covariance.tolist()),
            "unexplained_um": verdict.unexplained_um,
            "reasons": _dumped(verdict.reasons),
            "warnings": _dumped(verdict.warnings),
        }
        return self._insert("loops", row, stamp)

    def loops(self, axis: str | None = None, limit: int | None = None) -> list[tuple[Stamp, LoopEstimate]]:
        """Return what was found of the drives' own loops, oldest first."""
        if self._version < schema.WITH_TERMS:
            return []
        return self._read("loops", _of(axis), limit)

    def add_skill(self, skill: Skill, stamp: Stamp) -> int:
        """Store how well a move was predicted."""
        names = ("axis", "tick", "rms_um", "max_um", "delay_ms", "measured_rms_um")
        return self._insert("skills", {name: getattr(skill, name) for name in names}, stamp)

    def add_notice(self, notice: Notice, stamp: Stamp) -> int:
        """Store a notice; the oldest beyond ``KEEP_NOTICES`` go."""
        names = ("axis", "code", "severity", "text", "tick")
        number = self._insert("notices", {name: getattr(notice, name) for name in names}, stamp)
        if number % 1000 == 0:
            with told(self._path):
                self._db.execute("DELETE FROM notices WHERE id <= ?", (number - KEEP_NOTICES,))
        return number

    def add_comparison(self, found: Comparison, stamp: Stamp) -> int:
        """Store what was predicted of a program; the oldest beyond ``KEEP_COMPARISONS`` go."""
        used = {
            axis: {"revision": u.revision, **u.parameters.as_dict(), **dict(u.parameters.terms)}
            for axis, u in found.used.items()
        }
        row = {
            "program": found.program,
            "name": found.name,
            "config_digest": found.config_digest,
            "parameters": json.dumps(used),
            "rms_um": found.rms_um,
            "zones": json.dumps(list(found.zones)),
        }
        number = self._insert("comparisons", row, stamp)
        with told(self._path):
            self._db.execute("DELETE FROM comparisons WHERE id <= ?", (number - KEEP_COMPARISONS,))
        return number

    def comparisons(self, program: str, limit: int) -> list[tuple[Stamp, Comparison]]:
        """Return what was predicted of a program (its digest), newest first."""
        if self._version < schema.WITH_COMPARISONS:
            return []  # a reader does not bring an older store up
        return self._read("comparisons", {"program": program}, limit)[::-1]

    def revisions(self, axis: str | None = None, limit: int | None = None) -> list[Revision]:
        """Return the published parameter sets, oldest first; with ``limit`` the newest so many."""
        return self._read("revisions", _of(axis), limit)

    def first_windows(self, axis: str) -> dict[int, StoredWindow]:
        """Return the first window of an axis that was ever accepted in either direction, by direction."""
        found = {}
        for direction in (1, -1):
            only = {"axis": axis, "direction": direction, "accepted": 1}
            first = self._read("windows", only, 1, oldest=True)
            if first:
                found[direction] = first[0]
        return found

    def first_revision(self, axis: str) -> Revision | None:
        """Return the first parameter set that was ever published of an axis."""
        return next(iter(self._read("revisions", {"axis": axis}, 1, oldest=True)), None)

    def windows(self, axis: str | None = None, limit: int | None = None) -> list[StoredWindow]:
        """Return the analysed windows, oldest first; with ``limit`` the newest so many."""
        return self._read("windows", _of(axis), limit)

    def skills(self, axis: str | None = None, limit: int | None = None) -> list[Skill]:
        """Return the skills of recorded moves, oldest first."""
        return self._read("skills", _of(axis), limit)

    def notices(self, axis: str | None = None, limit: int | None = None) -> list[tuple[Stamp, Notice]]:
        """Return the notices with their time, oldest first."""
        return self._read("notices", _of(axis), limit)

    def counts(self, axis: str) -> tuple[int, int]:
        """Return how many windows of an axis were accepted and refused."""
        found = Counter(window.accepted for window in self.windows(axis))
        return found[True], found[False]

    def last_window_number(self) -> int:
        """Return the largest number a stored window file may have had, 0 when there was none."""
        with told(self._path):
            row = self._db.execute("SELECT file FROM windows WHERE file != '' ORDER BY id DESC LIMIT 1").fetchone()
        digits = "".join(c for c in str(row[0]).partition("-")[0] if c in "0123456789") if row else ""
        return int(digits[:12] or 0)


def _of(axis: str | None) -> dict[str, str]:
    return {"axis": axis} if axis else {}


def named(rows: Mapping[tuple[str, int], Any]) -> str:
    """Return which rows of which table these are, in one short phrase; empty for none."""
    tables: dict[str, list[int]] = {}
    for table, number in sorted(rows):
        tables.setdefault(table, []).append(number)
    parts = [
        f"{len(numbers)} of {table} (row {', '.join(map(str, numbers[:5]))}{', ...' if len(numbers) > 5 else ''})"
        for table, numbers in tables.items()
    ]
    return " and ".join(parts)


def _dumped(reasons: Sequence[Reason]) -> str:
    return json.dumps([[reason.code, reason.text, reason.advice] for reason in reasons])


def _told(outcome: WindowOutcome) -> str | None:
    """Return what an accepted window tells a pool, as its row has it."""
    if not outcome.verdict.accepted or outcome.estimate is None:
        return None
    told = member(outcome.window, outcome.estimate)
    arrays = {"values": told.values.tolist(), "own": told.own.tolist(), "shared": told.shared.tolist()}
    return json.dumps({"names": told.names, **arrays})


def friction_of(outcome: WindowOutcome) -> dict[str, float] | None:
    """Return a window's friction torque at the rapid speed as JSON has it; None where it is not known."""
    speed = outcome.window.rapid_speed_rad_s
    known = friction_at(outcome.estimate, speed) if outcome.estimate is not None else None
    return None if known is None else {"value": known[0], "std": known[1], "speed_rad_s": speed}


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


def latest_parameters(store_directory: Path, tell: Callable[[str], object] | None = None) -> dict[str, Parameters]:
    """Return the newest published parameters of each axis; empty when nothing was recorded yet.

    ``tell`` hears of damaged rows. StoreError when a history exists but cannot be read.
    """
    if not (store_directory / FILE_NAME).is_file():
        return {}
    with History.read(store_directory, tell) as history:
        return {revision.set.axis: revision.set.parameters for revision in history.revisions()}
