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
from fdhil.fleet import objects
from fdhil.fleet.collector import Received
from fdhil.fleet.message import Record
from fdhil.fleet.retention import months_before, retain
from fdhil.fleet.sets import entered
from tests.fleet.machine import Machine, written
from tests.fleet.servers import Postgres
from tests.fleet.works import fleet_of, keep, received_of, told_at, told_by

MONTHS = [datetime(2026, month, 10, tzinfo=UTC) for month in (1, 3, 6)]
NOW = datetime(2026, 7, 20, tzinfo=UTC)


def test_months_are_counted_back_over_the_turn_of_a_year() -> None:
    assert months_before(NOW, 6) == datetime(2026, 1, 1, tzinfo=UTC)
    assert months_before(NOW, 7) == datetime(2025, 12, 1, tzinfo=UTC)


@pytest.mark.debian
class TestWithADatabase:
    @pytest.fixture
    def works(self, database: Postgres, tmp_path: Path) -> Fleet:
        """Keep records for three months and windows for one."""
        kept = Retention(record_months=3, window_months=1)
        return fleet_of(database, tmp_path).model_copy(update={"retention": kept})

    @pytest.fixture
    def told(self, tmp_path: Path) -> list[Received]:
        """A machine's description, and two rounds of each of its axes in each of three months."""
        machine = Machine(written(tmp_path / "mill", "mill-1"))
        machine.record(6)
        machine.close()
        about, *records = received_of(told_by(machine))
        share = len(records) // len(MONTHS)
        groups = [records[k * share : (k + 1) * share] for k in range(len(MONTHS))]
        return [told_at(about, MONTHS[0])] + [
            told_at(each, at) for at, group in zip(MONTHS, groups, strict=True) for each in group
        ]

    async def test_a_month_goes_whole_and_nothing_is_called_missing(
        self, works: Fleet, told: list[Received], database: Postgres
    ) -> None:
        await keep(works, told)
        before = machines(database)
        (first,) = database.ask("""SELECT "ft", at, revision FROM fleet.parameter_sets WHERE axis = 'X'
            ORDER BY stored_at, sequence LIMIT 1""")
        found = apply_policy(works)
        assert found["months"] == ["records_2026_01", "records_2026_03"]
        assert partitions(database) == ["records_2026_06", "records_other"]
        assert machines(database) == before  # number of records, none missing, and the machine's description
        assert before[0][2] == 0
        assert database.ask("SELECT first_at FROM fleet.axes WHERE axis = 'X'") == [(first[1],)]
        kept = database.ask("SELECT axis, kind FROM fleet.kept ORDER BY axis, kind")
        assert kept == [("", "about"), ("X", "parameters"), ("Y", "parameters")]
        assert apply_policy(works)["months"] == []

    async def test_what_went_does_not_come_back_and_what_was_never_heard_is_counted(
        self, works: Fleet, told: list[Received], database: Postgres
    ) -> None:
        await keep(works, told[:4] + told[5:])  # the fifth waits on its machine
        assert machines(database)[0][2] == 1
        apply_policy(works)
        count = "SELECT count(*) FROM fleet.records WHERE kind <> 'about'"
        rows = database.ask(count)
        await keep(works, told[:4] + told[5:])  # the machine has lost its position
        assert database.ask(count) == rows
        assert machines(database)[0][2] == 1
        await keep(works, [told[4]._replace(stored_at=NOW)])
        assert machines(database)[0][1:3] == (len(told) - 1, 0)
        assert partitions(database)[0] == "records_2026_01"
        assert "records_2026_01" not in apply_policy(works)["months"]  # it came today: it lives as long as the rest
        assert apply_policy(works, datetime(2026, 11, 1, tzinfo=UTC))["months"][0] == "records_2026_01"
        assert machines(database)[0][1:3] == (len(told) - 1, 0)

    async def test_a_collector_that_knew_the_month_before_it_went_goes_on(
        self, works: Fleet, told: list[Received], database: Postgres
    ) -> None:
        """Its next record of that month is in records_other and does not prevent a new partition."""
        await keep(works, told[:4])
        apply_policy(works)
        database.ask("""INSERT INTO fleet.records SELECT machine, 'late', recorded_at, store, 999, axis, kind, now(),
            window_name, record FROM fleet.kept WHERE kind = 'parameters' LIMIT 1""")
        await keep(works, [told[4]._replace(stored_at=NOW)])
        assert partitions(database) == ["records_other"]
        assert database.ask("SELECT count(*) FROM fleet.records") == [(2,)]

    async def test_wrong_clocks_go_by_when_they_came(
        self, works: Fleet, told: list[Received], database: Postgres
    ) -> None:
        old, young = told[1], told[2]._replace(stored_at=NOW)
        await keep(works, [told_at(old, datetime(1970, 1, 1, tzinfo=UTC), stored=MONTHS[0]), young])
        assert apply_policy(works)["records_of_wrong_clocks"] == 1
        assert machines(database)[0][1] == 2

    async def test_windows_go_when_no_row_names_them(
        self, works: Fleet, told: list[Received], database: Postgres
    ) -> None:
        names = [f"{k:02x}" * 32 for k in range(4)]
        for name in names:
            objects.keep(works.objects.directory, name, b"window")
            os.utime(objects.path_of(works.objects.directory, name), (1.0, 1.0))
        await keep(works, told)
        last = told[-1].content
        assert isinstance(last, Record)
        for name, at in ((names[0], MONTHS[1]), (names[1], datetime(2026, 5, 10, tzinfo=UTC)), (names[2], NOW)):
            await keep(works, [told_at(told[-1]._replace(content=last._replace(message=name, window=None)), at)])
            database.ask(f"UPDATE fleet.records SET window_name = '{name}' WHERE message = '{name}'")
        objects.keep(works.objects.directory, names[3], b"window")  # on its way: its row is not there yet
        found = apply_policy(works)
        there = [name for name in names if objects.path_of(works.objects.directory, name).exists()]
        assert there == [names[2], names[3]]  # of the first the row went, of the second the name
        assert (found["windows_forgotten"], found["files_removed"], found["bytes_freed"]) == (1, 2, 12)

    def test_without_a_limit_all_is_kept(self, works: Fleet, database: Postgres) -> None:
        with entered(works) as db, pytest.raises(ConfigError, match="record_months"):
            retain(db, works.model_copy(update={"retention": Retention()}), NOW)


def apply_policy(works: Fleet, now: datetime = NOW) -> dict[str, Any]:
    with entered(works) as db:
        return json.loads(json.dumps(retain(db, works, now)))  # type: ignore[no-any-return]


def machines(database: Postgres) -> list[tuple[Any, ...]]:
    return database.ask("SELECT machine, records, missing, about->'labels'->>'type' FROM fleet.machines")


def partitions(database: Postgres) -> list[str]:
    rows = database.ask("""SELECT c.relname FROM pg_inherits i JOIN pg_class c ON c.oid = i.inhrelid
        WHERE i.inhparent = 'fleet.records'::regclass ORDER BY 1""")
    return [name for (name,) in rows]
