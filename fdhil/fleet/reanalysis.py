"""Analyses the stored windows of many machines again, by another method or another fdhil, as a new revision.

The machines' own results are kept. A revision belongs to one method (its settings, the given configurations, the code);
completed windows are skipped, so that an interrupted run resumes.
"""

import asyncio
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import partial
from typing import Any, LiteralString

import psycopg
from psycopg.types.json import Jsonb

from fdhil.config import Fleet
from fdhil.errors import StoreError
from fdhil.fleet import schema_migrations
from fdhil.fleet.parameter_sets import Db, open_database
from fdhil.fleet.window_reanalysis import AnalysisMethod, ReanalysedWindow, WindowReference, reanalyse_batch
from fdhil.fleet.worker_pools import WindowCrew

Progress = Callable[[int, int], None]
_LOCK = 7_170_019  # first key of the advisory lock on a revision
_OPEN: LiteralString = """
  FROM fleet.windows w WHERE window_name IS NOT NULL
    AND (%(machine)s::text IS NULL OR machine = %(machine)s) AND (%(axis)s::text IS NULL OR axis = %(axis)s)
    AND (%(since)s::timestamptz IS NULL OR least(recorded_at, stored_at) >= %(since)s)
    AND (%(until)s::timestamptz IS NULL OR least(recorded_at, stored_at) < %(until)s)
    AND NOT EXISTS (SELECT 1 FROM fleet.reanalysed_windows a WHERE a.revision = %(revision)s
      AND a.machine = w.machine AND a.window_name = w.window_name AND NOT a.result ? 'error')
"""
_KEEP = """
INSERT INTO fleet.reanalysed_windows AS a (revision, machine, window_name, digest, result)
VALUES (%s, %s, %s, %s, %s) ON CONFLICT (revision, machine, window_name)
DO UPDATE SET digest = excluded.digest, result = excluded.result, done_at = now() WHERE a.result ? 'error'
"""


@dataclass(frozen=True, slots=True)
class WindowScope:
    """The windows to analyse: those recorded in a period, of one machine or all, of one axis or all."""

    since: datetime | None = None
    until: datetime | None = None
    machine: str | None = None
    axis: str | None = None


def ignore_progress(done: int, total: int) -> None: ...


def reanalyse_windows(
    fleet: Fleet, method: AnalysisMethod, scope: WindowScope, pool: WindowCrew, progress: Progress = ignore_progress
) -> int:
    """Analyse the windows of a scope that a method's revision lacks, and return the number of the revision.

    ``progress`` receives the number of completed windows and the total. ConnectError where the database cannot be
    opened, StoreError where nothing was collected or another process works on the same revision, FdhilError of a
    worker.
    """
    with open_database(fleet) as db, open_database(fleet) as reader:
        db.execute("SELECT FROM fleet.records LIMIT 1")
        asyncio.run(_upgrade_schema(fleet))
        revision = _register_revision(db, method)
        if not _query_integer(db, "SELECT pg_try_advisory_lock(%s, %s)", (_LOCK, revision)):
            raise StoreError(
                f"another fdhil fleet reanalyse is working on revision {revision}; wait until it ends", "Busy"
            )
        wanted = asdict(scope) | {"revision": revision}
        total = _query_integer(
            reader, f"SELECT count(*) FROM (SELECT DISTINCT machine, window_name {_OPEN}) AS open", wanted
        )
        done = 0
        progress(done, total)
        # small tasks keep all workers busy to the end
        pool = replace(pool, per_task=max(1, min(pool.per_task, total // (2 * pool.at_once))))
        with closing(_stream_open_windows(reader, wanted)) as windows:
            for task, results in pool.run_tasks(partial(reanalyse_batch, method=method), windows):
                _store_results(db, revision, results)
                done += len(task)
                progress(done, total)
    return revision


async def _upgrade_schema(fleet: Fleet) -> None:
    async with await psycopg.AsyncConnection.connect(fleet.database.connection, autocommit=True) as db:
        await schema_migrations.upgrade_schema(db)


def _register_revision(db: Db, method: AnalysisMethod) -> int:
    values = (method.digest, Jsonb(method.build_document()))
    db.execute("INSERT INTO fleet.reanalyses (digest, method) VALUES (%s, %s) ON CONFLICT DO NOTHING", values)
    return _query_integer(db, "SELECT revision FROM fleet.reanalyses WHERE digest = %s", (method.digest,))


def _query_integer(db: Db, query: LiteralString, values: Mapping[str, Any] | Sequence[Any]) -> int:
    row = db.execute(query, values).fetchone()
    assert row is not None
    return int(next(iter(row.values())))


def _stream_open_windows(db: Db, wanted: Mapping[str, Any]) -> Generator[WindowReference]:
    """Yield the open windows of the snapshot at the start."""
    with db.transaction(), db.cursor("open") as rows:
        for row in rows.execute(f"SELECT DISTINCT machine, window_name {_OPEN} ORDER BY 1, 2", wanted):
            yield WindowReference(row["machine"], row["window_name"])


def _store_results(db: Db, revision: int, results: Sequence[ReanalysedWindow]) -> None:
    with db.transaction(), db.cursor() as cursor:
        rows = [(revision, again.window.machine, again.window.name, again.digest, again.text) for again in results]
        cursor.executemany(_KEEP, rows)
