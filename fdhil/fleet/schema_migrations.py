"""Creates and migrates the tables and views of the fleet's history in PostgreSQL's schema ``fleet``.

``records`` has all received records, one row each, partitioned by the month in which they were recorded; machine,
message and time identify a row. Records dated outside the partitioned years are in ``records_other``. Other programs
read the views.
"""

from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, LiteralString

import psycopg
from psycopg import sql
from psycopg.rows import tuple_row

from fdhil.errors import StoreError

FIRST_YEAR, LAST_YEAR = 2020, 2099  # range of the partitions: a wrong clock cannot create others
FIRST = datetime(FIRST_YEAR, 1, 1, tzinfo=UTC)  # records dated earlier get their time of arrival
FUTURE = datetime(LAST_YEAR + 1, 1, 1, tzinfo=UTC)  # date of records whose clock is far ahead
SHIFT_S = 21_600  # period that is represented by its newest set
LOCK = 7_170_018  # advisory lock for schema changes
_FIRST: LiteralString = """
CREATE TABLE fleet.records (
  machine text NOT NULL, message text NOT NULL, recorded_at timestamptz NOT NULL, store text NOT NULL,
  sequence bigint NOT NULL, axis text NOT NULL, kind text NOT NULL, stored_at timestamptz NOT NULL, window_name text,
  record jsonb NOT NULL, PRIMARY KEY (machine, message, recorded_at)) PARTITION BY RANGE (recorded_at);
CREATE TABLE fleet.records_other PARTITION OF fleet.records DEFAULT;
CREATE INDEX records_told ON fleet.records (machine, axis, kind, stored_at, sequence);
CREATE INDEX records_kind ON fleet.records (kind, recorded_at);
CREATE TABLE fleet.heard (machine text NOT NULL, store text NOT NULL, records bigint NOT NULL,
  last_sequence bigint NOT NULL, first_stored_at timestamptz NOT NULL, last_stored_at timestamptz NOT NULL,
  PRIMARY KEY (machine, store));
CREATE TABLE fleet.refused (received_at timestamptz NOT NULL DEFAULT now(), subject text NOT NULL, reason text NOT NULL,
  payload bytea NOT NULL);
"""
_VIEWS: LiteralString = """
CREATE VIEW fleet.machines AS
  SELECT h.machine, sum(h.records)::bigint AS records, max(h.last_stored_at) AS last_stored_at,
    sum(h.last_sequence - h.records)::bigint AS missing, count(*) AS stores,
    (SELECT a.record FROM fleet.records a WHERE a.machine = h.machine AND a.axis = '' AND a.kind = 'about'
     ORDER BY a.stored_at DESC LIMIT 1) AS about
  FROM fleet.heard h GROUP BY h.machine;
CREATE VIEW fleet.parameter_sets AS
  SELECT machine, axis, recorded_at, stored_at, store, sequence, (record->>'revision')::bigint AS revision,
    (record->>'R')::float8 AS "R", (record->>'L')::float8 AS "L", (record->>'K')::float8 AS "K",
    (record->>'Jt')::float8 AS "Jt", (record->>'ft')::float8 AS "ft", (record->>'Cd')::float8 AS "Cd",
    record->'covariance' AS covariance, record->'terms' AS terms, (record->>'windows')::bigint AS windows,
    (record->>'temperature_c')::float8 AS temperature_c, record->>'config_digest' AS config_digest
  FROM fleet.records WHERE kind = 'parameters' AND record ? 'revision';
CREATE VIEW fleet.newest_parameter_sets AS
  SELECT DISTINCT ON (machine, axis) * FROM fleet.parameter_sets
  ORDER BY machine, axis, stored_at DESC, sequence DESC;
CREATE VIEW fleet.windows AS
  SELECT machine, axis, recorded_at, stored_at, store, sequence, (record->>'number')::bigint AS number,
    (record->>'accepted')::int = 1 AS accepted, (record->>'fit_percent')::float8 AS fit_percent,
    record->'reasons' AS reasons, record->'parameters' AS parameters, (record->>'direction')::int AS direction,
    (record->>'temperature_c')::float8 AS temperature_c, (record->>'unexplained_um')::float8 AS unexplained_um,
    window_name
  FROM fleet.records WHERE kind = 'window' AND record ? 'accepted';
CREATE VIEW fleet.skills AS
  SELECT machine, axis, recorded_at, stored_at, store, sequence, (record->>'rms_um')::float8 AS rms_um,
    (record->>'max_um')::float8 AS max_um, (record->>'delay_ms')::float8 AS delay_ms,
    (record->>'measured_rms_um')::float8 AS measured_rms_um
  FROM fleet.records WHERE kind = 'skill' AND record ? 'rms_um';
CREATE VIEW fleet.notices AS
  SELECT machine, axis, recorded_at, stored_at, store, sequence, (record->>'number')::bigint AS number,
    record->>'code' AS code, record->>'severity' AS severity, record->>'text' AS text
  FROM fleet.records WHERE kind = 'notice' AND record ? 'code';
CREATE VIEW fleet.acknowledgements AS
  SELECT machine, recorded_at, stored_at, store, sequence, record->'notices' AS notices, record->>'who' AS who,
    record->>'note' AS note
  FROM fleet.records WHERE kind = 'acknowledgement' AND record ? 'who';
"""
# a revision belongs to one method; each window's new result is listed next to its machine's own
_REANALYSES: LiteralString = """
CREATE INDEX records_window ON fleet.records (window_name, machine) WHERE window_name IS NOT NULL;
CREATE TABLE fleet.reanalyses (revision integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY, digest text NOT NULL UNIQUE,
  method jsonb NOT NULL, begun_at timestamptz NOT NULL DEFAULT now());
CREATE TABLE fleet.reanalysed_windows (revision integer NOT NULL REFERENCES fleet.reanalyses ON DELETE CASCADE,
  machine text NOT NULL, window_name text NOT NULL, digest text NOT NULL, result jsonb NOT NULL,
  done_at timestamptz NOT NULL DEFAULT now(), PRIMARY KEY (revision, machine, window_name));
CREATE VIEW fleet.reanalysed AS
  SELECT a.revision, w.machine, w.axis, w.recorded_at, w.stored_at, w.number, a.window_name,
    w.accepted AS accepted_before, (a.result->>'accepted')::boolean AS accepted,
    (a.result->>'fit_percent')::float8 AS fit_percent, (a.result->>'unexplained_um')::float8 AS unexplained_um,
    w.reasons AS reasons_before, a.result->'reasons' AS reasons, w.parameters AS parameters_before,
    a.result->'parameters' AS parameters, (a.result->>'configured')::boolean AS configured,
    a.result#>>'{error,text}' AS error
  FROM fleet.reanalysed_windows a JOIN fleet.windows w USING (machine, window_name);
"""
# the roll-out: offers by machine and stage, and the machines' answers
_ROLL_OUT: LiteralString = """
CREATE TABLE fleet.offers (
  name text NOT NULL, version integer NOT NULL, stage integer NOT NULL, change text NOT NULL, machines text[] NOT NULL,
  opened_at timestamptz NOT NULL DEFAULT now(), opened_by text NOT NULL, despite text NOT NULL, document bytea NOT NULL,
  PRIMARY KEY (name, version, stage));
CREATE VIEW fleet.offer_answers AS
  SELECT machine, recorded_at, stored_at, record->>'name' AS name, (record->>'version')::bigint AS version,
    (record->>'stage')::bigint AS stage, record->>'document' AS document, record->>'answer' AS answer,
    record->>'by' AS answered_by, record->>'reason' AS reason, record->>'config_digest' AS config_digest
  FROM fleet.records WHERE kind = 'offer' AND record ? 'answer';
"""
# of deleted records, ``kept`` has those that are still needed; ``dropped`` has the numbers, so that
# none is stored again when it is sent again
_SERVICES: LiteralString = """
CREATE TABLE fleet.services (machine text NOT NULL, axis text NOT NULL, serviced_at timestamptz NOT NULL,
  note text NOT NULL, entered_at timestamptz NOT NULL DEFAULT now(), PRIMARY KEY (machine, axis, serviced_at));
CREATE TABLE fleet.kept (LIKE fleet.records, PRIMARY KEY (machine, axis, kind));
CREATE TABLE fleet.dropped (machine text NOT NULL, store text NOT NULL, sequences int8multirange NOT NULL,
  PRIMARY KEY (machine, store));
CREATE FUNCTION fleet.time_of(recorded_at timestamptz, stored_at timestamptz) RETURNS timestamptz IMMUTABLE LANGUAGE sql
  AS $$ SELECT CASE WHEN recorded_at < '2020-01-01Z' THEN stored_at ELSE least(recorded_at, stored_at) END $$;
CREATE VIEW fleet.told AS SELECT * FROM fleet.records UNION ALL SELECT * FROM fleet.kept;
CREATE OR REPLACE VIEW fleet.machines AS
  SELECT h.machine, sum(h.records)::bigint AS records, max(h.last_stored_at) AS last_stored_at,
    sum(h.last_sequence - h.records)::bigint AS missing, count(*) AS stores,
    (SELECT a.record FROM fleet.told a WHERE a.machine = h.machine AND a.axis = '' AND a.kind = 'about'
     ORDER BY a.stored_at DESC LIMIT 1) AS about
  FROM fleet.heard h GROUP BY h.machine;
CREATE OR REPLACE VIEW fleet.parameter_sets AS
  SELECT machine, axis, recorded_at, stored_at, store, sequence, (record->>'revision')::bigint AS revision,
    (record->>'R')::float8 AS "R", (record->>'L')::float8 AS "L", (record->>'K')::float8 AS "K",
    (record->>'Jt')::float8 AS "Jt", (record->>'ft')::float8 AS "ft", (record->>'Cd')::float8 AS "Cd",
    record->'covariance' AS covariance, record->'terms' AS terms, (record->>'windows')::bigint AS windows,
    (record->>'temperature_c')::float8 AS temperature_c, record->>'config_digest' AS config_digest,
    fleet.time_of(recorded_at, stored_at) AS at
  FROM fleet.told WHERE kind = 'parameters' AND record ? 'revision';
CREATE OR REPLACE VIEW fleet.newest_parameter_sets AS
  SELECT DISTINCT ON (machine, axis) * FROM fleet.parameter_sets
  ORDER BY machine, axis, stored_at DESC, sequence DESC;
CREATE VIEW fleet.axes AS
  SELECT s.machine, s.axis, min(s.at) AS first_at, max(s.at) AS last_at, count(*) AS sets,
    (SELECT max(v.serviced_at) FROM fleet.services v WHERE v.machine = s.machine AND v.axis IN ('', s.axis)
      AND v.serviced_at <= now()) AS serviced_at
  FROM fleet.parameter_sets s GROUP BY s.machine, s.axis;
CREATE VIEW fleet.labels AS
  SELECT m.machine, ''::text AS axis, l.key AS label, l.value AS text
  FROM fleet.machines m, jsonb_each_text(coalesce(m.about->'labels', '{}')) l
  UNION ALL SELECT m.machine, x.key, l.key, l.value
  FROM fleet.machines m, jsonb_each(coalesce(m.about->'axis_labels', '{}')) x, jsonb_each_text(x.value) l;
CREATE VIEW fleet.loops AS
  SELECT machine, axis, recorded_at, stored_at, store, sequence, record->>'structure' AS structure,
    record->'accepted' = '1' AS accepted, record->'gains' AS gains, record->'covariance' AS covariance,
    record->'unexplained_um' AS unexplained_um, record->'reasons' AS reasons
  FROM fleet.records WHERE kind = 'loops' AND record ? 'structure';
"""
# the newest set of each axis and six hours, used by queries over all machines in place of all sets; and the newest
# forecast of each axis' limits
_STDS: LiteralString = """
ARRAY(SELECT CASE WHEN jsonb_typeof(c.v) <> 'number' OR (c.v)::numeric < 0 THEN NULL WHEN (c.v)::numeric < 1e-250 THEN 0
    WHEN (c.v)::numeric < 1e250 THEN sqrt((c.v)::numeric::float8) END
  FROM generate_series(0, 5) k, LATERAL (SELECT r.record->'covariance'->k->k AS v) c ORDER BY k)
"""
_OF_SHIFTS: LiteralString = f"""
INSERT INTO fleet.shifts AS s SELECT DISTINCT ON (machine, axis, shift) r.machine, r.axis,
    date_bin('6 hours', fleet.time_of(r.recorded_at, r.stored_at), 'epoch'::timestamptz) AS shift,
    fleet.time_of(r.recorded_at, r.stored_at), r.stored_at, r.sequence, (r.record->>'revision')::bigint,
    (r.record->>'R')::float8, (r.record->>'L')::float8, (r.record->>'K')::float8, (r.record->>'Jt')::float8,
    (r.record->>'ft')::float8, (r.record->>'Cd')::float8, {_STDS}, (r.record->>'temperature_c')::float8
"""
_NEWER: LiteralString = """
  ORDER BY machine, axis, shift, stored_at DESC, sequence DESC
ON CONFLICT (machine, axis, shift) DO UPDATE SET at = excluded.at, stored_at = excluded.stored_at,
  sequence = excluded.sequence, revision = excluded.revision, "R" = excluded."R", "L" = excluded."L",
  "K" = excluded."K", "Jt" = excluded."Jt", "ft" = excluded."ft", "Cd" = excluded."Cd", stds = excluded.stds,
  temperature_c = excluded.temperature_c
WHERE (s.stored_at, s.sequence) < (excluded.stored_at, excluded.sequence)
"""
_IS_SET: LiteralString = "WHERE r.kind = 'parameters' AND r.record ? 'revision'"
NOTE_SHIFTS: LiteralString = f"""
{_OF_SHIFTS} FROM unnest(%s::text[], %s::text[], %s::timestamptz[]) AS n (machine, message, recorded_at)
  JOIN fleet.records r USING (machine, message, recorded_at) {_IS_SET} {_NEWER}
"""
NOTE_INCOMING: LiteralString = f"""
{_OF_SHIFTS} FROM incoming i JOIN fleet.records r USING (machine, message, recorded_at) {_IS_SET} {_NEWER}
"""
FILL_SHIFTS: LiteralString = f"{_OF_SHIFTS} FROM fleet.told r {_IS_SET} {_NEWER}"
KNOWN_AXES: LiteralString = """
WITH RECURSIVE known AS (
  (SELECT machine, axis FROM fleet.shifts ORDER BY machine, axis LIMIT 1)
  UNION ALL SELECT n.machine, n.axis FROM known k, LATERAL (SELECT machine, axis FROM fleet.shifts s
    WHERE (s.machine, s.axis) > (k.machine, k.axis) ORDER BY machine, axis LIMIT 1) n)
"""
_SHIFTS: LiteralString = f"""
CREATE TABLE fleet.shifts (machine text NOT NULL, axis text NOT NULL, shift timestamptz NOT NULL,
  at timestamptz NOT NULL, stored_at timestamptz NOT NULL, sequence bigint NOT NULL, revision bigint,
  "R" float8, "L" float8, "K" float8, "Jt" float8, "ft" float8, "Cd" float8, stds float8[], temperature_c float8,
  PRIMARY KEY (machine, axis, shift));
CREATE TABLE fleet.forecasts (machine text NOT NULL, axis text NOT NULL, made_of text NOT NULL, limits jsonb NOT NULL,
  PRIMARY KEY (machine, axis));
{FILL_SHIFTS};
CREATE OR REPLACE VIEW fleet.newest_parameter_sets AS {KNOWN_AXES}
  SELECT n.* FROM known k, LATERAL (SELECT * FROM fleet.parameter_sets s
    WHERE s.machine = k.machine AND s.axis = k.axis ORDER BY s.stored_at DESC, s.sequence DESC LIMIT 1) n;
"""
# two machines with one name, or an older copy of a history: numbers are ``repeated``, or two histories come ``in_turn``
_REPEATED: LiteralString = """
CREATE OR REPLACE VIEW fleet.machines AS
  SELECT h.machine, sum(h.records)::bigint AS records, max(h.last_stored_at) AS last_stored_at,
    least(sum(greatest(h.last_sequence - h.records, 0)), 1e18)::bigint AS missing, count(*) AS stores,
    (SELECT a.record FROM fleet.told a WHERE a.machine = h.machine AND a.axis = '' AND a.kind = 'about'
     ORDER BY a.stored_at DESC LIMIT 1) AS about,
    sum(greatest(h.records - h.last_sequence, 0))::bigint AS repeated,
    coalesce(bool_or(h.last_before > h.first_stored_at), false) AS in_turn
  FROM (SELECT *, max(last_stored_at) OVER (PARTITION BY machine ORDER BY first_stored_at, store
      ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING) AS last_before FROM fleet.heard) h
  GROUP BY h.machine;
"""
# the steps from each version to the next, in order: new ones are appended, old ones never change
_STEPS: tuple[LiteralString, ...] = (_FIRST, _VIEWS, _REANALYSES, _ROLL_OUT, _SERVICES, _SHIFTS, _REPEATED)
VERSION = len(_STEPS)


