"""Lets go of what is older than the works wants to keep: whole months of records, and windows that no row names.

A month goes when it is old, and when the last that came into it is: what a machine sends late lives as long as the
rest. Of what goes, the first parameter set of each axis and the newest of what each machine says of itself are kept,
as ages and limits count from there; and the numbers of the records, so that none comes back or is called missing.
"""

import re
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, LiteralString

from psycopg import sql

from fdhil.config.fleet import Fleet
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.fleet.migrations import LOCK
from fdhil.fleet.objects import path_of
from fdhil.fleet.sets import Db

LEAST_AGE_S = 86_400.0  # of a window's file: its row may be on its way
MOST_FILES = 10_000  # looked up at once
_PARTITION = re.compile(r"records_(\d{4})_(\d\d)")
_OTHER = "records_other"
# {of} are the rows that go
_NOTE_GOING: LiteralString = """
INSERT INTO fleet.dropped AS d (machine, store, sequences)
  SELECT machine, store, range_agg(int8range(sequence, sequence, '[]')) FROM {of} AS gone WHERE sequence > 0
  GROUP BY machine, store
ON CONFLICT (machine, store) DO UPDATE SET sequences = d.sequences + excluded.sequences
"""
_KEEP_FIRST: LiteralString = """
INSERT INTO fleet.kept SELECT DISTINCT ON (machine, axis) * FROM {of} AS gone
  WHERE kind = 'parameters' AND record ? 'revision' ORDER BY machine, axis, stored_at, sequence
ON CONFLICT DO NOTHING
"""
_KEEP_ABOUT: LiteralString = """
INSERT INTO fleet.kept AS k SELECT DISTINCT ON (machine) * FROM {of} AS gone
  WHERE kind = 'about' AND axis = '' ORDER BY machine, stored_at DESC
ON CONFLICT (machine, axis, kind) DO UPDATE SET message = excluded.message, recorded_at = excluded.recorded_at,
  store = excluded.store, stored_at = excluded.stored_at, record = excluded.record
WHERE k.stored_at < excluded.stored_at
"""
_FORGET_REANALYSES: LiteralString = """
DELETE FROM fleet.reanalysed_windows a WHERE NOT EXISTS
  (SELECT FROM fleet.records r WHERE (r.machine, r.window_name) = (a.machine, a.window_name))
"""


def retain(db: Db, fleet: Fleet, now: datetime, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Let go of what [retention] does not keep, and return what went. ConfigError where nothing is said there.

    What is stopped on its way goes on at the next call. StoreError where a window cannot be removed.
    """
    limits = fleet.retention
    if limits.record_months is None and limits.window_months is None:
        advice = "say record_months or window_months there; without them all is kept for good"
        raise ConfigError("the fleet's config", [ConfigFault("retention", "keeps everything", advice)])
    months: list[str] = []
    others = forgotten = 0
    if limits.record_months is not None:
        before = months_before(now, limits.record_months)
        months = [name for name in _old(db, before) if _drop(db, name, before)]
        others = _drop_others(db, before)
        tell(f"{len(months)} months of records went")
    if limits.window_months is not None:
        before = months_before(now, limits.window_months)
        query = "UPDATE fleet.records SET window_name = NULL WHERE window_name IS NOT NULL AND stored_at < %s"
        forgotten = db.execute(query, (before,)).rowcount
    db.execute(_FORGET_REANALYSES)
    removed, freed = _remove_windows(db, fleet.objects.directory, tell)
    return {"months": months, "records_of_wrong_clocks": others, "windows_forgotten": forgotten,
            "files_removed": removed, "bytes_freed": freed}  # fmt: skip


def months_before(now: datetime, months: int) -> datetime:
    """Return the beginning of the month that lies so many before that of ``now``."""
    count = now.year * 12 + now.month - 1 - months
    return datetime(count // 12, count % 12 + 1, 1, tzinfo=UTC)


def _old(db: Db, before: datetime) -> list[str]:
    """Return the partitions of the months before a date, the oldest first."""
    query = """SELECT c.relname AS name FROM pg_inherits i JOIN pg_class c ON c.oid = i.inhrelid
      WHERE i.inhparent = 'fleet.records'::regclass ORDER BY c.relname"""
    names = [str(row["name"]) for row in db.execute(query)]
    parts = [(name, found) for name in names if (found := _PARTITION.fullmatch(name))]
    return [name for name, found in parts if (int(found[1]), int(found[2])) < (before.year, before.month)]


def _drop(db: Db, name: str, before: datetime) -> bool:
    """Drop a partition whole, unless something came into it since; what is needed of it is kept, all or nothing."""
    table = sql.Identifier("fleet", name)
    with db.transaction():
        db.execute("SELECT pg_advisory_xact_lock(%s)", (LOCK,))
        db.execute("LOCK TABLE ONLY fleet.records IN ACCESS EXCLUSIVE MODE")  # nothing comes in between
        newest = sql.SQL("SELECT 1 FROM {} WHERE stored_at >= %s LIMIT 1").format(table)
        if db.execute(newest, (before,)).fetchone() is not None:
            return False
        _note(db, table)
        db.execute(sql.SQL("DROP TABLE {}").format(table))
    return True


def _drop_others(db: Db, before: datetime) -> int:
    """Remove what wrong clocks told, by when it came; return how much."""
    table = sql.Identifier("fleet", _OTHER)
    with db.transaction():
        db.execute(sql.SQL("LOCK TABLE {} IN SHARE ROW EXCLUSIVE MODE").format(table))
        old = sql.SQL("(SELECT * FROM {} WHERE stored_at < {})").format(table, sql.Literal(before))
        _note(db, old)
        return db.execute(sql.SQL("DELETE FROM {} WHERE stored_at < %s").format(table), (before,)).rowcount


def _note(db: Db, going: sql.Composable) -> None:
    for statement in (_NOTE_GOING, _KEEP_FIRST, _KEEP_ABOUT):
        db.execute(sql.SQL(statement).format(of=going))


def _remove_windows(db: Db, folder: Path, tell: Callable[[str], None]) -> tuple[int, int]:
    """Remove the files of windows that no row names; return how many, and their bytes. StoreError."""
    removed = freed = 0
    until_s = time.time() - LEAST_AGE_S
    for part in sorted(folder.glob("[0-9a-f][0-9a-f]")):
        names = [path.stem for path in part.glob("*.parquet") if path.stat().st_mtime < until_s]
        for first in range(0, len(names), MOST_FILES):
            for name in _unnamed(db, names[first : first + MOST_FILES]):
                freed += _remove(path_of(folder, name), until_s)
                removed += 1
        tell(f"{part.name} of ff: {removed} windows removed")
    return removed, freed


def _unnamed(db: Db, names: Sequence[str]) -> list[str]:
    query = """SELECT name FROM unnest(%s::text[]) AS name
      WHERE NOT EXISTS (SELECT FROM fleet.records r WHERE r.window_name = name)"""
    return [str(row["name"]) for row in db.execute(query, (list(names),))]


def _remove(path: Path, until_s: float) -> int:
    """Remove a file unless it was written anew meanwhile; return its bytes."""
    try:
        found = path.stat()
        if found.st_mtime >= until_s:
            return 0
        path.unlink()
    except FileNotFoundError:  # another run of this was faster
        return 0
    except OSError as error:
        raise StoreError(f"{path} cannot be removed: {error.strerror}; check [objects] directory") from None
    return found.st_size
