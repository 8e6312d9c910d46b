"""Records the services of axes and estimates what each changed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from fdhil.errors import StoreError
from fdhil.fleet.parameter_sets import Db, Row, format_time, read_std
from fdhil.identification import compute_student_95
from fdhil.records import PARAMETERS, Float, get_unit

MOST_SETS = 20  # on either side of a service, within NEAR
LEAST_SETS = 2  # on either side
NEAR = "60 days"
LEAST_RANGE_K = 2.0  # least range of temperature that separates its effect from the service
ENOUGH_FOR_WEAR = 8  # least number of sets that separates continuing wear from the service
DAY_S = 86_400.0
ROUNDING = 1e-6  # of the interval: numerical noise
_ENTER = """
INSERT INTO fleet.services (machine, axis, serviced_at, note) VALUES (%s, %s, %s, %s)
ON CONFLICT (machine, axis, serviced_at) DO UPDATE SET note = excluded.note, entered_at = now()
"""
_AROUND = f"""
SELECT * FROM (SELECT s.*, s.at >= %(at)s AS after, row_number() OVER (PARTITION BY s.axis, s.at >= %(at)s
    ORDER BY CASE WHEN s.at >= %(at)s THEN s.at - %(at)s ELSE %(at)s - s.at END) AS apart
  FROM fleet.parameter_sets s WHERE s.machine = %(machine)s AND (%(axis)s = '' OR s.axis = %(axis)s)
    AND s.at BETWEEN greatest(%(at)s - interval '{NEAR}', %(last)s) AND least(%(at)s + interval '{NEAR}', %(next)s)) n
WHERE apart <= {MOST_SETS} ORDER BY axis, at
"""
_LISTED = """
SELECT v.*,
  (SELECT coalesce(max(o.serviced_at), '-infinity') FROM fleet.services o WHERE o.machine = v.machine
    AND (o.axis = v.axis OR '' IN (o.axis, v.axis)) AND o.serviced_at < v.serviced_at)::text AS last,
  (SELECT coalesce(min(o.serviced_at), 'infinity') FROM fleet.services o WHERE o.machine = v.machine
    AND (o.axis = v.axis OR '' IN (o.axis, v.axis)) AND o.serviced_at > v.serviced_at)::text AS next
FROM fleet.services v WHERE %(machine)s::text IS NULL OR machine = %(machine)s ORDER BY serviced_at DESC, machine, axis
"""


@dataclass(frozen=True, slots=True)
class ServiceStep:
    """A parameter just ``before`` a service, and the ``size`` of its step with the standard deviation."""

    before: float
    size: float
    std: float
    freedom: int
    at_constant_temperature: bool


def enter_service(db: Db, machine: str, axis: str, at: datetime, note: str) -> dict[str, Any]:
    """Record a service of an axis, or of a whole machine (axis ''); StoreError for an unknown one."""
    query = "SELECT 1 FROM fleet.parameter_sets WHERE machine = %s AND (%s = '' OR axis = %s) LIMIT 1"
    if db.execute(query, (machine, axis, axis)).fetchone() is None:
        what = f"axis {axis} of {machine}" if axis else machine
        raise StoreError(f"no parameters of {what} were collected; see fdhil fleet status", "NotKept")
    db.execute(_ENTER, (machine, axis, at, note))
    return {"machine": machine, "axis": axis or None, "serviced_at": format_time(at), "note": note}


def remove_service(db: Db, machine: str, axis: str, at: datetime) -> dict[str, Any]:
    """Remove a service; StoreError where there is none on that day."""
    query = """DELETE FROM fleet.services WHERE machine = %s AND axis = %s
      AND serviced_at >= %s AND serviced_at < %s + interval '1 day' RETURNING note"""
    if not db.execute(query, (machine, axis, at, at)).fetchall():
        raise StoreError("no service is recorded on that day; see fdhil fleet services", "NotKept")
    return {"machine": machine, "axis": axis or None, "serviced_at": format_time(at), "removed": True}


def list_services(db: Db, machine: str | None = None) -> dict[str, Any]:
    """Return the services, the newest first, each with what it changed."""
    rows = db.execute(_LISTED, {"machine": machine}).fetchall()
    return {"services": [_describe_service(db, row) for row in rows]}


def _describe_service(db: Db, row: Row) -> dict[str, Any]:
    given = {"machine": row["machine"], "axis": row["axis"], "at": row["serviced_at"]}
    sets = db.execute(_AROUND, {**given, "last": row["last"], "next": row["next"]}).fetchall()
    changes = []
    for axis in sorted({each["axis"] for each in sets}):
        own = [each for each in sets if each["axis"] == axis]
        found = ((name, _estimate_change(own, name, row["serviced_at"])) for name in PARAMETERS)
        changes += [
            {"axis": axis, "parameter": name, "unit": get_unit(name), **change} for name, change in found if change
        ]
    head = {"machine": row["machine"], "axis": row["axis"] or None, "serviced_at": format_time(row["serviced_at"])}
    return head | {"note": row["note"], "changes": changes}


def _estimate_change(rows: Sequence[Row], parameter: str, at: datetime) -> dict[str, Any] | None:
    """Return a parameter before the service and its change, with the 95 % interval."""
    rows = [row for row in rows if row[parameter] is not None]
    since_days = np.array([(row["at"] - at).total_seconds() / DAY_S for row in rows])
    if min(np.count_nonzero(since_days >= 0), np.count_nonzero(since_days < 0)) < LEAST_SETS:
        return None
    values = np.array([row[parameter] for row in rows])
    stds = np.array([read_std(row, parameter) for row in rows])
    at_c = np.array([math.nan if row["temperature_c"] is None else row["temperature_c"] for row in rows])
    step = estimate_step(values, stds, since_days, at_c)
    half = compute_student_95(step.freedom) * step.std
    size = step.size if abs(step.size) > ROUNDING * half else 0.0
    figures = {"before": step.before, "change": size, "low": size - half, "high": size + half}
    return figures | {"sure": abs(size) > half, "at_constant_temperature": step.at_constant_temperature}


def estimate_step(values: Float, stds: Float, since_days: Float, at_c: Float) -> ServiceStep:
    """Estimate the step of values (n,) at day 0 of ``since_days`` (n,).

    Continuing wear is separated, and so is the effect of temperature where it is known for all values and varies on
    both sides. The standard deviation is the larger of the scatter and the values' own ``stds``.
    """
    after = since_days >= 0
    columns = [np.ones(after.size), after.astype(np.float64)]
    if after.size >= ENOUGH_FOR_WEAR:
        columns.append(since_days)
    warmed = bool(np.isfinite(at_c).all()) and all(np.ptp(at_c[after == side]) >= LEAST_RANGE_K for side in (0, 1))
    if warmed and after.size > len(columns) + 1:
        columns.append(at_c - at_c.mean())
    x = np.column_stack(columns)
    inverse = np.linalg.pinv(x.T @ x)
    theta = inverse @ x.T @ values
    freedom = max(1, after.size - x.shape[1])
    scatter = float(((values - x @ theta) ** 2).sum()) / freedom
    expected = float(np.nanmean(stds**2)) if np.isfinite(stds).any() else 0.0
    std = math.sqrt(max(scatter, expected) * inverse[1, 1])
    return ServiceStep(float(theta[0]), float(theta[1]), std, freedom, warmed)
