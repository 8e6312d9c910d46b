"""Queries use the newest set of each shift, and forecasts stored for a day."""

from __future__ import annotations

import random
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from fdhil.config.fleet_config import Fleet
from fdhil.fleet import due as forecasts
from fdhil.fleet import migrations
from fdhil.fleet.collector import Received
from fdhil.fleet.message import Record
from fdhil.fleet.sets import Axis, asking, axes_of
from tests.fleet.machine import Machine, written
from tests.fleet.servers import Postgres
from tests.fleet.works import at_days, fleet_of, gather, keep, received_of, told_at, told_by

pytestmark = pytest.mark.debian
BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
COLUMNS = 'machine, axis, shift, at, stored_at, sequence, revision, "R", "ft", stds, temperature_c'
KEPT = f"SELECT {COLUMNS} FROM fleet.shifts ORDER BY machine, axis, shift"


@pytest.fixture
def works(database: Postgres, tmp_path: Path) -> Fleet:
    return fleet_of(database, tmp_path)


def told(folder: Path, rounds: int, **parameters: float) -> list[Received]:
    """The records of a machine, a round every two hours."""
    machine = Machine(written(folder, folder.name))
    machine.record(rounds, parameters=parameters)
    machine.close()
    about, *records = received_of(told_by(machine))
    share = len(records) // rounds
    moved = [told_at(each, BEGIN + timedelta(hours=2 * (k // share))) for k, each in enumerate(records)]
    return [told_at(about, BEGIN), *moved]


@pytest.mark.parametrize("seed", range(3))
async def test_of_each_shift_the_newest_set_is_kept_however_it_comes(
    seed: int, works: Fleet, database: Postgres, tmp_path: Path
) -> None:
    """In any order, in any batches, with repetitions: equal to the result of a migrated history."""
    chance = random.Random(seed)
    received = [each for name in ("mill-1", "mill-2") for each in told(tmp_path / name, 9)]
    while received:
        some = chance.sample(received, min(len(received), chance.randrange(1, 40)))
        await keep(works, some)
        received = [each for each in received if each not in some or chance.random() < 0.2]
    found = database.ask(KEPT)
    assert len(found) == 2 * 2 * 3
    newest = """SELECT max(sequence) FROM fleet.parameter_sets
        GROUP BY machine, axis, date_bin('6 hours', at, 'epoch'::timestamptz)"""
    assert sorted(row[5] for row in found) == sorted(sequence for (sequence,) in database.ask(newest))
    database.ask("DROP TABLE fleet.shifts CASCADE")
    database.ask("DROP TABLE fleet.forecasts")
    database.ask(f"UPDATE fleet.schema_version SET version = {migrations._STEPS.index(migrations._SHIFTS)}")
    await gather(works, [])
    assert database.ask(KEPT) == found
    with asking(works) as db:
        assert axes_of(db) == [(name, axis) for name in ("mill-1", "mill-2") for axis in ("X", "Y")]
        assert axes_of(db, "Y") == [("mill-1", "Y"), ("mill-2", "Y")]


async def test_a_set_that_is_none_hides_no_other(works: Fleet, database: Postgres, tmp_path: Path) -> None:
    received = told(tmp_path / "mill-1", 1)
    sets = [each.content for each in received if isinstance(each.content, Record) and each.content.kind == "parameters"]
    lost = received[-1]._replace(
        content=sets[0]._replace(sequence=99, message="f" * 64, text='{"left_out": "damaged"}')
    )
    await keep(works, [*received, lost])
    assert {row[5] for row in database.ask(KEPT)} == {each.sequence for each in sets}


async def test_a_forecast_is_made_once_a_day_and_when_a_service_is_new(
    works: Fleet, database: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(written(tmp_path / "mill", "mill-1"))
    for k in range(12):
        machine.record(1, parameters={"ft": 0.05 * (1 + 0.06 * k)})
    machine.close()
    received = at_days(machine, BEGIN)
    looked: list[Axis] = []
    really = forecasts._forecasts

    def looking(db: Any, axes: list[Axis], shares: Any) -> Any:
        looked.extend(axes)
        return really(db, axes, shares)

    monkeypatch.setattr(forecasts, really.__name__, looking)

    def asked() -> tuple[list[dict[str, Any]], list[Axis]]:
        looked.clear()
        with asking(works) as db:
            return forecasts.due(db), list(looked)

    both = [("mill-1", "X"), ("mill-1", "Y")]
    await keep(works, received[:-7])
    first, looked_at = asked()
    assert [(each["axis"], each["parameter"]) for each in first] == [("X", "ft"), ("Y", "ft")]
    assert looked_at == both
    assert asked() == (first, [])
    database.ask(
        "UPDATE fleet.shifts SET \"ft\" = 0.9 WHERE axis = 'X' AND shift = (SELECT max(shift) FROM fleet.shifts)"
    )
    again, looked_at = asked()
    assert ([each["value"] for each in again if each["axis"] == "X"], looked_at) == ([0.9], [])
    await keep(works, received[-7:])  # another day
    assert asked()[1] == both
    database.ask("INSERT INTO fleet.services VALUES ('mill-1', 'X', '2026-03-05Z', '')")
    assert asked()[1] == [("mill-1", "X")]
    expected = asked()
    database.ask("CREATE ROLE reader; GRANT USAGE ON SCHEMA fleet TO reader")
    database.ask("GRANT SELECT ON ALL TABLES IN SCHEMA fleet TO reader")
    database.ask("DELETE FROM fleet.forecasts")
    try:
        with asking(works) as db:
            db.execute("SET ROLE reader")
            assert (forecasts.due(db), []) == expected
    finally:
        database.ask("DROP OWNED BY reader; DROP ROLE reader")
    assert asked()[1] == both  # who may not write keeps nothing
