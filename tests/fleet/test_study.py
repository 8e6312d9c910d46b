"""The fleet study detects lost, duplicated and reordered records."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Mapping
from pathlib import Path

import pytest

from studies import fleet, fleet_day
from tests.fleet.fleet_database import build_fleet, collect_messages, list_messages_of_store
from tests.fleet.servers import Postgres

QUICK = argparse.Namespace(machines=6, records=120, rest_s=4.0, seed=3)
ONE = "machine = 'mill-001' AND sequence = 20"
WRONG: Mapping[str, tuple[str, dict[str, int]]] = {
    "nothing": ("SELECT 1", {}),
    "lost": (f"DELETE FROM fleet.records WHERE {ONE}", {"lost": 1}),
    "doubled": (
        "INSERT INTO fleet.records SELECT machine, message, recorded_at + interval '1 s', store, sequence, axis, kind, "
        f"stored_at, window_name, record FROM fleet.records WHERE {ONE}",
        {"doubled": 1},
    ),
    "overtaken": (
        f"UPDATE fleet.records SET stored_at = stored_at - interval '1500 ms' WHERE {ONE}",
        {"out_of_order": 1},
    ),
    "another's": (
        f"UPDATE fleet.records SET message = 'x' WHERE {ONE}",
        {"lost": 1, "doubled": 1},
    ),
    "refused": ("INSERT INTO fleet.refused VALUES (now(), 's', 'r', '')", {"refused": 1}),
    "not counted": ("UPDATE fleet.heard SET records = records - 1 WHERE machine = 'mill-000'", {"miscounted": 1}),
}


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("what", WRONG)
def test_study_detects_lost_and_duplicated_records(what: str, database: Postgres, tmp_path: Path) -> None:
    days = [fleet_day.make_machine(tmp_path / f"day-{k}", f"day-{k}", "nats://127.0.0.1:4222") for k in range(2)]
    for k, day in enumerate(days):
        fleet_day.record_day(day, 30, seed=k)
    machines = fleet_day.copy_machines(days, tmp_path, 3, "nats://127.0.0.1:4222")
    for config in machines:
        asyncio.run(collect_messages(build_fleet(database, tmp_path), list_messages_of_store(config)))
    change, expected = WRONG[what]
    database.execute_query(change)
    found = fleet.check_records(database, machines, days)
    assert {name: count for name, count in found.items() if count} == expected


@pytest.mark.debian
def test_killed_small_fleet_loses_no_record(tmp_path: Path) -> None:
    found = fleet.measure_with_kills(QUICK, tmp_path)
    assert sum(found["kills"].values()) >= 1
    wrong = {name: found[name] for name in ("lost", "doubled", "out_of_order", "refused", "miscounted")}
    assert not any(wrong.values()), wrong
