"""Fleets: many machines send recorded days while everything between is killed; a network is cut; what it all takes.

Real uplinks, nats-server, collectors and PostgreSQL as processes on this computer. The machines' days are recorded
before; nothing is compressed in time but the hour of the cut, where that is shorter.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg

from fdhil.config import MachineConfig
from fdhil.fleet.record_message import encode_entry
from fdhil.store.outbox import OutboxReader
from studies import fleet_day, pages
from studies.fleet_cut import Network
from studies.fleet_page import page as page
from studies.fleet_parts import (
    Process,
    count_records,
    list_killable_parts,
    measure_database_s,
    measure_processor_s,
    wait_for,
)
from tests.fleet.servers import NatsServer, Postgres, run_nats, run_postgres

GROUPS, COLLECTORS = 4, 2
MINUTES = 60  # of the work that is recorded while the network is away
ORDER = """
SELECT count(*) FROM (SELECT sequence, lag(sequence) OVER (PARTITION BY machine ORDER BY stored_at, sequence) AS before
  FROM fleet.records WHERE sequence > 0) AS told WHERE sequence < before
"""
SIZES = """
SELECT sum(pg_relation_size(inhrelid)), sum(pg_indexes_size(inhrelid)), sum(pg_total_relation_size(inhrelid))
  FROM pg_inherits
"""


@contextmanager
def run_collectors(
    folder: Path, machines: Sequence[MachineConfig], server: NatsServer, database: Postgres
) -> Iterator[Any]:
    """Run uplinks and collectors; yields them."""
    works = folder / "fleet.toml"
    works.write_text(
        f'[server]\nserver = "{server.url}"\n[database]\nconnection = "{database.connection}"\n'
        '[objects]\ndirectory = "objects"\n'
    )
    files = [config.store.directory.parent / "machine.toml" for config in machines]
    groups = min(GROUPS, len(files))
    uplinks = [Process(folder / f"uplinks-{k}.log", "studies.fleet_parts", *files[k::groups]) for k in range(groups)]
    collectors = [Process(folder / f"collector-{k}.log", "fdhil", "fleet", "collect", works) for k in range(COLLECTORS)]
    try:
        yield uplinks, collectors
    finally:
        for process in (*uplinks, *collectors):
            process.kill()


def measure_with_kills(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Send all that the machines have recorded while what is between is killed at random."""
    chance = random.Random(options.seed)
    with run_postgres() as database, run_nats(folder) as server:
        days = [fleet_day.make_machine(folder / f"day-{k}", f"day-{k}", server.url) for k in range(fleet_day.DAYS)]
        for k, day in enumerate(days):
            fleet_day.record_day(day, options.records, seed=options.seed + k)
        machines = fleet_day.copy_machines(days, folder, options.machines, server.url)
        total = options.machines * options.records
        kills: dict[str, int] = {}
        begin_s = time.monotonic()
        with run_collectors(folder, machines, server, database) as (uplinks, collectors):
            parts = list_killable_parts(uplinks, collectors, server, database)
            while count_records(database) < total:
                victims = chance.sample(sorted(parts), chance.choice((1, 1, 2)))
                for name in victims:
                    parts[name][0]()
                    kills[name] = kills.get(name, 0) + 1
                time.sleep(chance.uniform(0, 2))
                for name in victims:
                    parts[name][1]()
                _wait_for_rest(chance.uniform(2, options.rest_s), lambda: count_records(database) >= total)
                print(f"{count_records(database)} of {total} after {sum(kills.values())} kills", flush=True)
        took_s = time.monotonic() - begin_s
        found = check_records(database, machines, days) | measure_record_sizes(days[0], database, total)
    return found | {"machines": options.machines, "records": total, "kills": kills, "took_s": took_s}


def _wait_for_rest(pause_s: float, over: Any) -> None:
    end_s = time.monotonic() + pause_s
    while time.monotonic() < end_s and not over():
        time.sleep(0.5)


def check_records(
    database: Postgres, machines: Sequence[MachineConfig], days: Sequence[MachineConfig]
) -> dict[str, int]:
    """Compare each record in the database with those that the machines should have sent."""
    with psycopg.connect(database.connection, autocommit=True) as db:
        db.execute("CREATE TEMP TABLE told (day int, sequence bigint, message text)")
        db.execute("CREATE TEMP TABLE recorded (machine text, day int)")
        with db.cursor() as cursor, cursor.copy("COPY told FROM STDIN") as rows:
            for k, day in enumerate(days):
                for number, message in fleet_day.list_expected_records(day):
                    rows.write_row((k, number, message))
        names = [(config.machine.name, k % len(days)) for k, config in enumerate(machines)]
        db.cursor().executemany("INSERT INTO recorded VALUES (%s, %s)", names)
        expected = "SELECT machine, sequence, message FROM recorded JOIN told USING (day)"
        have = "SELECT machine, sequence, message FROM fleet.records WHERE sequence > 0"

        def count(query: str) -> int:
            row = db.execute(query.encode()).fetchone()
            return 0 if row is None else int(row[0])

        return {
            "lost": count(f"SELECT count(*) FROM ({expected} EXCEPT {have}) AS missing"),
            "doubled": count(f"SELECT count(*) FROM ({have} EXCEPT ALL {expected}) AS more"),
            "out_of_order": count(ORDER),
            "refused": count("SELECT count(*) FROM fleet.refused"),
            "miscounted": count("SELECT count(*) FROM fleet.machines WHERE missing <> 0"),
        }


