"""Old months are dropped whole; reference records, late records and repeated records stay correct."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from fdhil.config.fleet_config import Fleet, Retention
from fdhil.errors import ConfigError
from fdhil.fleet import window_files
from fdhil.fleet.collector import ReceivedRecord
from fdhil.fleet.parameter_sets import open_database
from fdhil.fleet.record_message import Record
from fdhil.fleet.retention import apply_retention, compute_cutoff_month
from tests.fleet.fleet_database import build_fleet, decode_messages, list_messages, set_recorded_at, store_records
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

MONTHS = [datetime(2026, month, 10, tzinfo=UTC) for month in (1, 3, 6)]
NOW = datetime(2026, 7, 20, tzinfo=UTC)


def test_cutoff_month_crosses_year_boundary() -> None:
    assert compute_cutoff_month(NOW, 6) == datetime(2026, 1, 1, tzinfo=UTC)
    assert compute_cutoff_month(NOW, 7) == datetime(2025, 12, 1, tzinfo=UTC)


@pytest.mark.debian
class TestRetentionInDatabase:
    @pytest.fixture
    def fleet_settings(self, database: Postgres, tmp_path: Path) -> Fleet:
        """Keep records for three months and windows for one."""
        kept = Retention(record_months=3, window_months=1)
        return build_fleet(database, tmp_path).model_copy(update={"retention": kept})

    @pytest.fixture
    def told(self, tmp_path: Path) -> list[ReceivedRecord]:
        """A machine's description, and two rounds of each of its axes in each of three months."""
        machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1"))
        machine.record_windows(6)
        machine.close_store()
        about, *records = decode_messages(list_messages(machine))
        share = len(records) // len(MONTHS)
        groups = [records[k * share : (k + 1) * share] for k in range(len(MONTHS))]
        return [set_recorded_at(about, MONTHS[0])] + [
            set_recorded_at(each, at) for at, group in zip(MONTHS, groups, strict=True) for each in group
        ]

    async def test_old_month_is_dropped_without_missing_records(
        self, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
    ) -> None:
        await store_records(fleet_settings, told)
        before = read_machines(database)
        (first,) = database.execute_query("""SELECT "ft", at, revision FROM fleet.parameter_sets WHERE axis = 'X'
            ORDER BY stored_at, sequence LIMIT 1""")
        found = apply_policy(fleet_settings)
        assert found["months"] == ["records_2026_01", "records_2026_03"]
        assert list_partitions(database) == ["records_2026_06", "records_other"]
        assert read_machines(database) == before  # number of records, none missing, and the machine's description
        assert before[0][2] == 0
        assert database.execute_query("SELECT first_at FROM fleet.axes WHERE axis = 'X'") == [(first[1],)]
        kept = database.execute_query("SELECT axis, kind FROM fleet.kept ORDER BY axis, kind")
        assert kept == [("", "about"), ("X", "parameters"), ("Y", "parameters")]
        assert apply_policy(fleet_settings)["months"] == []

    async def test_dropped_records_do_not_return_and_missing_ones_are_counted(
        self, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
    ) -> None:
        await store_records(fleet_settings, told[:4] + told[5:])  # the fifth waits on its machine
        assert read_machines(database)[0][2] == 1
        apply_policy(fleet_settings)
        count = "SELECT count(*) FROM fleet.records WHERE kind <> 'about'"
        rows = database.execute_query(count)
        await store_records(fleet_settings, told[:4] + told[5:])  # the machine has lost its position
        assert database.execute_query(count) == rows
        assert read_machines(database)[0][2] == 1
        await store_records(fleet_settings, [told[4]._replace(stored_at=NOW)])
        assert read_machines(database)[0][1:3] == (len(told) - 1, 0)
        assert list_partitions(database)[0] == "records_2026_01"
        assert (
            "records_2026_01" not in apply_policy(fleet_settings)["months"]
        )  # it came today: it lives as long as the rest
        assert apply_policy(fleet_settings, datetime(2026, 11, 1, tzinfo=UTC))["months"][0] == "records_2026_01"
        assert read_machines(database)[0][1:3] == (len(told) - 1, 0)

    async def test_running_collector_continues_after_month_is_dropped(
        self, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
    ) -> None:
        """Its next record of that month is in records_other and does not prevent a new partition."""
        await store_records(fleet_settings, told[:4])
        apply_policy(fleet_settings)
        database.execute_query("""INSERT INTO fleet.records SELECT machine, 'late', recorded_at, store, 999, axis, kind,
            now(), window_name, record FROM fleet.kept WHERE kind = 'parameters' LIMIT 1""")
        await store_records(fleet_settings, [told[4]._replace(stored_at=NOW)])
        assert list_partitions(database) == ["records_other"]
        assert database.execute_query("SELECT count(*) FROM fleet.records") == [(2,)]

    async def test_misdated_records_are_dropped_by_arrival(
        self, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
    ) -> None:
        old, young = told[1], told[2]._replace(stored_at=NOW)
        await store_records(
            fleet_settings, [set_recorded_at(old, datetime(1970, 1, 1, tzinfo=UTC), stored=MONTHS[0]), young]
        )
        assert apply_policy(fleet_settings)["records_of_wrong_clocks"] == 1
        assert read_machines(database)[0][1] == 2

    async def test_unreferenced_windows_are_removed(
        self, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
    ) -> None:
        names = [f"{k:02x}" * 32 for k in range(4)]
        for name in names:
            window_files.store_window(fleet_settings.objects.directory, name, b"window")
            os.utime(window_files.build_window_path(fleet_settings.objects.directory, name), (1.0, 1.0))
        await store_records(fleet_settings, told)
        last = told[-1].content
        assert isinstance(last, Record)
        for name, at in ((names[0], MONTHS[1]), (names[1], datetime(2026, 5, 10, tzinfo=UTC)), (names[2], NOW)):
            await store_records(
                fleet_settings,
                [set_recorded_at(told[-1]._replace(content=last._replace(message=name, window=None)), at)],
            )
            database.execute_query(f"UPDATE fleet.records SET window_name = '{name}' WHERE message = '{name}'")
        window_files.store_window(
            fleet_settings.objects.directory, names[3], b"window"
        )  # on its way: its row is not there yet
        found = apply_policy(fleet_settings)
        there = [
            name for name in names if window_files.build_window_path(fleet_settings.objects.directory, name).exists()
        ]
        assert there == [names[2], names[3]]  # of the first the row went, of the second the name
        assert (found["windows_forgotten"], found["files_removed"], found["bytes_freed"]) == (1, 2, 12)

    def test_everything_is_kept_without_limit(self, fleet_settings: Fleet, database: Postgres) -> None:
        with open_database(fleet_settings) as db, pytest.raises(ConfigError, match="record_months"):
            apply_retention(db, fleet_settings.model_copy(update={"retention": Retention()}), NOW)


def apply_policy(works: Fleet, now: datetime = NOW) -> dict[str, Any]:
    with open_database(works) as db:
        return json.loads(json.dumps(apply_retention(db, works, now)))  # type: ignore[no-any-return]


def read_machines(database: Postgres) -> list[tuple[Any, ...]]:
    return database.execute_query("SELECT machine, records, missing, about->'labels'->>'type' FROM fleet.machines")


def list_partitions(database: Postgres) -> list[str]:
    rows = database.execute_query("""SELECT c.relname FROM pg_inherits i JOIN pg_class c ON c.oid = i.inhrelid
        WHERE i.inhparent = 'fleet.records'::regclass ORDER BY 1""")
    return [name for (name,) in rows]
