"""The history database (SQLite): parameter revisions, analysed windows, skills and notices.

Rows are ordered by their running number, never by the wall clock; the time is stored with the boot it belongs to. One
writer (the daemon), any number of readers. A damaged row is left out and reported (:mod:`fdhil.store.history_schema`).
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fdhil.errors import StoreError
from fdhil.identification import build_pool_member, estimate_friction_at
from fdhil.records import LoopEstimate, Notice, ParameterSet, Reason, Skill, WindowOutcome
from fdhil.store import HISTORY_FILE, history_schema
from fdhil.store.atomic_file import make_folder
from fdhil.store.history_rows import (
    DECODED,
    Acknowledgement,
    Comparison,
    Revision,
    StoredNotice,
    StoredWindow,
    TimeStamp,
)
from fdhil.store.history_schema import Also, read_file_stamp, translate_errors

HISTORY_FILE_NAME = HISTORY_FILE
CHECKED = 5_000  # newest rows of a table that are always verified: start-up time must not grow with the history
KEEP_NOTICES = 100_000
RECENT_NOTICES = 5_000  # the newest ones to be acknowledged; older ones no longer are
KEEP_COMPARISONS = 10_000
KEEP_ACKNOWLEDGEMENTS = 10_000
Warn = Callable[[str], object]

Begin = Callable[[sqlite3.Connection], None]
"""Prepares a newly opened file."""


class History:
    """The history of one store directory. Every method raises StoreError if the database refuses."""

    def __init__(
        self, db: sqlite3.Connection, path: Path, version: int, warn: Warn | None = None, also: Also | None = None
    ) -> None:
        self._db = db
        self._path = path
        self.version = version
        self._warn = warn
        self._damaged: dict[tuple[str, int], dict[str, Any]] = {}
        self._also = also
        self._wal = path.with_name(path.name + "-wal")
        self._stamp, self._log = read_file_stamp(path), read_file_stamp(self._wal)[:2]

    @classmethod
    def open(cls, directory: Path, also: Also | None = None, begin: Begin | None = None) -> History:
        """Open for writing; ``also`` adds to each row. StoreError: SchemaVersion, CorruptFile, ReadOnlyStore."""
        path = directory / HISTORY_FILE_NAME
        with translate_errors(path):
            try:
                make_folder(directory)
            except OSError as error:
                text = f"{directory} cannot be created: {error.strerror}; check [store] directory"
                raise StoreError(text, "ReadOnlyStore") from None
            db = sqlite3.connect(path, timeout=5.0, isolation_level=None, check_same_thread=False)
            try:
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = FULL")
                history_schema.check_file(db, path)
                history_schema.upgrade(db, path)
                if begin is not None:
                    begin(db)
            except BaseException:
                db.close()
                raise
        return cls(db, path, history_schema.SCHEMA_VERSION, also=also)

    @classmethod
    def open_read_only(
        cls, directory: Path, warn: Warn | None = None, checked: set[tuple[int, int]] | None = None
    ) -> History:
        """Open for reading only, also from a read-only disk. Raises StoreError if there is none or it is unusable.

        ``warn`` receives the damaged rows that were left out, at close. A caller that reopens it often keeps in
        ``checked`` the files whose structure was intact (device and inode); rows are still verified one by one.
        """
        path = directory / HISTORY_FILE_NAME
        db, version = history_schema.open_to_read(path, checked)
        return cls(db, path, version, warn)

    def write_checkpoint(self) -> None:
        """Move the write-ahead log into the file as far as possible, and note the file's state."""
        with suppress(sqlite3.Error):
            self._db.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        self._stamp = self._stamp[:2] + read_file_stamp(self._path)[2:]

    def is_in_place(self) -> bool:
        """Return whether the file of that name is the opened one, and no other process has written to it."""
        return self._stamp == read_file_stamp(self._path)

    def discard_file(self) -> None:
        """Close a file that was replaced or changed; its log must not become that of another file."""
        with suppress(sqlite3.Error):
            self._db.close()
        if self._log and read_file_stamp(self._wal)[:2] == self._log:  # another process was reading
            for log in (self._wal, self._wal.with_name(f"{self._path.name}-shm")):
                log.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the database; report the rows that were left out."""
        self._db.close()
        if self._damaged and self._warn is not None:
            places = history_schema.format_row_names(self._damaged)
            self._warn(f"{self._path}: {places} damaged and left out; start the daemon, which quarantines them")
            self._damaged.clear()

    def __enter__(self) -> History:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _insert_row(self, table: str, row: dict[str, Any], stamp: TimeStamp) -> int:
        row = row | {"wall_s": stamp.wall_s, "boot": stamp.boot, "monotonic_ns": stamp.monotonic_ns}
        with translate_errors(self._path):
            return history_schema.insert_row(self._db, table, row, self._also)

    def _read_records(
        self, table: str, only: Mapping[str, Any], limit: int | None = None, *, oldest: bool = False
    ) -> list[Any]:
        """Return the records of the newest (or ``oldest``) rows, oldest first; damaged rows are noted and left out.

        ``only`` is compared after a row was verified, so that damage of the compared value is seen too; before the
        newest ``CHECKED`` rows the database itself selects the matching ones.
        """
        rows = self._read_rows(table, only, oldest=oldest)
        found = list(
            islice((it for row in rows if (it := self._decode_sound_row(table, row, only)) is not None), limit)
        )
        return found if oldest else found[::-1]

    def _read_rows(self, table: str, only: Mapping[str, Any], *, oldest: bool = False) -> Iterator[dict[str, Any]]:
        """Yield rows one at a time: the newest ``CHECKED``, and matching ones before them."""
        newest = f"id > (SELECT max(id) - {CHECKED} FROM {table})"
        match = " AND ".join(f"{name} = :{name}" for name in only) or "1"
        query = f"SELECT * FROM {table} WHERE {newest} OR ({match}) ORDER BY id{'' if oldest else ' DESC'}"
        with translate_errors(self._path), closing(self._db.cursor()) as cursor:
            cursor.row_factory = sqlite3.Row
            yield from map(dict, cursor.execute(query, only))

    def _decode_sound_row(
        self, table: str, row: dict[str, Any], only: Mapping[str, Any] = MappingProxyType({})
    ) -> Any | None:
        try:
            if self.version < history_schema.WITH_DIGESTS or row.get("digest") == history_schema.compute_digest(
                table, row
            ):
                return DECODED[table](row) if all(row[name] == value for name, value in only.items()) else None
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError):
            pass
        self._damaged[table, row["id"]] = row
        return None

    def quarantine_damaged_rows(self) -> str:
        """Move damaged rows to the table ``quarantine``, and return their names; empty if all are sound.

        Only the newest ``CHECKED`` rows of each table are examined; older damage is detected when the row is read.
        """
        for table in history_schema.TABLES:
            for row in islice(self._read_rows(table, {}), CHECKED):
                self._decode_sound_row(table, row)
        places = history_schema.format_row_names(self._damaged)
        for (table, _), row in self._damaged.items():
            with translate_errors(self._path):
                history_schema.quarantine_row(self._db, table, row)
        self._damaged.clear()
        return places

    def add_window(self, outcome: WindowOutcome, file: str, stamp: TimeStamp) -> int:
        """Store an analysed window and return its number; ``file`` is its Parquet file's name, empty if not stored."""
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
            "parameters": json.dumps(format_parameters(outcome)) if estimate else None,
            "temperature_c": window.temperature_c,
            "unexplained_um": verdict.unexplained_um,
            "warnings": _encode_reasons(verdict.warnings),
            "friction": json.dumps(format_friction(outcome)),
            "told": _encode_pool_entry(outcome),
            "nc": None if window.nc is None else json.dumps(asdict(window.nc)),
        }
        return self._insert_row("windows", row, stamp)

    def add_revision(self, published: ParameterSet, window_ids: Sequence[int], stamp: TimeStamp) -> int:
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
            "warnings": _encode_reasons(published.warnings),
            "loops": json.dumps(published.loops),
        }
        return self._insert_row("revisions", row, stamp)

    def add_loops(self, found: LoopEstimate, stamp: TimeStamp) -> int:
        verdict = found.verdict
        row = {
            "axis": found.axis,
            "structure": found.structure,
            "accepted": int(verdict.accepted),
            "gains": json.dumps(dict(zip(found.names, found.values.tolist(), strict=True))),
            "covariance": json.dumps(found.covariance.tolist()),
            "unexplained_um": verdict.unexplained_um,
            "reasons": _encode_reasons(verdict.reasons),
            "warnings": _encode_reasons(verdict.warnings),
        }
        return self._insert_row("loops", row, stamp)

    def read_loops(self, axis: str | None = None, limit: int | None = None) -> list[tuple[TimeStamp, LoopEstimate]]:
        """Return the identified regulators of the drives, oldest first."""
        return [] if self.version < history_schema.WITH_TERMS else self._read_records("loops", _match_axis(axis), limit)

    def add_skill(self, skill: Skill, stamp: TimeStamp) -> int:
        names = ("axis", "tick", "rms_um", "max_um", "delay_ms", "measured_rms_um")
        return self._insert_row("skills", {name: getattr(skill, name) for name in names}, stamp)

    def add_notice(self, notice: Notice, stamp: TimeStamp) -> int:
        """Store a notice; notices beyond the newest ``KEEP_NOTICES`` are deleted."""
        names = ("axis", "code", "severity", "text", "tick")
        number = self._insert_row("notices", {name: getattr(notice, name) for name in names}, stamp)
        if number % 1000 == 0:
            with translate_errors(self._path):
                self._db.execute("DELETE FROM notices WHERE id <= ?", (number - KEEP_NOTICES,))
        return number

    def add_acknowledgement(self, given: Acknowledgement) -> int:
        """Store an acknowledgement; those beyond the newest ``KEEP_ACKNOWLEDGEMENTS`` are deleted."""
        row = {"notices": json.dumps(given.notices), "who": given.who, "note": given.note}
        number = self._insert_row("acknowledgements", row, given.stamp)
        with translate_errors(self._path):
            self._db.execute("DELETE FROM acknowledgements WHERE id <= ?", (number - KEEP_ACKNOWLEDGEMENTS,))
        return number

    def add_comparison(self, found: Comparison, stamp: TimeStamp) -> int:
        """Store the prediction of a program; those beyond the newest ``KEEP_COMPARISONS`` are deleted."""
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
        number = self._insert_row("comparisons", row, stamp)
        with translate_errors(self._path):
            self._db.execute("DELETE FROM comparisons WHERE id <= ?", (number - KEEP_COMPARISONS,))
        return number

    def read_comparisons(self, program: str, limit: int) -> list[tuple[TimeStamp, Comparison]]:
        """Return the predictions of a program (by its digest), newest first."""
        if self.version < history_schema.WITH_COMPARISONS:
            return []  # a reader does not upgrade an older store
        return self._read_records("comparisons", {"program": program}, limit)[::-1]

    def read_revisions(self, axis: str | None = None, limit: int | None = None) -> list[Revision]:
        """Return the published parameter sets, oldest first; with ``limit`` only the newest."""
        return self._read_records("revisions", _match_axis(axis), limit)

    def read_first_windows(self, axis: str) -> dict[int, StoredWindow]:
        """Return the first accepted window of an axis in each direction, by direction."""
        found = {}
        for direction in (1, -1):
            only = {"axis": axis, "direction": direction, "accepted": 1}
            first = self._read_records("windows", only, 1, oldest=True)
            if first:
                found[direction] = first[0]
        return found

    def read_first_revision(self, axis: str) -> Revision | None:
        """Return the first published parameter set of an axis."""
        return next(iter(self._read_records("revisions", {"axis": axis}, 1, oldest=True)), None)

    def read_windows(self, axis: str | None = None, limit: int | None = None) -> list[StoredWindow]:
        """Return the analysed windows, oldest first; with ``limit`` only the newest."""
        return self._read_records("windows", _match_axis(axis), limit)

    def select_windows(self, condition: str, values: Mapping[str, Any], limit: int) -> list[StoredWindow]:
        """Return the first ``limit`` sound windows that match an SQL condition, in its order."""
        return self._select_records("windows", condition, values, limit)

    def _select_records(self, table: str, condition: str, values: Mapping[str, Any], limit: int | None) -> list[Any]:
        with translate_errors(self._path), closing(self._db.cursor()) as cursor:
            cursor.row_factory = sqlite3.Row
            rows = map(dict, cursor.execute(f"SELECT * FROM {table} WHERE {condition}", values))
            return list(islice((it for row in rows if (it := self._decode_sound_row(table, row)) is not None), limit))

    def query_counts(self, query: str, values: Mapping[str, Any] | Sequence[Any]) -> list[tuple[Any, ...]]:
        """Return the counts of an SQL query; they are informative only and include damaged rows."""
        with translate_errors(self._path):
            return self._db.execute(query, values).fetchall()

    def read_skills(self, axis: str | None = None, limit: int | None = None) -> list[Skill]:
        return self._read_records("skills", _match_axis(axis), limit)

    def read_notices(self, limit: int | None = None) -> list[StoredNotice]:
        """Return the notices, each with its newest acknowledgement, oldest first.

        With ``limit`` the newest ones that require acknowledgement, and as many others, so that information displaces
        none.
        """
        kinds = (f"severity {kind} 'info' ORDER BY id DESC" for kind in ("IS NOT", "IS"))
        found: list[StoredNotice] = [
            each for kind in kinds for each in self._select_records("notices", kind, {}, limit)
        ]
        found.sort(key=lambda notice: notice.number)
        given = {number: one for one in self.read_acknowledgements() for number in one.notices} if found else {}
        return [replace(notice, acknowledged=given.get(notice.number)) for notice in found]

    def read_acknowledgements(self, limit: int | None = None) -> list[Acknowledgement]:
        return (
            []
            if self.version < history_schema.WITH_ACKNOWLEDGEMENTS
            else self._read_records("acknowledgements", {}, limit)
        )

    def count_windows(self, axis: str) -> tuple[int, int]:
        """Return the counts of accepted and refused windows of an axis; informative only, damaged rows included."""
        found = dict(
            self.query_counts("SELECT accepted, count(*) FROM windows WHERE axis = ? GROUP BY accepted", (axis,))
        )
        return found.get(1, 0), found.get(0, 0)

    def find_newest_row_numbers(self) -> tuple[int, ...]:
        """Return the number of each table's newest row: while they are unchanged, nothing was added."""
        acknowledged = ("acknowledgements",) if self.version >= history_schema.WITH_ACKNOWLEDGEMENTS else ()
        tables = ("windows", "revisions", "notices", *acknowledged)
        with translate_errors(self._path):
            found = (self._db.execute(f"SELECT max(id) FROM {table}").fetchone()[0] for table in tables)
            return tuple(number or 0 for number in found)

    def find_last_window_number(self) -> int:
        """Return the largest number that a stored window file may have had, 0 without one."""
        with translate_errors(self._path):
            row = self._db.execute("SELECT file FROM windows WHERE file != '' ORDER BY id DESC LIMIT 1").fetchone()
        digits = "".join(c for c in str(row[0]).partition("-")[0] if c in "0123456789") if row else ""
        return int(digits[:12] or 0)


