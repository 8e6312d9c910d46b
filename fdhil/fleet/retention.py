"""Deletes records and windows older than the retention period: whole months, and windows that no row references.

A month is dropped when it is old and its last record arrived long ago, so that late records live as long as the rest.
The first parameter set of each axis and the newest description of each machine are kept, as ages and limits refer to
them; and the numbers of the records, so that none is stored again or reported missing.
"""

import re
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, LiteralString

from psycopg import sql

from fdhil.config import Fleet
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.fleet.parameter_sets import Db
from fdhil.fleet.schema_migrations import LOCK
from fdhil.fleet.window_files import build_window_path

LEAST_AGE_S = 86_400.0  # of a window file: its row may not be committed yet
MOST_FILES = 10_000  # per query
_PARTITION = re.compile(r"records_(\d{4})_(\d\d)")
_OTHER = "records_other"
# {of} are the rows to be deleted
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


def apply_retention(
    db: Db, fleet: Fleet, now: datetime, report: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Delete what [retention] does not keep, and return what was deleted. ConfigError where [retention] sets no period.

    An interrupted run is completed by the next one. StoreError where a window cannot be removed.
    """
    limits = fleet.retention
    if limits.record_months is None and limits.window_months is None:
        advice = "set record_months or window_months; without them everything is kept"
        raise ConfigError(
            "the fleet's config", [ConfigFault("retention", "sets no period, nothing was deleted", advice)]
        )
    months: list[str] = []
    others = forgotten = 0
    if limits.record_months is not None:
        before = compute_cutoff_month(now, limits.record_months)
        months = [name for name in _list_old_partitions(db, before) if _drop_partition(db, name, before)]
        others = _drop_misdated_records(db, before)
        report(f"{len(months)} months of records deleted")
    if limits.window_months is not None:
        before = compute_cutoff_month(now, limits.window_months)
        query = "UPDATE fleet.records SET window_name = NULL WHERE window_name IS NOT NULL AND stored_at < %s"
        forgotten = db.execute(query, (before,)).rowcount
    db.execute(_FORGET_REANALYSES)
    removed, freed = _remove_unreferenced_windows(db, fleet.objects.directory, report)
    return {"months": months, "records_of_wrong_clocks": others, "windows_forgotten": forgotten,
            "files_removed": removed, "bytes_freed": freed}  # fmt: skip


def compute_cutoff_month(now: datetime, months: int) -> datetime:
    """Return the beginning of the month ``months`` before that of ``now``."""
    count = now.year * 12 + now.month - 1 - months
    return datetime(count // 12, count % 12 + 1, 1, tzinfo=UTC)


def _list_old_partitions(db: Db, before: datetime) -> list[str]:
    query = """SELECT c.relname AS name FROM pg_inherits i JOIN pg_class c ON c.oid = i.inhrelid
      WHERE i.inhparent = 'fleet.records'::regclass ORDER BY c.relname"""
    names = [str(row["name"]) for row in db.execute(query)]
    parts = [(name, found) for name in names if (found := _PARTITION.fullmatch(name))]
    return [name for name, found in parts if (int(found[1]), int(found[2])) < (before.year, before.month)]


def _drop_partition(db: Db, name: str, before: datetime) -> bool:
    """Drop a whole partition unless a record arrived since; needed rows are kept, in one transaction."""
    table = sql.Identifier("fleet", name)
    with db.transaction():
        db.execute("SELECT pg_advisory_xact_lock(%s)", (LOCK,))
        db.execute("LOCK TABLE ONLY fleet.records IN ACCESS EXCLUSIVE MODE")  # no record may arrive meanwhile
        newest = sql.SQL("SELECT 1 FROM {} WHERE stored_at >= %s LIMIT 1").format(table)
        if db.execute(newest, (before,)).fetchone() is not None:
            return False
        _keep_needed_records(db, table)
        db.execute(sql.SQL("DROP TABLE {}").format(table))
    return True


def _drop_misdated_records(db: Db, before: datetime) -> int:
    """Delete records of wrong clocks by their time of arrival; return their number."""
    table = sql.Identifier("fleet", _OTHER)
    with db.transaction():
        db.execute(sql.SQL("LOCK TABLE {} IN SHARE ROW EXCLUSIVE MODE").format(table))
        old = sql.SQL("(SELECT * FROM {} WHERE stored_at < {})").format(table, sql.Literal(before))
        _keep_needed_records(db, old)
        return db.execute(sql.SQL("DELETE FROM {} WHERE stored_at < %s").format(table), (before,)).rowcount


def _keep_needed_records(db: Db, going: sql.Composable) -> None:
    for statement in (_NOTE_GOING, _KEEP_FIRST, _KEEP_ABOUT):
        db.execute(sql.SQL(statement).format(of=going))


def _remove_unreferenced_windows(db: Db, folder: Path, report: Callable[[str], None]) -> tuple[int, int]:
    removed = freed = 0
    until_s = time.time() - LEAST_AGE_S
    for part in sorted(folder.glob("[0-9a-f][0-9a-f]")):
        names = [path.stem for path in part.glob("*.parquet") if path.stat().st_mtime < until_s]
        for first in range(0, len(names), MOST_FILES):
            for name in _find_unreferenced(db, names[first : first + MOST_FILES]):
                freed += _remove_file(build_window_path(folder, name), until_s)
                removed += 1
        report(f"folder {part.name} of ff: {removed} windows removed")
    return removed, freed


def _find_unreferenced(db: Db, names: Sequence[str]) -> list[str]:
    query = """SELECT name FROM unnest(%s::text[]) AS name
      WHERE NOT EXISTS (SELECT FROM fleet.records r WHERE r.window_name = name)"""
    return [str(row["name"]) for row in db.execute(query, (list(names),))]


def _remove_file(path: Path, until_s: float) -> int:
    """Remove a file unless it was written again meanwhile; return its size in bytes."""
    try:
        found = path.stat()
        if found.st_mtime >= until_s:
            return 0
        path.unlink()
    except FileNotFoundError:  # another run has removed it
        return 0
    except OSError as error:
        raise StoreError(f"{path} cannot be removed: {error.strerror}; check [objects] directory") from None
    return found.st_size
