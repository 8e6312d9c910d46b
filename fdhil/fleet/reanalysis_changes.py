"""Summarises what a re-analysis changed: parameter shifts per axis, and windows whose verdict changed."""

from typing import Any, LiteralString

from fdhil.errors import StoreError
from fdhil.fleet.parameter_sets import Db
from fdhil.records import INTERVAL_95, get_unit

MOST_LISTED = 1000  # limit of listed windows (changed verdict or unreadable); all of them are counted
# labels as reported last; an axis' own label overrides its machine's
_LABELLED: LiteralString = """
WITH of AS MATERIALIZED (
  SELECT r.*, coalesce(m.about->'axis_labels'->r.axis->>%(by)s, m.about->'labels'->>%(by)s, '') AS label
  FROM fleet.reanalysed r JOIN fleet.machines m USING (machine) WHERE revision = %(revision)s)
"""
_COUNTS: LiteralString = """
SELECT count(*) AS windows, count(error) AS unreadable, count(*) FILTER (WHERE NOT configured) AS without_config,
  encode(sha256(convert_to(string_agg(digest, '' ORDER BY machine, window_name), 'UTF8')), 'hex') AS digest
FROM (SELECT machine, window_name, digest, result#>>'{error,text}' AS error,
        (result->>'configured')::boolean AS configured
      FROM fleet.reanalysed_windows WHERE revision = %(revision)s) AS results
"""


def _cast_number_sql(value: LiteralString) -> LiteralString:
    """Return the SQL that converts a JSON value to a number, NULL for any other JSON type or magnitude."""
    size = f"abs(({value})::numeric)"
    fits = f"jsonb_typeof({value}) = 'number' AND ({size} = 0 OR {size} BETWEEN 1e-100 AND 1e100)"
    return f"CASE WHEN {fits} THEN ({value})::float8 END"


def _select_json_type_sql(value: LiteralString, kind: LiteralString, empty: LiteralString) -> LiteralString:
    return f"CASE WHEN jsonb_typeof({value}) = '{kind}' THEN {value} ELSE '{empty}' END"


# windows accepted before and after; ``off`` 1 is the end of the new 95 % interval
_MOVED: LiteralString = (
    f""", each AS MATERIALIZED (
  SELECT label, axis, b.key AS parameter, {_cast_number_sql("b.value->'value'")} AS before,
    {_cast_number_sql("parameters->b.key->'value'")} AS now, {_cast_number_sql("parameters->b.key->'std'")} *
    %(interval)s AS half
  FROM of, jsonb_each({_select_json_type_sql("parameters_before", "object", "{}")}) b
  WHERE accepted AND accepted_before),
moved AS (SELECT *, now - before AS by FROM each)
"""
    """SELECT label, axis, parameter, count(by) AS windows,
  percentile_cont(0.5) WITHIN GROUP (ORDER BY by / nullif(abs(before), 0)) AS change,
  percentile_cont(0.5) WITHIN GROUP (ORDER BY abs(by) / nullif(half, 0)) AS off, max(abs(by) / nullif(half, 0)) AS most,
  count(*) FILTER (WHERE abs(by) > half) AS outside
FROM moved GROUP BY label, axis, parameter HAVING count(by) > 0 ORDER BY label, axis, parameter
"""
)
_WHY: LiteralString = _select_json_type_sql("CASE WHEN accepted THEN reasons_before ELSE reasons END", "array", "[]")
_VERDICTS: LiteralString = f"""
SELECT label, axis, accepted, split_part(reason, ':', 1) AS reason, count(*) AS windows FROM of
  LEFT JOIN LATERAL jsonb_array_elements_text({_WHY})
    WITH ORDINALITY AS why (reason, place) ON place = 1
WHERE accepted <> accepted_before GROUP BY label, axis, accepted, split_part(reason, ':', 1)
ORDER BY label, axis, accepted, windows DESC
"""
_LISTED: LiteralString = f"""
SELECT machine, axis, number, window_name, recorded_at, accepted, error, {_WHY} AS reasons FROM of
WHERE accepted <> accepted_before OR error IS NOT NULL ORDER BY machine, axis, number LIMIT %(most)s
"""


def summarise_changes(db: Db, revision: int, by: str) -> dict[str, Any]:
    """Return what a revision changed against the machines' own results, grouped by a label of the machines.

    ``digest`` covers all results in order: equal bits give an equal digest. StoreError for an unknown revision.
    """
    arguments = {"revision": revision, "by": by, "interval": INTERVAL_95, "most": MOST_LISTED}
    method = db.execute("SELECT method FROM fleet.reanalyses WHERE revision = %(revision)s", arguments).fetchone()
    if method is None:
        raise StoreError(f"re-analysis {revision} does not exist; run fdhil fleet reanalyse to create one", "NoHistory")
    counts = db.execute(_COUNTS, arguments).fetchone()
    assert counts is not None
    moved = db.execute(_LABELLED + _MOVED, arguments).fetchall()
    return {
        "revision": revision,
        "method": method["method"],
        **counts,
        "by": by,
        "moved": [row | {"unit": get_unit(row["parameter"])} for row in moved],
        "verdicts": db.execute(_LABELLED + _VERDICTS, arguments).fetchall(),
        "listed": [
            row | {"recorded_at": row["recorded_at"].isoformat(timespec="seconds")}
            for row in db.execute(_LABELLED + _LISTED, arguments)
        ],
    }