def _match_axis(axis: str | None) -> dict[str, str]:
    return {"axis": axis} if axis else {}


def _encode_reasons(reasons: Sequence[Reason]) -> str:
    return json.dumps([[reason.code, reason.text, reason.advice] for reason in reasons])


def _encode_pool_entry(outcome: WindowOutcome) -> str | None:
    if not outcome.verdict.accepted or outcome.estimate is None:
        return None
    entry = build_pool_member(outcome.window, outcome.estimate)
    arrays = {"values": entry.values.tolist(), "own": entry.own.tolist(), "shared": entry.shared.tolist()}
    return json.dumps({"names": entry.names, **arrays})


def format_friction(outcome: WindowOutcome) -> dict[str, float] | None:
    """Return a window's friction torque at the rapid speed for JSON; None if unknown."""
    speed = outcome.window.rapid_speed_rad_s
    known = estimate_friction_at(outcome.estimate, speed) if outcome.estimate is not None else None
    return None if known is None else {"value": known[0], "std": known[1], "speed_rad_s": speed}


def format_parameters(outcome: WindowOutcome) -> dict[str, dict[str, Any]]:
    """Return a window's parameters for JSON: value and std, or null and the reason."""
    estimate = outcome.estimate
    if estimate is None:
        return {}
    document: dict[str, dict[str, Any]] = {}
    for name in estimate.names:
        value, std = estimate.get_value(name), estimate.get_std(name)
        if math.isfinite(value):
            document[name] = {"value": value, "std": std if math.isfinite(std) else None}
        else:
            document[name] = {"value": None, "reason": str(estimate.missing.get(name, estimate.result.value))}
    return document
