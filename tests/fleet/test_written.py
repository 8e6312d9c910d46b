"""Known records are left out for any number of collectors; new ones are stored unchanged."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from fdhil.config.fleet_config import Fleet
from fdhil.fleet.collector import Received
from fdhil.fleet.message import Record
from tests.fleet.machine import Machine, written
from tests.fleet.servers import Postgres
from tests.fleet.works import fleet_of, keep, received_of, told_by

pytestmark = pytest.mark.debian
ROWS = "SELECT machine, sequence, message, stored_at FROM fleet.records ORDER BY machine, sequence, message"
HEARD = "SELECT machine, records, last_sequence, first_stored_at, last_stored_at FROM fleet.heard ORDER BY machine"


@pytest.fixture
def works(database: Postgres, tmp_path: Path) -> Fleet:
    return fleet_of(database, tmp_path)


@pytest.fixture
def told(tmp_path: Path) -> list[Received]:
    """The alternating records of two machines."""
    each = []
    for name in ("mill-1", "mill-2"):
        machine = Machine(written(tmp_path / name, name))
        machine.record(4)
        machine.close()
        each.append(received_of(told_by(machine)))
    return [received for pair in zip(*each, strict=True) for received in pair]


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
async def test_of_what_is_partly_known_the_rest_is_added(
    share: float, works: Fleet, told: list[Received], database: Postgres
) -> None:
    await keep(works, told)
    expected = database.ask(ROWS), database.ask(HEARD)
    assert [row[1] for row in expected[1]] == [len(told) // 2 - 1] * 2  # what a machine says of itself has no number
    database.ask("TRUNCATE fleet.records, fleet.heard")
    await keep(works, told[: int(share * len(told))])
    await keep(works, told)
    assert (database.ask(ROWS), database.ask(HEARD)) == expected


async def test_many_collectors_with_the_same_records_keep_each_once(
    works: Fleet, told: list[Received], database: Postgres
) -> None:
    """Also when they come in different order, and the collectors wait for each other."""
    await keep(works, told[:1])
    await asyncio.gather(*(keep(works, told[::step]) for step in (1, -1, 1, -1)))
    assert len(database.ask(ROWS)) == len(told)
    assert [row[1] for row in database.ask(HEARD)] == [len(told) // 2 - 1] * 2


@pytest.mark.parametrize(
    "text", ['{"a": "\\\\N \\n \\u00e9"}', '{\t"a":\r"\\\\.", "b": "é\\t"}', '{"\\\\x41": "\\"\\\\"}']
)
async def test_a_text_is_in_the_database_as_it_came(
    text: str, works: Fleet, told: list[Received], database: Postgres
) -> None:
    record = told[1].content
    assert isinstance(record, Record)
    for _ in range(2):  # new, and known
        await keep(works, [told[0], told[1]._replace(content=record._replace(text=text))])
    ((found,),) = database.ask(f"SELECT record FROM fleet.records WHERE message = '{record.message}'")
    assert found == json.loads(text)