async def upgrade_schema(db: psycopg.AsyncConnection[Any]) -> None:
    """Create the schema or migrate it, in one transaction. StoreError when it is newer than this fdhil."""
    async with db.transaction():
        await db.execute("SELECT pg_advisory_xact_lock(%s)", (LOCK,))
        await db.execute("CREATE SCHEMA IF NOT EXISTS fleet")
        await db.execute("CREATE TABLE IF NOT EXISTS fleet.schema_version (version integer NOT NULL)")
        row = await (
            await db.cursor(row_factory=tuple_row).execute("SELECT version FROM fleet.schema_version")
        ).fetchone()
        version = int(row[0]) if row else 0
        if version > VERSION:
            text = f"the database has fleet schema {version}, this fdhil supports {VERSION}; install a newer fdhil"
            raise StoreError(text, "SchemaVersion")
        for step in _STEPS[version:]:
            await db.execute(step)
        if version < VERSION:
            await db.execute("DELETE FROM fleet.schema_version")
            await db.execute("INSERT INTO fleet.schema_version VALUES (%s)", (VERSION,))


async def add_month_partitions(db: psycopg.AsyncConnection, months: set[tuple[int, int]]) -> None:
    """Create the partitions of these months (year, month) where they do not exist."""
    for year, month in sorted(months):
        if not FIRST_YEAR <= year <= LAST_YEAR:
            continue
        name = sql.Identifier("fleet", f"records_{year}_{month:02d}")
        end = datetime(year + month // 12, month % 12 + 1, 1, tzinfo=UTC)
        statement = sql.SQL("CREATE TABLE IF NOT EXISTS {} PARTITION OF fleet.records FOR VALUES FROM ({}) TO ({})")
        async with db.transaction():
            await db.execute("SELECT pg_advisory_xact_lock(%s)", (LOCK,))
            # a collector running while its partition was dropped has left rows of it in ``records_other``
            with suppress(psycopg.errors.CheckViolation):
                async with db.transaction():
                    await db.execute(statement.format(name, datetime(year, month, 1, tzinfo=UTC), end))
