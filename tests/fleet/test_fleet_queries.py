"""Queries about all machines: the command line with a real database."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.fleet import schema_migrations
from fdhil.fleet.record_message import Message, Record
from tests.daemon.machine_rig import fdhil
from tests.fleet.fleet_database import build_fleet, collect_messages, decode_messages, list_messages, store_records
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

pytestmark = pytest.mark.debian


@pytest.fixture
def fleet_settings(database: Postgres, tmp_path: Path) -> Path:
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "{database.connection}"\n')
    return file


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[list[RecordingMachine]]:
    """Six machines of one kind; the fourth has a worn X axis."""
    made = []
    for k in range(6):
        labels = {"type": "V-800", "screw": "A"}
        machine = RecordingMachine(write_history(tmp_path / str(k), f"mill-{k}", labels=labels))
        machine.record_windows(3, parameters={"ft": 0.05 + 0.0004 * k})
        made.append(machine)
    made[3].record_windows(3, axes=("X",), parameters={"ft": 0.09})
    yield made
    for machine in made:
        machine.close_store()


def query(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> Any:
    """Query with and without --json; return the document and the text."""
    found, text, err = fdhil("fleet", *map(str, words), capsys=capsys)
    assert (found, err) == (code, "")
    found, out, err = fdhil("fleet", *map(str, words), "--json", capsys=capsys)
    assert (found, err) == (code, "")
    document = json.loads(out)
    assert document["schema"] == f"fdhil-fleet-{words[0]}-1"
    return document, text


async def test_queries_return_fleet_state(
    machines: list[RecordingMachine],
    fleet_settings: Path,
    database: Postgres,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    messages = [message for machine in machines for message in list_messages(machine)]
    machines[0].store.store_acknowledgement({"up_to": 2, "by": "Anna"})
    messages += list_messages(machines[0])[-1:]
    await collect_messages(build_fleet(database, tmp_path), messages[:50])
    await collect_messages(build_fleet(database, tmp_path), messages[30:])  # some of them twice
    document, text = query(capsys, 0, "status", fleet_settings)
    assert [(m["machine"], m["records"], m["missing"]) for m in document["machines"]] == [
        (f"mill-{k}", {0: 22, 3: 33}.get(k, 21), 0) for k in range(6)
    ]
    assert [m["open_notices"] for m in document["machines"]] == [1, 3, 3, 6, 3, 3]
    assert {m["doubt"] for m in document["machines"]} == {None}
    first = document["machines"][0]["axes"]["Y"]
    assert (first["revision"], first["parameters"]["ft"]["value"]) == (3, 0.05)
    assert first["parameters"]["ft"]["low"] < 0.05 < first["parameters"]["ft"]["high"]
    assert "mill-3: X revision 6, Y revision 3" in text

    document, text = query(capsys, 1, "outliers", fleet_settings)
    (found,) = document["outliers"]
    assert (found["machine"], found["axis"], found["parameter"], found["sisters"]) == ("mill-3", "X", "ft", 6)
    assert "mill-3 axis X: ft = 0.09" in text
    assert query(capsys, 0, "outliers", fleet_settings, "--axis", "Y")[1] == "no axis differs from its peers\n"
    assert query(capsys, 1, "outliers", fleet_settings, "--by", "screw")[0]["outliers"][0]["label"] == "A"

    document, text = query(capsys, 0, "compare", fleet_settings, "--parameter", "ft", "--axis", "X")
    (group,) = document["groups"]
    assert [sister["machine"] for sister in group["sisters"]][-1] == "mill-3"
    assert "DIFFERS FROM ITS PEERS" in text

    words = ("trend", fleet_settings, "--machine", "mill-3", "--axis", "X", "--parameter", "ft")
    document, text = query(capsys, 0, *words)
    assert [told["value"] for told in document["sets"]] == pytest.approx([0.0512] * 3 + [0.09] * 3)
    assert document["slope_per_30_days"] is not None
    assert len(text.splitlines()) == 7
    assert "no parameters of axis Q" in query(capsys, 1, *words[:5], "Q", *words[6:])[1]


async def test_missing_records_are_counted(
    fleet_settings: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1"))
    count = machine.record_windows(2)
    machine.close_store()
    messages = list_messages(machine)
    await collect_messages(build_fleet(database, tmp_path), messages[:3] + messages[6:])
    document, text = query(capsys, 0, "status", fleet_settings)
    assert document["machines"][0]["missing"] == 3
    assert f"{count - 3} records, 3 RECORDS MISSING" in text


@pytest.mark.parametrize("same_history", [True, False])
async def test_two_machines_with_one_name_are_reported(
    same_history: bool, fleet_settings: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = RecordingMachine(write_history(tmp_path / "1", "mill-1"))
    first.record_windows(1)
    if same_history:
        first.close_store()
        shutil.copytree(tmp_path / "1", tmp_path / "2")
        first = RecordingMachine(tmp_path / "1" / "machine.toml")
        second = RecordingMachine(tmp_path / "2" / "machine.toml")
    else:
        second = RecordingMachine(write_history(tmp_path / "2", "mill-1"))
    begun = [list_messages(first), list_messages(second)]
    first.record_windows(2)
    second.record_windows(1, parameters={"ft": 0.4})
    for machine in (first, second):
        machine.close_store()
    later = [list_messages(machine)[len(before) :] for machine, before in zip((first, second), begun, strict=True)]
    messages = [begun[0], begun[1], *later]
    await collect_messages(build_fleet(database, tmp_path), [message for part in messages for message in part])
    document, text = query(capsys, 0, "status", fleet_settings)
    (reported,) = document["machines"]
    assert "two machines use this name" in reported["doubt"]
    assert reported["missing"] == 0
    assert "give each machine a unique name" in text


def test_database_without_schema_is_reported(fleet_settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = fdhil("fleet", "status", str(fleet_settings), capsys=capsys)
    assert (code, out) == (3, "")
    assert "start fdhil fleet collect first" in err


def test_unreachable_database_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "host={tmp_path} dbname=none"\n')
    code, out, err = fdhil("fleet", "outliers", str(file), capsys=capsys)
    assert (code, out) == (3, "")
    assert "check [database] connection" in err


async def test_month_gets_partition_and_wrong_clock_gets_none(database: Postgres, tmp_path: Path) -> None:
    machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1"))
    machine.record_windows(1)
    machine.close_store()
    first, second, third, *_ = list_messages(machine)
    clocks = [(first, 1_735_689_599.0), (second, 1_735_689_600.0), (third, 5.0)]  # the turn of the year 2025; 1970
    await collect_messages(build_fleet(database, tmp_path), [set_time(message, at) for message, at in clocks])
    rows = database.execute_query(
        "SELECT c.relname FROM fleet.records r JOIN pg_class c ON r.tableoid = c.oid ORDER BY recorded_at DESC"
    )
    assert [name for (name,) in rows] == ["records_2025_01", "records_2024_12", "records_other"]


def set_time(message: Message, recorded_s: float) -> Message:
    head, record, _ = message.payload.split(b"\n")
    words = head.decode().split()
    words[6] = f"{recorded_s:.6f}"
    return replace(message, payload=" ".join(words).encode() + b"\n" + record + b"\n")


async def test_newer_schema_is_refused(database: Postgres, tmp_path: Path) -> None:
    await collect_messages(build_fleet(database, tmp_path), [])
    database.execute_query("UPDATE fleet.schema_version SET version = 99")
    with pytest.raises(Exception, match="schema 99"):
        await collect_messages(build_fleet(database, tmp_path), [])
    database.execute_query(f"UPDATE fleet.schema_version SET version = {schema_migrations.VERSION}")
    await collect_messages(build_fleet(database, tmp_path), [])


@pytest.mark.parametrize("bad", [0, 5, 12])
async def test_record_rejected_by_database_is_stored_apart(bad: int, database: Postgres, tmp_path: Path) -> None:
    machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1"))
    machine.record_windows(2)
    machine.close_store()
    received = decode_messages(list_messages(machine)[:13])
    record = received[bad].content
    assert isinstance(record, Record)
    received[bad] = received[bad]._replace(content=record._replace(text='{"text": "\\u0000"}'))
    await store_records(build_fleet(database, tmp_path), received)
    assert database.execute_query("SELECT count(*) FROM fleet.records") == [(12,)]
    ((subject, reason, payload),) = database.execute_query("SELECT subject, reason, payload FROM fleet.refused")
    assert (subject, payload) == (received[bad].subject, record.payload)
    assert "u0000" in reason


async def test_views_match_documentation(database: Postgres, tmp_path: Path) -> None:
    await collect_messages(build_fleet(database, tmp_path), [])
    listed = "table_name, string_agg('`' || column_name || '`', ', ' ORDER BY ordinal_position)"
    columns = database.execute_query(f"""SELECT {listed} FROM information_schema.columns
        LEFT JOIN information_schema.views v USING (table_schema, table_name)
        WHERE table_schema = 'fleet' AND (v.table_name IS NOT NULL OR table_name = 'services') GROUP BY 1""")
    reported = [f"| `{name}` | {names} |" for name, names in columns]
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "fleet.md").read_text("utf-8")
    assert [line for line in reported if line not in page] == []
    # whatever is in it, each can be read
    for name, _ in columns:
        database.execute_query(f"SELECT * FROM fleet.{name}")
