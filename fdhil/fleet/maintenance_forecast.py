"""Forecasts when an axis reaches a maintenance limit, by the rule of its own machine, over many months."""

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any, LiteralString

import psycopg
from pydantic import ValidationError

from fdhil.config import Maintenance
from fdhil.fleet.parameter_sets import (
    OF_AXES,
    SERVICED,
    Axis,
    Db,
    Row,
    build_axis_arguments,
    fetch_newest_sets,
    list_axes,
    read_std,
)
from fdhil.records import PARAMETERS, get_unit
from fdhil.report import assess_axis_health
from fdhil.store import StoredWindow, TimeStamp

NEWEST_SETS, APART = 180, "1 day"  # half a year
TOGETHER = 500  # axes per query
# ``stored_at`` is never before ``at``, and has an index
_FIRST: LiteralString = f"""
SELECT f.* {OF_AXES}, {SERVICED}, LATERAL (SELECT * FROM fleet.parameter_sets s
  WHERE s.machine = a.machine AND s.axis = a.axis AND s.at >= coalesce(v.serviced_at, '-infinity')
    AND s.stored_at >= coalesce(v.serviced_at, '-infinity') ORDER BY s.stored_at, s.sequence LIMIT 1) f
"""
_LAST: LiteralString = f"""
SELECT a.machine, a.axis, n.*, c.limits, c.made_of, date_bin('1 day', n.at, 'epoch'::timestamptz)::text AS day,
  v.serviced_at::text AS serviced {OF_AXES} LEFT JOIN fleet.forecasts c USING (machine, axis), {SERVICED},
  LATERAL (SELECT s.at, "R", "L", "K", "Jt", "ft", "Cd" FROM fleet.shifts s
    WHERE s.machine = a.machine AND s.axis = a.axis ORDER BY shift DESC LIMIT 1) n
"""
_KEEP: LiteralString = """
INSERT INTO fleet.forecasts SELECT * FROM unnest(%s::text[], %s::text[], %s::text[], %s::jsonb[])
ON CONFLICT (machine, axis) DO UPDATE SET made_of = excluded.made_of, limits = excluded.limits
"""
Limits = Mapping[str, Mapping[str, Any]]


def forecast_maintenance(db: Db) -> list[dict[str, Any]]:
    """Return the limits that axes have reached or will reach, the earliest first.

    A limit is the change that the machine's [maintenance] allows from the first set since the axis' newest service.
    There is no date while a trend is uncertain or spans less than three days; no date lies further ahead than five
    times the span. Forecasts are stored and renewed once a day (there is one set a day), and after a new limit or
    service.
    """
    shares = {
        row["machine"]: _read_limit_shares(row["about"])
        for row in db.execute("SELECT machine, about FROM fleet.machines")
    }
    axes = [key for key in list_axes(db) if key[0] in shares]
    last = {(row["machine"], row["axis"]): row for row in db.execute(_LAST, build_axis_arguments(axes))}
    inputs = {key: json.dumps([row["day"], row["serviced"], shares[key[0]]]) for key, row in last.items()}
    limits: dict[Axis, Limits] = {key: row["limits"] for key, row in last.items() if row["made_of"] == inputs[key]}
    old = [key for key in last if key not in limits]
    for begin in range(0, len(old), TOGETHER):
        some = old[begin : begin + TOGETHER]
        limits |= (found := _forecast_limits(db, some, shares))
        _store_forecasts(db, [(*key, inputs[key], json.dumps(found[key])) for key in some])
    due_limits = []
    for key, each in limits.items():
        for parameter, limit in each.items():
            place = {"machine": key[0], "axis": key[1], "parameter": parameter, "unit": get_unit(parameter)}
            due_limits.append(place | {"value": last[key][parameter]} | dict(limit))
    return sorted(due_limits, key=lambda each: datetime.fromisoformat(each["date"]))


def _forecast_limits(db: Db, axes: Sequence[Axis], shares: Mapping[str, Mapping[str, float]]) -> dict[Axis, Limits]:
    first = {(row["machine"], row["axis"]): row for row in db.execute(_FIRST, build_axis_arguments(axes))}
    found: dict[Axis, Limits] = {key: {} for key in axes}
    for key, rows in fetch_newest_sets(db, NEWEST_SETS, axes, APART).items():
        limits = {
            name: (first[key][name], share)
            for name, share in shares[key[0]].items()
            if key in first and first[key][name]
        }
        found[key] = assess_axis_health(list(map(_convert_to_window, rows)), limits)["limits"]
    return found


def _store_forecasts(db: Db, rows: Sequence[tuple[str, str, str, str]]) -> None:
    with suppress(psycopg.errors.InsufficientPrivilege, psycopg.errors.ReadOnlySqlTransaction), db.transaction():
        db.execute("SET TRANSACTION READ WRITE")
        db.execute(_KEEP, [list(column) for column in zip(*sorted(rows), strict=True)])


def _read_limit_shares(about: Mapping[str, Any] | None) -> dict[str, float]:
    """Return the allowed relative change of each parameter: as reported by the machine, else fdhil's defaults."""
    try:
        return Maintenance.model_validate((about or {}).get("maintenance", {})).model_dump()
    except ValidationError:
        return Maintenance().model_dump()


def _convert_to_window(row: Row) -> StoredWindow:
    parameters = {
        name: {"value": row[name], "std": std}
        for name in PARAMETERS
        if row[name] is not None and math.isfinite(std := read_std(row, name))
    }
    stamp = TimeStamp(row["at"].timestamp(), "", 0)
    return StoredWindow(row["sequence"], row["axis"], "", 0, 1, True, None, (), parameters, row["temperature_c"], stamp)