def measure_record_sizes(day: MachineConfig, database: Postgres, total: int) -> dict[str, Any]:
    """Return what a record takes at each place."""
    with OutboxReader(day.store.directory) as reader:
        entries = reader.read_entries(0, 100_000)
        ((outbox,),) = reader._query("SELECT sum(pgsize) FROM dbstat WHERE name = 'outbox'", ())
        ((history,),) = reader._query("SELECT sum(pgsize) FROM dbstat WHERE name <> 'outbox'", ())
        wire: dict[str, list[int]] = {}
        for entry in entries:
            wire.setdefault(entry.kind, []).append(len(encode_entry(entry, "mill-000", reader.store, None).payload))
    table, index, whole = database.execute_query(SIZES)[0]
    return {
        "wire": {kind: {"records": len(each), "bytes": sum(each) / len(each)} for kind, each in wire.items()},
        "a_record": {
            "outbox": outbox / len(entries), "history": history / len(entries),
            "wire": sum(map(sum, wire.values())) / len(entries),
            "table": float(table) / total, "indexes": float(index) / total, "database": float(whole) / total,
        },
    }  # fmt: skip


def measure_undisturbed(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Send recorded days with nothing killed; return rates, and the processor's time of each part for a record."""
    with run_postgres() as database, run_nats(folder) as server:
        day = fleet_day.make_machine(folder / "day", "day", server.url)
        fleet_day.record_day(day, options.calm_records)
        machines = fleet_day.copy_machines([day], folder, options.calm_machines, server.url)
        total = options.calm_machines * options.calm_records
        with run_collectors(folder, machines, server, database) as (uplinks, collectors):
            wait_for(lambda: count_records(database) > 0, "some of it is there")
            begun = count_records(database)
            took_s = wait_for(lambda: count_records(database) >= total, "all are there")
            spent = {
                "uplinks": sum(each.processor_s for each in uplinks),
                "collectors": sum(each.processor_s for each in collectors),
                "nats-server": measure_processor_s(server._process.pid) if server._process else 0.0,
                "PostgreSQL": measure_database_s(database),
            }
    return {
        "machines": options.calm_machines, "records": total, "records_a_s": (total - begun) / took_s,
        "processor_us": {name: 1e6 * each_s / total for name, each_s in spent.items()},
    }  # fmt: skip


def measure_network_cut(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Cut the network while each machine records an hour of work; return how long it takes to catch up."""
    with run_postgres() as database, run_nats(folder) as server:
        network = Network(server.port)
        away = f"nats://127.0.0.1:{network.port}"
        machines = [
            fleet_day.make_machine(folder / f"mill-{k}", f"mill-{k}", away) for k in range(options.cut_machines)
        ]
        minute = 3 * 3 * fleet_day.A_DAY // (24 * MINUTES)  # records: three axes, of each rapid three
        for config in machines:
            fleet_day.record_day(config, 100)
        with run_collectors(folder, machines, server, database):
            before = 100 * len(machines)
            wait_for(lambda: count_records(database) == before, "the first are there")
            network.cut = True
            begin_s = time.monotonic()
            for k in range(MINUTES):
                for config in machines:
                    fleet_day.record_day(config, minute, first=100 + minute * k)
                time.sleep(max(0.0, begin_s + options.cut_s * (k + 1) / MINUTES - time.monotonic()))
            through = count_records(database) - before
            network.cut = False
            total = before + minute * MINUTES * len(machines)
            first_s = wait_for(lambda: count_records(database) > before, "the first come again")
            all_s = first_s + wait_for(lambda: count_records(database) >= total, "all are there")
        network.close()
        left_out = database.execute_query("SELECT sum(missing), sum(records) FROM fleet.machines")[0]
        order = database.execute_query(ORDER)[0][0]
    return {
        "machines": len(machines), "cut_s": options.cut_s, "records": total - before, "through": through,
        "first_s": first_s, "all_s": all_s, "lost": int(left_out[0]) + total - int(left_out[1]), "out_of_order": order,
    }  # fmt: skip


PARTS = {"calm": measure_undisturbed, "cut": measure_network_cut, "killed": measure_with_kills}


def measure_parts(options: argparse.Namespace) -> Mapping[str, Any]:
    """Measure the requested parts; the others stay as they are in the file."""
    path = options.out / "fleet.json"
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))["figures"] if path.exists() else {}
    for name in options.parts:
        with tempfile.TemporaryDirectory(prefix=f"fleet-{name}-") as folder:
            run = pages.describe_provenance("")
            found[name] = PARTS[name](options, Path(folder)) | {"date": run["date"], "commit": run["commit"]}
        print(f"{name}: {found[name]}", flush=True)
    return found


def main() -> None:
    """Measure and write the page; exit code 1 when a record was lost, doubled or overtaken."""
    parser = argparse.ArgumentParser(prog="python -m studies.fleet", description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="measure these")
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--records", type=int, default=5000, help="of each machine")
    parser.add_argument("--rest-s", type=float, default=25.0, help="longest time from one kill to the next")
    parser.add_argument("--calm-machines", type=int, default=20)
    parser.add_argument("--calm-records", type=int, default=3000)
    parser.add_argument("--cut-machines", type=int, default=20)
    parser.add_argument("--cut-s", type=float, default=240.0, help="how long the network is away")
    parser.add_argument("--seed", type=int, default=1)
    found = pages.run_study("fleet", parser, lambda options: str(options.seed), measure_parts)
    wrong = [found["killed"][name] for name in ("lost", "doubled", "out_of_order", "refused", "miscounted")]
    sys.exit(any(wrong) or bool(found["cut"]["lost"] or found["cut"]["out_of_order"]))


if __name__ == "__main__":
    main()
