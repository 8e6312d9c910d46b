"""Tells when an axis reaches a maintenance limit: by the rule with which its own machine tells it, over many months."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from pydantic import ValidationError

from fdhil.config import Maintenance
from fdhil.fleet.sets import Db, Row, newest_sets, std_of
from fdhil.records import PARAMETERS, unit_of
from fdhil.report.history_trends import of_axis
from fdhil.store.rows import Stamp, StoredWindow

NEWEST_SETS, APART = 180, "1 day"  # half a year
_FIRST = """
SELECT DISTINCT ON (s.machine, s.axis) s.* FROM fleet.parameter_sets s JOIN fleet.axes a USING (machine, axis)
WHERE s.at >= coalesce(a.serviced_at, '-infinity') ORDER BY s.machine, s.axis, s.stored_at, s.sequence
"""


def due(db: Db) -> list[dict[str, Any]]:
    """Return the limits that axes have reached or will reach, the earliest first.

    A limit is what [maintenance] of the machine allows from the first set since the axis' newest service. There is no
    date while a trend is not sure, or was seen for less than three days; none lies farther ahead than five times that.
    """
    shares = {row["machine"]: _shares(row["about"]) for row in db.execute("SELECT machine, about FROM fleet.machines")}
    first = {(row["machine"], row["axis"]): row for row in db.execute(_FIRST)}
    found = []
    for key, rows in newest_sets(db, NEWEST_SETS, APART).items():
        limits = {
            name: (first[key][name], share)
            for name, share in shares[key[0]].items()
            if key in first and first[key][name]
        }
        for parameter, told in of_axis(list(map(_as_window, rows)), limits)["limits"].items():
            place = {"machine": key[0], "axis": key[1], "parameter": parameter, "unit": unit_of(parameter)}
            found.append(place | {"value": rows[-1][parameter]} | told)
    return sorted(found, key=lambda each: datetime.fromisoformat(each["date"]))


def _shares(about: Mapping[str, Any] | None) -> dict[str, float]:
    """Return by what share each parameter may change: as the machine told it, else as fdhil has it by itself."""
    try:
        told = Maintenance.model_validate((about or {}).get("maintenance", {}))
    except ValidationError:
        told = Maintenance()
    return told.model_dump()


def _as_window(row: Row) -> StoredWindow:
    parameters = {
        name: {"value": row[name], "std": std}
        for name in PARAMETERS
        if row[name] is not None and math.isfinite(std := std_of(row, name))
    }
    stamp = Stamp(row["at"].timestamp(), "", 0)
    return StoredWindow(row["sequence"], row["axis"], "", 0, 1, True, None, (), parameters, row["temperature_c"], stamp)
