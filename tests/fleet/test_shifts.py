"""Queries use the newest set of each shift, and forecasts stored for a day."""

from __future__ import annotations

import random
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from fdhil.config.fleet_config import Fleet
from fdhil.fleet import maintenance_forecast as forecasts
from fdhil.fleet import schema_migrations
from fdhil.fleet.collector import ReceivedRecord
from fdhil.fleet.parameter_sets import Axis, list_axes, open_read_only
from fdhil.fleet.record_message import Record
from tests.fleet.fleet_database import (
    build_fleet,
    collect_messages,
    decode_messages,
    list_messages,
    set_recorded_at,
    spread_over_days,
    store_records,
)
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

pytestmark = pytest.mark.debian
BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
COLUMNS = 'machine, axis, shift, at, stored_at, sequence, revision, "R", "ft", stds, temperature_c'
KEPT = f"SELECT {COLUMNS} FROM fleet.shifts ORDER BY machine, axis, shift"


@pytest.fixture
def fleet_settings(database: Postgres, tmp_path: Path) -> Fleet:
    return build_fleet(database, tmp_path)


def read_shifts(folder: Path, rounds: int, **parameters: float) -> list[ReceivedRecord]:
    """The records of a machine, a round every two hours."""
    machine = RecordingMachine(write_history(folder, folder.name))
    machine.record_windows(rounds, parameters=parameters)
    machine.close_store()
    about, *records = decode_messages(list_messages(machine))
    share = len(records) // rounds
    moved = [set_recorded_at(each, BEGIN + timedelta(hours=2 * (k // share))) for k, each in enumerate(records)]
    return [set_recorded_at(about, BEGIN), *moved]


@pytest.mark.parametrize("seed", range(3))
async def test_newest_set_of_each_shift_is_kept_in_any_order(
    seed: int, fleet_settings: Fleet, database: Postgres, tmp_path: Path
) -> None:
    """In any order, in any batches, with repetitions: equal to the result of a migrated history."""
    chance = random.Random(seed)
    received = [each for name in ("mill-1", "mill-2") for each in read_shifts(tmp_path / name, 9)]
    while received:
        some = chance.sample(received, min(len(received), chance.randrange(1, 40)))
        await store_records(fleet_settings, some)
        received = [each for each in received if each not in some or chance.random() < 0.2]
    found = database.execute_query(KEPT)
    assert len(found) == 2 * 2 * 3
    newest = """SELECT max(sequence) FROM fleet.parameter_sets
        GROUP BY machine, axis, date_bin('6 hours', at, 'epoch'::timestamptz)"""
    assert sorted(row[5] for row in found) == sorted(sequence for (sequence,) in database.execute_query(newest))
    database.execute_query("DROP TABLE fleet.shifts CASCADE")
    database.execute_query("DROP TABLE fleet.forecasts")
    database.execute_query(
        f"UPDATE fleet.schema_version SET version = {schema_migrations._STEPS.index(schema_migrations._SHIFTS)}"
    )
    await collect_messages(fleet_settings, [])
    assert database.execute_query(KEPT) == found
    with open_read_only(fleet_settings) as db:
        assert list_axes(db) == [(name, axis) for name in ("mill-1", "mill-2") for axis in ("X", "Y")]
        assert list_axes(db, "Y") == [("mill-1", "Y"), ("mill-2", "Y")]


async def test_invalid_set_does_not_hide_others(fleet_settings: Fleet, database: Postgres, tmp_path: Path) -> None:
    received = read_shifts(tmp_path / "mill-1", 1)
    sets = [each.content for each in received if isinstance(each.content, Record) and each.content.kind == "parameters"]
    lost = received[-1]._replace(
        content=sets[0]._replace(sequence=99, message="f" * 64, text='{"left_out": "damaged"}')
    )
    await store_records(fleet_settings, [*received, lost])
    assert {row[5] for row in database.execute_query(KEPT)} == {each.sequence for each in sets}


async def test_forecast_is_renewed_daily_and_after_service(
    fleet_settings: Fleet, database: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1"))
    for k in range(12):
        machine.record_windows(1, parameters={"ft": 0.05 * (1 + 0.06 * k)})
    machine.close_store()
    received = spread_over_days(machine, BEGIN)
    looked: list[Axis] = []
    really = forecasts._forecast_limits

    def looking(db: Any, axes: list[Axis], shares: Any) -> Any:
        looked.extend(axes)
        return really(db, axes, shares)

    monkeypatch.setattr(forecasts, really.__name__, looking)

    def asked() -> tuple[list[dict[str, Any]], list[Axis]]:
        looked.clear()
        with open_read_only(fleet_settings) as db:
            return forecasts.forecast_maintenance(db), list(looked)

    both = [("mill-1", "X"), ("mill-1", "Y")]
    await store_records(fleet_settings, received[:-7])
    first, looked_at = asked()
    assert [(each["axis"], each["parameter"]) for each in first] == [("X", "ft"), ("Y", "ft")]
    assert looked_at == both
    assert asked() == (first, [])
    database.execute_query(
        "UPDATE fleet.shifts SET \"ft\" = 0.9 WHERE axis = 'X' AND shift = (SELECT max(shift) FROM fleet.shifts)"
    )
    again, looked_at = asked()
    assert ([each["value"] for each in again if each["axis"] == "X"], looked_at) == ([0.9], [])
    await store_records(fleet_settings, received[-7:])  # another day
    assert asked()[1] == both
    database.execute_query("INSERT INTO fleet.services VALUES ('mill-1', 'X', '2026-03-05Z', '')")
    assert asked()[1] == [("mill-1", "X")]
    expected = asked()
    database.execute_query("CREATE ROLE reader; GRANT USAGE ON SCHEMA fleet TO reader")
    database.execute_query("GRANT SELECT ON ALL TABLES IN SCHEMA fleet TO reader")
    database.execute_query("DELETE FROM fleet.forecasts")
    try:
        with open_read_only(fleet_settings) as db:
            db.execute("SET ROLE reader")
            assert (forecasts.forecast_maintenance(db), []) == expected
    finally:
        database.execute_query("DROP OWNED BY reader; DROP ROLE reader")
    assert asked()[1] == both  # who may not write keeps nothing
