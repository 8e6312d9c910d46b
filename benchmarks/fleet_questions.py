"""What is asked of a large fleet: how long the database of many machines takes to answer.

Records are made by the database itself (``generate_series``): of each axis a few parameter sets a day for some weeks,
one of a hundred axes wearing, and of each machine a notice a day, half of them acknowledged. A real PostgreSQL
(Debian's) as it comes, on this computer.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections.abc import Callable

import psycopg

from fdhil.config.fleet_config import Database, Fleet
from fdhil.fleet import fleet_queries, parameter_sets, schema_migrations
from fdhil.fleet.parameter_sets import Db
from tests.fleet.servers import Postgres, run_postgres

FIRST = "timestamptz '2027-01-04Z'"
COLUMNS = "machine, message, recorded_at, store, sequence, axis, kind, stored_at, window_name, record"
NAME = "'mill-' || lpad(m::text, 5, '0')"
DIGEST = "md5(random()::text) || md5(random()::text)"
ABOUT = """jsonb_build_object('name', 'mill', 'labels', jsonb_build_object('type', 'type ' || m %% 30),
  'axis_labels', '{}'::jsonb, 'maintenance', '{"ft": 0.5, "Cd": 0.5}'::jsonb)"""
COVARIANCE = [[1e-6 if i == k else 1e-8 for i in range(6)] for k in range(6)]
CHANCE = "(1 + 0.01 * (random() + random() + random() - 1.5))"
SET = f"""jsonb_build_object('axis', a, 'revision', k, 'R', 0.5 * {CHANCE}, 'L', 0.005 * {CHANCE}, 'K', 0.8 * {CHANCE},
  'Jt', 0.075 * {CHANCE}, 'ft', 0.05 * {CHANCE} * (1 + CASE WHEN m %% 100 = 7 THEN 0.008 * k / %(a_day)s ELSE 0 END),
  'Cd', 5.0 * {CHANCE}, 'covariance', %(covariance)s::jsonb, 'windows', 3, 'window_ids', jsonb_build_array(k),
  'config_digest', '0123456789abcdef', 'tick', 12345, 'temperature_c', 21 + 3 * random(), 'terms', '{{}}'::jsonb,
  'unexplained_um', NULL, 'warnings', '[]'::jsonb, 'number', k)"""
NOTICE = """jsonb_build_object('axis', 'X', 'code', 'Drift', 'severity', 'minor', 'text', 'Friction rises; lubricate.',
  'tick', 0, 'number', k)"""
ACKNOWLEDGEMENT = "jsonb_build_object('notices', jsonb_build_array(k), 'who', 'Anna', 'note', '')"
OF = "FROM generate_series(1, %(machines)s) m"
EACH_SET = f"{OF}, unnest(ARRAY['X', 'Y', 'Z']) a, generate_series(1, %(days)s * %(a_day)s) k"
SET_AT = f"{FIRST} + k * interval '1 day' / %(a_day)s"
EACH_DAY, DAY_AT = f"{OF}, generate_series(1, %(days)s) k", f"{FIRST} + k * interval '1 day'"


def of_kind(kind: str, axis: str, number: str, at: str, record: str, each: str) -> str:
    """Return the SQL that makes all records of a kind."""
    return f"""INSERT INTO fleet.records ({COLUMNS}) SELECT {NAME}, {DIGEST}, {at}, md5({NAME}), {number}, {axis},
      '{kind}', {at} + interval '2 s', NULL, {record} {each}"""


SETS = "%(days)s * %(a_day)s"
KINDS = (
    of_kind("about", "''", "0", FIRST, ABOUT, OF),
    of_kind("parameters", "a", f"k + (ascii(a) - 88) * {SETS}", SET_AT, SET, EACH_SET),
    of_kind("notice", "'X'", f"3 * {SETS} + k", DAY_AT, NOTICE, EACH_DAY),
    of_kind("acknowledgement", "''", f"3 * {SETS} + %(days)s + k / 2", DAY_AT, ACKNOWLEDGEMENT,
            f"{EACH_DAY} WHERE k %% 2 = 0"),
)  # fmt: skip
HEARD = """INSERT INTO fleet.heard SELECT machine, store, count(*) FILTER (WHERE sequence > 0), max(sequence),
  min(stored_at), max(stored_at) FROM fleet.records GROUP BY machine, store"""
ASKED: dict[str, Callable[[Db], object]] = {
    "status": fleet_queries.read_fleet_status,
    "outliers --by type": lambda db: fleet_queries.find_outliers(db, "type", None),
    "compare --parameter ft": lambda db: fleet_queries.compare_parameter(db, "ft", "type", None),
    "trend of one axis": lambda db: fleet_queries.compute_trend(db, "mill-00007", "X", "ft"),
    "services": fleet_queries.QUERIES["services"],
}


def main() -> None:
    """Make the records, ask, and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--machines", type=int, default=3000)
    parser.add_argument("--days", type=int, default=28)
    parser.add_argument("--a-day", type=int, default=4, help="parameter sets of an axis")
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    with run_postgres() as database:
        made_s, rows, size = make(database, vars(options))
        print(f"{options.machines} machines with 3 axes, {options.days} days, {options.a_day} sets of an axis a day: "
              f"{rows} records, {size / 1e9:.1f} GB, made in {made_s:.0f} s")  # fmt: skip
        fleet = Fleet(database=Database(connection=database.connection))
        for name, ask in ASKED.items():
            took_s = [asked_s(fleet, ask) for _ in range(options.rounds)]
            print(f"{took_s[0]:8.2f} s, again {took_s[-1]:.2f} s: {name}", flush=True)


def make(database: Postgres, given: dict[str, int]) -> tuple[float, int, int]:
    """Fill the database; return how long it took, how many records it has, and its bytes."""
    begin_s = time.perf_counter()
    asyncio.run(prepare(database, given["days"]))
    with psycopg.connect(database.connection, autocommit=True) as db:
        db.execute("SELECT setseed(0.5)")
        for kind in KINDS:
            db.execute(kind.encode(), {**given, "covariance": str(COVARIANCE)})
        db.execute(HEARD)
        db.execute(schema_migrations.FILL_SHIFTS)
        db.execute("VACUUM ANALYZE")
        row = db.execute("SELECT count(*), pg_database_size(current_database()) FROM fleet.records").fetchone()
    assert row is not None
    return time.perf_counter() - begin_s, int(row[0]), int(row[1])


async def prepare(database: Postgres, days: int) -> None:
    """Make tables and months."""
    async with await psycopg.AsyncConnection.connect(database.connection, autocommit=True) as db:
        await schema_migrations.upgrade_schema(db)
        await schema_migrations.add_month_partitions(db, {(2027 + k // 12, k % 12 + 1) for k in range(days // 28 + 2)})


def asked_s(fleet: Fleet, ask: Callable[[Db], object]) -> float:
    """Return how long an answer takes, the connection included."""
    begin_s = time.perf_counter()
    with parameter_sets.open_read_only(fleet) as db:
        ask(db)
    return time.perf_counter() - begin_s


if __name__ == "__main__":
    main()
