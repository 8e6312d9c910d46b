"""Known records are left out for any number of collectors; new ones are stored unchanged."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from fdhil.config.fleet_config import Fleet
from fdhil.fleet.collector import ReceivedRecord
from fdhil.fleet.record_message import Record
from tests.fleet.fleet_database import build_fleet, decode_messages, list_messages, store_records
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

pytestmark = pytest.mark.debian
ROWS = "SELECT machine, sequence, message, stored_at FROM fleet.records ORDER BY machine, sequence, message"
HEARD = "SELECT machine, records, last_sequence, first_stored_at, last_stored_at FROM fleet.heard ORDER BY machine"


@pytest.fixture
def fleet_settings(database: Postgres, tmp_path: Path) -> Fleet:
    return build_fleet(database, tmp_path)


@pytest.fixture
def told(tmp_path: Path) -> list[ReceivedRecord]:
    """The alternating records of two machines."""
    each = []
    for name in ("mill-1", "mill-2"):
        machine = RecordingMachine(write_history(tmp_path / name, name))
        machine.record_windows(4)
        machine.close_store()
        each.append(decode_messages(list_messages(machine)))
    return [received for pair in zip(*each, strict=True) for received in pair]


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
async def test_new_records_of_partly_known_batch_are_added(
    share: float, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
) -> None:
    await store_records(fleet_settings, told)
    expected = database.execute_query(ROWS), database.execute_query(HEARD)
    assert [row[1] for row in expected[1]] == [len(told) // 2 - 1] * 2  # what a machine says of itself has no number
    database.execute_query("TRUNCATE fleet.records, fleet.heard")
    await store_records(fleet_settings, told[: int(share * len(told))])
    await store_records(fleet_settings, told)
    assert (database.execute_query(ROWS), database.execute_query(HEARD)) == expected


async def test_concurrent_collectors_store_each_record_once(
    fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
) -> None:
    """Also when they come in different order, and the collectors wait for each other."""
    await store_records(fleet_settings, told[:1])
    await asyncio.gather(*(store_records(fleet_settings, told[::step]) for step in (1, -1, 1, -1)))
    assert len(database.execute_query(ROWS)) == len(told)
    assert [row[1] for row in database.execute_query(HEARD)] == [len(told) // 2 - 1] * 2


@pytest.mark.parametrize(
    "text", ['{"a": "\\\\N \\n \\u00e9"}', '{\t"a":\r"\\\\.", "b": "é\\t"}', '{"\\\\x41": "\\"\\\\"}']
)
async def test_record_text_is_stored_unchanged(
    text: str, fleet_settings: Fleet, told: list[ReceivedRecord], database: Postgres
) -> None:
    record = told[1].content
    assert isinstance(record, Record)
    for _ in range(2):  # new, and known
        await store_records(fleet_settings, [told[0], told[1]._replace(content=record._replace(text=text))])
    ((found,),) = database.execute_query(f"SELECT record FROM fleet.records WHERE message = '{record.message}'")
    assert found == json.loads(text)
