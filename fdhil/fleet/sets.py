"""Reads the parameter sets of axes from the database, since the newest service of each, with its age."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from itertools import groupby
from typing import Any, LiteralString

import psycopg
from psycopg.rows import DictRow, dict_row

from fdhil.config.fleet import Fleet
from fdhil.errors import ConnectError, StoreError
from fdhil.records import PARAMETERS

MONTH_S = 30 * 86_400.0
SHIFT = "6 hours"
SORTED_MB = 64  # in memory: what is asked looks at all sets
Db = psycopg.Connection[DictRow]
Row = Mapping[str, Any]
# of what is published again and again the newest of each shift stands for all: a course is weeks, not minutes
_THINNED: LiteralString = """
SELECT * FROM (SELECT *, row_number() OVER (PARTITION BY machine, axis ORDER BY stored_at DESC, sequence DESC) AS back
  FROM (SELECT DISTINCT ON (s.machine, s.axis, date_bin(%(apart)s::interval, s.at, 'epoch'::timestamptz)) s.*,
      coalesce(a.serviced_at, a.first_at) AS since
    FROM fleet.parameter_sets s JOIN fleet.axes a USING (machine, axis)
    WHERE (%(machine)s::text IS NULL OR s.machine = %(machine)s) AND (%(axis)s::text IS NULL OR s.axis = %(axis)s)
      AND s.at >= coalesce(a.serviced_at, '-infinity')
    ORDER BY s.machine, s.axis, date_bin(%(apart)s::interval, s.at, 'epoch'::timestamptz), s.stored_at DESC,
      s.sequence DESC
  ) AS thinned) AS numbered
WHERE back <= %(most)s ORDER BY machine, axis, back DESC
"""


@contextmanager
def asking(fleet: Fleet) -> Iterator[Db]:
    """Enter the database, to read; errors as of :func:`entered`."""
    with entered(fleet) as db:
        db.execute(f"SET work_mem = '{SORTED_MB}MB'")
        db.execute("SET default_transaction_read_only = on")
        yield db


@contextmanager
def entered(fleet: Fleet) -> Iterator[Db]:
    """Enter the database. ConnectError where that cannot be done, StoreError where nothing was collected."""
    try:
        with psycopg.connect(fleet.database.connection, row_factory=dict_row, autocommit=True) as db:
            yield db
    except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
        text = "nothing was collected yet, or by an older fdhil alone: start fdhil fleet collect first"
        raise StoreError(text, "NoHistory") from None
    except psycopg.Error as error:
        raise unreachable(error) from None


def unreachable(error: psycopg.Error) -> ConnectError:
    """Return what is said of a database that cannot be entered, or does not do what it is asked."""
    text = f"{' '.join(str(error).split())}; check [database] connection, and whether it runs"
    return ConnectError("PostgreSQL", text)


def newest_sets(
    db: Db, most: int, apart: str = SHIFT, machine: str | None = None, axis: str | None = None
) -> dict[tuple[str, str], list[DictRow]]:
    """Return the newest sets of each axis since its newest service, oldest first, one of each time ``apart``."""
    rows = db.execute(_THINNED, {"most": most, "apart": apart, "machine": machine, "axis": axis}).fetchall()
    return {key: list(own) for key, own in groupby(rows, key=lambda row: (row["machine"], row["axis"]))}


def ages_months(rows: Sequence[Row]) -> list[float]:
    """Return the age of an axis at each of its sets, since its first set or its newest service."""
    return [(row["at"] - row["since"]).total_seconds() / MONTH_S for row in rows]


def std_of(row: Row, parameter: str) -> float:
    """Return a parameter's standard deviation by the covariance as it was told; NaN where there is none."""
    k = PARAMETERS.index(parameter)
    try:
        variance = float(row["covariance"][k][k])
    except (TypeError, IndexError, ValueError):
        return math.nan
    return math.sqrt(variance) if variance >= 0 else math.nan


def known(value: float) -> float | None:
    """Return a number as JSON has it: null where there is none."""
    return value if math.isfinite(value) else None


def date_of(at: datetime) -> str:
    """Return a time as JSON has it."""
    return at.isoformat(timespec="seconds")
