"""All stored windows of a fleet again: in one process, and by 1 and 2 workers of a Dask cluster on this computer.

Real PostgreSQL (Debian's) and real workers. ``--windows 2000`` is that many rapids, each another; the results of all
runs are compared to the last bit.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psycopg
from psycopg.types.json import Jsonb

from fdhil.config import Identification
from fdhil.config.fleet_config import Database, Fleet, Objects
from fdhil.fleet import reanalysis, schema_migrations, window_files
from fdhil.fleet.parameter_sets import open_database, open_read_only
from fdhil.fleet.reanalysis_changes import summarise_changes
from fdhil.fleet.window_reanalysis import AnalysisMethod, compute_code_digest
from fdhil.fleet.worker_pools import open_worker_pool
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.store.history_database import format_parameters
from fdhil.store.recording_csv import parse_recording
from fdhil.store.window_file import encode_window
from studies import bench
from tests.fleet.servers import Postgres, run_postgres

BEGIN = datetime(2027, 1, 1, tzinfo=UTC)
NOISE = 0.003
CREWS = (0, 1, 2, 2, 1, 0)  # workers; each twice, so that a load that comes or goes meets all alike


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--windows", type=int, default=1000)
    parser.add_argument("--method", default="maximum_likelihood")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place, run_postgres() as database:
        measure(Path(place), options.windows, options.method, database)


def measure(folder: Path, windows: int, method: str, database: Postgres) -> None:
    """Print what each number of workers takes."""
    fleet = Fleet(database=Database(connection=database.connection), objects=Objects(directory=folder))
    stored_bytes = asyncio.run(gather_windows(fleet, windows))
    print(f"{windows} windows of {stored_bytes / windows / 1024:.1f} KiB, method {method}")
    asked = AnalysisMethod(Identification(method=method), {}, folder, compute_code_digest())
    rates: dict[int, list[float]] = {}
    digests = set()
    for count in CREWS:
        with open_database(fleet) as db:
            db.execute("TRUNCATE fleet.reanalyses CASCADE")
        begin_s = time.perf_counter()
        with open_worker_pool(None, count) as pool:
            up_s = time.perf_counter() - begin_s
            revision = reanalysis.reanalyse_windows(fleet, asked, reanalysis.WindowScope(), pool)
            took_s = time.perf_counter() - begin_s - up_s
        with open_read_only(fleet) as db:
            begin_s = time.perf_counter()
            reported = summarise_changes(db, revision, "type")
            asked_s = time.perf_counter() - begin_s
        assert reported["windows"] == windows
        digests.add(reported["digest"])
        rates.setdefault(count, []).append(windows / took_s)
        print(f"{count} workers: up in {up_s:.1f} s, {took_s:.1f} s, the report {asked_s:.2f} s", flush=True)
    assert len(digests) == 1
    alone, one, two = (sum(rates[count]) / len(rates[count]) for count in (0, 1, 2))
    print(f"in one process {alone:.0f} windows/s, by 1 worker {one:.0f}, by 2 workers {two:.0f}: {two / one:.2f} times")
    print(f"the same bits in all {len(CREWS)} runs")


async def gather_windows(fleet: Fleet, windows: int) -> int:
    """Bring windows into folder and database as collectors do, analysed by the fast method; return their bytes."""
    size = 0
    async with await psycopg.AsyncConnection.connect(fleet.database.connection, autocommit=True) as db:
        await schema_migrations.upgrade_schema(db)
        await schema_migrations.add_month_partitions(db, {(BEGIN.year, BEGIN.month)})
        for k, signals in enumerate(record_rapids(windows)):
            (window,) = find_windows(parse_recording(bench.format_as_csv(signals, NOISE, k)))
            content = encode_window(window, "benchmark")
            name = hashlib.sha256(content).hexdigest()
            window_files.store_window(fleet.objects.directory, name, content)
            size += len(content)
            found = analyse_window(window, Identification(method="least_squares"))
            record = {
                "number": k,
                "accepted": int(found.verdict.accepted),
                "parameters": format_parameters(found),
                "reasons": [],
            }
            at = BEGIN + timedelta(seconds=k)
            row = (f"mill-{k % 10}", name, at, "0" * 32, k, "X", "window", at, name, Jsonb(record))
            await db.execute(f"INSERT INTO fleet.records VALUES ({', '.join(['%s'] * len(row))})", row)
            received = "INSERT INTO fleet.heard VALUES (%s, 'of', 1, 1, %s, %s) ON CONFLICT DO NOTHING"
            await db.execute(received, (row[0], at, at))
    return size


def record_rapids(count: int) -> Sequence[bench.Signals]:
    """Return the signals of so many rapids, in either direction in turn; their noise makes each another."""
    ways = [bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(moves=1, first=first)) for first in (1, -1)]
    return [ways[k % 2] for k in range(count)]


if __name__ == "__main__":
    main()
