"""Answers queries about all machines from the views of the database, as JSON data."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fdhil.fleet.axis_services import list_services
from fdhil.fleet.maintenance_forecast import forecast_maintenance
from fdhil.fleet.outliers import ParameterHistory, PeerGroup, assess_peers, predict_from_other_axes
from fdhil.fleet.parameter_sets import (
    MONTH_S,
    Db,
    Row,
    compute_ages_months,
    fetch_newest_sets,
    format_time,
    list_axes,
    read_std,
    replace_non_finite,
)
from fdhil.records import INTERVAL_95, PARAMETERS, freeze_array, get_unit

NEWEST_SETS = 50  # of an axis in comparisons
LEAST_TREND = 5  # sets
GROUP_FIGURES = ("median", "spread", "slope_per_k", "slope_per_month", "temperature_c", "age_months", "bound")
Rows = Sequence[Row]
_OPEN = """
SELECT n.machine, count(*) AS open FROM fleet.notices n LEFT JOIN
  (SELECT machine, store, jsonb_array_elements(notices)::bigint AS number FROM fleet.acknowledgements) a
  USING (machine, store, number)
WHERE n.severity <> 'info' AND a.number IS NULL GROUP BY n.machine
"""


def read_fleet_status(db: Db) -> dict[str, Any]:
    """Return the state of every machine: last contact, missing records, newest parameters, open notices; due limits."""
    waiting = {row["machine"]: row["open"] for row in db.execute(_OPEN)}
    newest: dict[str, dict[str, Any]] = {}
    for row in db.execute("SELECT * FROM fleet.newest_parameter_sets"):
        newest.setdefault(row["machine"], {})[row["axis"]] = _describe_set(row)
    machines = [
        {
            "machine": row["machine"],
            "name": (row["about"] or {}).get("name", row["machine"]),
            "labels": (row["about"] or {}).get("labels", {}),
            "last_heard": format_time(row["last_stored_at"]),
            "records": row["records"],
            "missing": row["missing"],
            "doubt": _explain_doubt(row),
            "open_notices": waiting.get(row["machine"], 0),
            "axes": newest.get(row["machine"], {}),
        }
        for row in db.execute("SELECT * FROM fleet.machines ORDER BY machine")
    ]
    refused = db.execute("SELECT count(*) AS refused FROM fleet.refused").fetchone()
    return {
        "machines": machines,
        "due": forecast_maintenance(db),
        "refused_messages": refused["refused"] if refused else 0,
    }


def _explain_doubt(row: Row) -> str | None:
    """Return why the records under a machine's name may come from two machines; None without a sign of that."""
    if not row["repeated"] and not row["in_turn"]:
        return None
    sign = f"{row['repeated']} records with repeated numbers" if row["repeated"] else "two histories"
    return f"{sign}: two machines use this name, or an older copy of its history was restored"


def compute_trend(db: Db, machine: str, axis: str, parameter: str) -> dict[str, Any]:
    """Return the history of a parameter of an axis: each set, and the slope per 30 days (the median of all pairs)."""
    query = "SELECT * FROM fleet.parameter_sets WHERE machine = %s AND axis = %s ORDER BY stored_at, sequence"
    rows = db.execute(query, (machine, axis)).fetchall()
    points = [
        {"time": format_time(row["at"]), "revision": row["revision"], "temperature_c": row["temperature_c"]}
        | _describe_parameter(row, parameter)
        for row in rows
    ]
    pairs = [(row["at"].timestamp(), row[parameter]) for row in rows if row[parameter] is not None]
    return {"machine": machine, "axis": axis, "parameter": parameter, "unit": get_unit(parameter), "sets": points} | {
        "slope_per_30_days": _estimate_slope(pairs)
    }


def _estimate_slope(pairs: list[tuple[float, float]]) -> float | None:
    """Return the median slope of all pairs of the newest 500 (Theil and Sen); None for too few or one instant."""
    if len(pairs) < LEAST_TREND:
        return None
    at_s, values = np.array(pairs[-500:]).T
    first, second = np.triu_indices(at_s.size, 1)
    apart_s = at_s[second] - at_s[first]
    slopes = (values[second] - values[first])[apart_s != 0] / apart_s[apart_s != 0]
    return float(np.median(slopes) * MONTH_S) if slopes.size else None


def compare_parameter(db: Db, parameter: str, by: str, axis: str | None) -> dict[str, Any]:
    """Return a parameter of the same axis of all machines, grouped by the label ``by`` of the machines."""
    groups = _collect_groups(db, by, axis)
    return {"parameter": parameter, "unit": get_unit(parameter), "by": by, "groups": _compare_groups(groups, parameter)}


