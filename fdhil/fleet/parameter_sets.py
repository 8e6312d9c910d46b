"""Reads the parameter sets of axes from the database, since the newest service of each, with their ages."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from itertools import groupby
from typing import Any, LiteralString

import psycopg
from psycopg.rows import DictRow, dict_row

from fdhil.config import Fleet
from fdhil.errors import ConnectError, StoreError
from fdhil.fleet.schema_migrations import KNOWN_AXES
from fdhil.records import PARAMETERS

MONTH_S = 30 * 86_400.0
SHIFT = "6 hours"
SORTED_MB = 64  # memory for sorting: queries read all sets
Db = psycopg.Connection[DictRow]
Row = Mapping[str, Any]
Axis = tuple[str, str]  # machine and axis
# the newest set of each shift represents it: trends take weeks, not minutes
_AXES: LiteralString = f"{KNOWN_AXES} SELECT machine, axis FROM known WHERE %(axis)s::text IS NULL OR axis = %(axis)s"
SERVICED: LiteralString = """
LATERAL (SELECT max(o.serviced_at) AS serviced_at FROM fleet.services o WHERE o.machine = a.machine
  AND o.axis IN ('', a.axis) AND o.serviced_at <= now()) v
"""
OF_AXES: LiteralString = "FROM unnest(%(machines)s::text[], %(axes)s::text[]) a (machine, axis)"
_THINNED: LiteralString = f"""
SELECT n.machine, n.axis, n.sequence, n.at, n."R", n."L", n."K", n."Jt", n."ft", n."Cd", n.stds, n.temperature_c,
  coalesce(v.serviced_at, f.at) AS since {OF_AXES}, {SERVICED},
  LATERAL (SELECT at FROM fleet.shifts s WHERE s.machine = a.machine AND s.axis = a.axis ORDER BY shift LIMIT 1) f,
  LATERAL (SELECT DISTINCT ON (bin) s.*, date_bin(%(apart)s::interval, s.shift, 'epoch'::timestamptz) AS bin
    FROM fleet.shifts s WHERE s.machine = a.machine AND s.axis = a.axis AND s.at >= coalesce(v.serviced_at, '-infinity')
    ORDER BY bin DESC, s.stored_at DESC, s.sequence DESC LIMIT %(most)s) n
ORDER BY n.machine, n.axis, n.stored_at, n.sequence
"""


@contextmanager
def open_read_only(fleet: Fleet) -> Iterator[Db]:
    """Open the database read-only; errors as of :func:`entered`."""
    with open_database(fleet) as db:
        db.execute(f"SET work_mem = '{SORTED_MB}MB'")
        db.execute("SET default_transaction_read_only = on")
        yield db


@contextmanager
def open_database(fleet: Fleet) -> Iterator[Db]:
    """Open the database. ConnectError where that fails, StoreError where nothing was collected."""
    try:
        with psycopg.connect(fleet.database.connection, row_factory=dict_row, autocommit=True) as db:
            yield db
    except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
        text = "nothing was collected yet, or only by an older fdhil; start fdhil fleet collect first"
        raise StoreError(text, "NoHistory") from None
    except psycopg.Error as error:
        raise build_connect_error(error) from None


def build_connect_error(error: psycopg.Error) -> ConnectError:
    text = f"{' '.join(str(error).split())}; check [database] connection and that it is running"
    return ConnectError("PostgreSQL", text)


def list_axes(db: Db, axis: str | None = None) -> list[Axis]:
    """Return the axes that have sets, each with its machine; of one letter, or all."""
    return [(row["machine"], row["axis"]) for row in db.execute(_AXES, {"axis": axis})]


def build_axis_arguments(axes: Sequence[Axis]) -> dict[str, list[str]]:
    return {"machines": [machine for machine, _ in axes], "axes": [axis for _, axis in axes]}


def fetch_newest_sets(db: Db, most: int, axes: Sequence[Axis], apart: str = SHIFT) -> dict[Axis, list[DictRow]]:
    """Return the newest sets of axes since their newest service, oldest first, one per interval ``apart``."""
    rows = db.execute(_THINNED, {"most": most, "apart": apart, **build_axis_arguments(axes)}).fetchall()
    return {key: list(own) for key, own in groupby(rows, key=lambda row: (row["machine"], row["axis"]))}


def compute_ages_months(rows: Sequence[Row]) -> list[float]:
    """Return the age of an axis at each of its sets, since its first set or its newest service."""
    return [(row["at"] - row["since"]).total_seconds() / MONTH_S for row in rows]


def read_std(row: Row, parameter: str) -> float:
    """Return a parameter's standard deviation from the reported covariance; NaN where there is none."""
    k = PARAMETERS.index(parameter)
    if "stds" in row:
        return math.nan if row["stds"][k] is None else float(row["stds"][k])
    try:
        variance = float(row["covariance"][k][k])
    except (TypeError, LookupError, ValueError):
        return math.nan
    return math.sqrt(variance) if variance >= 0 else math.nan


def replace_non_finite(value: float) -> float | None:
    """Return a number for JSON: None for NaN and infinity."""
    return value if math.isfinite(value) else None


def format_time(at: datetime) -> str:
    return at.isoformat(timespec="seconds")