def _compare_groups(groups: Mapping[tuple[str, str], Sequence[Rows]], parameter: str) -> list[dict[str, Any]]:
    courses = {key: [_build_history(rows, parameter) for rows in axes if rows[-1][parameter] is not None]
               for key, axes in groups.items()}  # fmt: skip
    judged = {key: assess_peers(own) for key, own in courses.items()}
    found = []
    for key, own in courses.items():
        same = [peers for (label, _), peers in judged.items() if label == key[0] and peers is not None]
        found += [_describe_group(key, own, judged[key], predict_from_other_axes(same))] if own else []
    return found


def _describe_group(
    key: tuple[str, str],
    courses: Sequence[ParameterHistory],
    peers: PeerGroup | None,
    expected: Mapping[tuple[str, str], float],
) -> dict[str, Any]:
    listed = [
        {"machine": c.machine, "axis": c.axis, "value": c.values[-1], "std": replace_non_finite(c.std)}
        for c in sorted(courses, key=lambda course: float(course.values[-1]))
    ]
    figures = {name: None if peers is None else replace_non_finite(getattr(peers, name)) for name in GROUP_FIGURES}
    outliers = [
        {"machine": level.machine, "value": level.value, "off": level.off, "score": replace_non_finite(level.score),
         "off_by_its_other_axes": expected[level.machine, level.axis]}
        for level in (peers.levels if peers is not None else ()) if level.is_outlier
    ]  # fmt: skip
    return {"label": key[0], "axis": key[1], "sisters": listed, **figures, "outliers": outliers}


def find_outliers(db: Db, by: str, axis: str | None) -> dict[str, Any]:
    """Return the axes that deviate from their peers in a parameter, the largest deviation first."""
    groups, found = _collect_groups(db, by, axis), []
    doubts = {row["machine"]: _explain_doubt(row) for row in db.execute("SELECT * FROM fleet.machines")}
    for parameter in PARAMETERS:
        for group in _compare_groups(groups, parameter):
            of_group = {name: group[name] for name in ("label", "axis", "median", "bound")}
            found += [
                {"parameter": parameter, "unit": get_unit(parameter), "sisters": len(group["sisters"])}
                | of_group
                | each
                | {"doubt": doubts.get(each["machine"])}
                for each in group["outliers"]
            ]
    found.sort(key=lambda each: -math.inf if each["score"] is None else -abs(each["score"]))
    return {"by": by, "outliers": found}


def _collect_groups(db: Db, by: str, axis: str | None) -> dict[tuple[str, str], list[Rows]]:
    labels = {row["machine"]: row["about"] or {} for row in db.execute("SELECT machine, about FROM fleet.machines")}
    groups: dict[tuple[str, str], list[Rows]] = {}
    for (machine, letter), rows in fetch_newest_sets(db, NEWEST_SETS, list_axes(db, axis)).items():
        groups.setdefault((_find_label(labels.get(machine, {}), letter, by), letter), []).append(rows)
    return groups


def _build_history(rows: Rows, parameter: str) -> ParameterHistory:
    known_rows = [row for row in rows if row[parameter] is not None]
    values = freeze_array([row[parameter] for row in known_rows])
    at_c = freeze_array([math.nan if row["temperature_c"] is None else row["temperature_c"] for row in known_rows])
    last = known_rows[-1]
    return ParameterHistory(
        last["machine"],
        last["axis"],
        values,
        at_c,
        freeze_array(compute_ages_months(known_rows)),
        read_std(last, parameter),
    )


def _find_label(about: Mapping[str, Any], axis: str, by: str) -> str:
    own = about.get("axis_labels", {}).get(axis, {})
    return str(own.get(by) or about.get("labels", {}).get(by) or "")


def _describe_set(row: Mapping[str, Any]) -> dict[str, Any]:
    figures = {name: _describe_parameter(row, name) | {"unit": get_unit(name)} for name in PARAMETERS}
    head = {"revision": row["revision"], "time": format_time(row["at"]), "temperature_c": row["temperature_c"]}
    return head | {"parameters": figures}


def _describe_parameter(row: Mapping[str, Any], parameter: str) -> dict[str, Any]:
    value, half = row[parameter], INTERVAL_95 * read_std(row, parameter)
    has_interval = value is not None and math.isfinite(half)
    low, high = (value - half, value + half) if has_interval else (None, None)
    return {"value": value, "low": low, "high": high}


QUERIES: Mapping[str, Callable[..., dict[str, Any]]] = {
    "status": read_fleet_status,
    "trend": compute_trend,
    "compare": compare_parameter,
    "outliers": find_outliers,
    "services": list_services,
}
