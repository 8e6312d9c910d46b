"""Queries about all machines: the command line with a real database."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.fleet import migrations
from fdhil.fleet.message import Message, Record
from tests.daemon.machine_rig import fdhil
from tests.fleet.machine import Machine, written
from tests.fleet.servers import Postgres
from tests.fleet.works import fleet_of, gather, keep, received_of, told_by

pytestmark = pytest.mark.debian


@pytest.fixture
def works(database: Postgres, tmp_path: Path) -> Path:
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "{database.connection}"\n')
    return file


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[list[Machine]]:
    """Six machines of one kind; the fourth has a worn X axis."""
    made = []
    for k in range(6):
        labels = {"type": "V-800", "screw": "A"}
        machine = Machine(written(tmp_path / str(k), f"mill-{k}", labels=labels))
        machine.record(3, parameters={"ft": 0.05 + 0.0004 * k})
        made.append(machine)
    made[3].record(3, axes=("X",), parameters={"ft": 0.09})
    yield made
    for machine in made:
        machine.close()


def asked(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> Any:
    """Query with and without --json; return the document and the text."""
    found, text, err = fdhil("fleet", *map(str, words), capsys=capsys)
    assert (found, err) == (code, "")
    found, out, err = fdhil("fleet", *map(str, words), "--json", capsys=capsys)
    assert (found, err) == (code, "")
    document = json.loads(out)
    assert document["schema"] == f"fdhil-fleet-{words[0]}-1"
    return document, text


async def test_the_questions(
    machines: list[Machine], works: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = [message for machine in machines for message in told_by(machine)]
    machines[0].store.store_acknowledgement({"up_to": 2, "by": "Anna"})
    messages += told_by(machines[0])[-1:]
    await gather(fleet_of(database, tmp_path), messages[:50])
    await gather(fleet_of(database, tmp_path), messages[30:])  # some of them twice
    document, text = asked(capsys, 0, "status", works)
    assert [(m["machine"], m["records"], m["missing"]) for m in document["machines"]] == [
        (f"mill-{k}", {0: 22, 3: 33}.get(k, 21), 0) for k in range(6)
    ]
    assert [m["open_notices"] for m in document["machines"]] == [1, 3, 3, 6, 3, 3]
    assert {m["doubt"] for m in document["machines"]} == {None}
    first = document["machines"][0]["axes"]["Y"]
    assert (first["revision"], first["parameters"]["ft"]["value"]) == (3, 0.05)
    assert first["parameters"]["ft"]["low"] < 0.05 < first["parameters"]["ft"]["high"]
    assert "mill-3: X revision 6, Y revision 3" in text

    document, text = asked(capsys, 1, "outliers", works)
    (found,) = document["outliers"]
    assert (found["machine"], found["axis"], found["parameter"], found["sisters"]) == ("mill-3", "X", "ft", 6)
    assert "mill-3 axis X: ft = 0.09" in text
    assert asked(capsys, 0, "outliers", works, "--axis", "Y")[1] == "no axis differs from its peers\n"
    assert asked(capsys, 1, "outliers", works, "--by", "screw")[0]["outliers"][0]["label"] == "A"

    document, text = asked(capsys, 0, "compare", works, "--parameter", "ft", "--axis", "X")
    (group,) = document["groups"]
    assert [sister["machine"] for sister in group["sisters"]][-1] == "mill-3"
    assert "DIFFERS FROM ITS PEERS" in text

    words = ("trend", works, "--machine", "mill-3", "--axis", "X", "--parameter", "ft")
    document, text = asked(capsys, 0, *words)
    assert [told["value"] for told in document["sets"]] == pytest.approx([0.0512] * 3 + [0.09] * 3)
    assert document["slope_per_30_days"] is not None
    assert len(text.splitlines()) == 7
    assert "no parameters of axis Q" in asked(capsys, 1, *words[:5], "Q", *words[6:])[1]


async def test_records_that_do_not_come_are_counted(
    works: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(written(tmp_path / "mill", "mill-1"))
    count = machine.record(2)
    machine.close()
    messages = told_by(machine)
    await gather(fleet_of(database, tmp_path), messages[:3] + messages[6:])
    document, text = asked(capsys, 0, "status", works)
    assert document["machines"][0]["missing"] == 3
    assert f"{count - 3} records, 3 RECORDS MISSING" in text


@pytest.mark.parametrize("same_history", [True, False])
async def test_two_machines_of_one_name_are_reported(
    same_history: bool, works: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = Machine(written(tmp_path / "1", "mill-1"))
    first.record(1)
    if same_history:
        first.close()
        shutil.copytree(tmp_path / "1", tmp_path / "2")
        first = Machine(tmp_path / "1" / "machine.toml")
        second = Machine(tmp_path / "2" / "machine.toml")
    else:
        second = Machine(written(tmp_path / "2", "mill-1"))
    begun = [told_by(first), told_by(second)]
    first.record(2)
    second.record(1, parameters={"ft": 0.4})
    for machine in (first, second):
        machine.close()
    later = [told_by(machine)[len(before) :] for machine, before in zip((first, second), begun, strict=True)]
    messages = [begun[0], begun[1], *later]
    await gather(fleet_of(database, tmp_path), [message for part in messages for message in part])
    document, text = asked(capsys, 0, "status", works)
    (told,) = document["machines"]
    assert "two machines use this name" in told["doubt"]
    assert told["missing"] == 0
    assert "give each machine a unique name" in text


def test_a_database_without_the_fleet_is_told(works: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = fdhil("fleet", "status", str(works), capsys=capsys)
    assert (code, out) == (3, "")
    assert "start fdhil fleet collect first" in err


def test_a_database_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "host={tmp_path} dbname=none"\n')
    code, out, err = fdhil("fleet", "outliers", str(file), capsys=capsys)
    assert (code, out) == (3, "")
    assert "check [database] connection" in err


async def test_a_month_has_its_partition_and_a_wrong_clock_has_none(database: Postgres, tmp_path: Path) -> None:
    machine = Machine(written(tmp_path / "mill", "mill-1"))
    machine.record(1)
    machine.close()
    first, second, third, *_ = told_by(machine)
    clocks = [(first, 1_735_689_599.0), (second, 1_735_689_600.0), (third, 5.0)]  # the turn of the year 2025; 1970
    await gather(fleet_of(database, tmp_path), [with_time(message, at) for message, at in clocks])
    rows = database.ask(
        "SELECT c.relname FROM fleet.records r JOIN pg_class c ON r.tableoid = c.oid ORDER BY recorded_at DESC"
    )
    assert [name for (name,) in rows] == ["records_2025_01", "records_2024_12", "records_other"]


def with_time(message: Message, recorded_s: float) -> Message:
    head, record, _ = message.payload.split(b"\n")
    words = head.decode().split()
    words[6] = f"{recorded_s:.6f}"
    return replace(message, payload=" ".join(words).encode() + b"\n" + record + b"\n")


async def test_a_newer_schema_is_refused(database: Postgres, tmp_path: Path) -> None:
    await gather(fleet_of(database, tmp_path), [])
    database.ask("UPDATE fleet.schema_version SET version = 99")
    with pytest.raises(Exception, match="schema 99"):
        await gather(fleet_of(database, tmp_path), [])
    database.ask(f"UPDATE fleet.schema_version SET version = {migrations.VERSION}")
    await gather(fleet_of(database, tmp_path), [])


@pytest.mark.parametrize("bad", [0, 5, 12])
async def test_a_record_that_the_database_does_not_take_is_put_aside_alone(
    bad: int, database: Postgres, tmp_path: Path
) -> None:
    machine = Machine(written(tmp_path / "mill", "mill-1"))
    machine.record(2)
    machine.close()
    received = received_of(told_by(machine)[:13])
    record = received[bad].content
    assert isinstance(record, Record)
    received[bad] = received[bad]._replace(content=record._replace(text='{"text": "\\u0000"}'))
    await keep(fleet_of(database, tmp_path), received)
    assert database.ask("SELECT count(*) FROM fleet.records") == [(12,)]
    ((subject, reason, payload),) = database.ask("SELECT subject, reason, payload FROM fleet.refused")
    assert (subject, payload) == (received[bad].subject, record.payload)
    assert "u0000" in reason


async def test_the_views_are_those_that_the_page_lists(database: Postgres, tmp_path: Path) -> None:
    await gather(fleet_of(database, tmp_path), [])
    listed = "table_name, string_agg('`' || column_name || '`', ', ' ORDER BY ordinal_position)"
    columns = database.ask(f"""SELECT {listed} FROM information_schema.columns
        LEFT JOIN information_schema.views v USING (table_schema, table_name)
        WHERE table_schema = 'fleet' AND (v.table_name IS NOT NULL OR table_name = 'services') GROUP BY 1""")
    told = [f"| `{name}` | {names} |" for name, names in columns]
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "fleet.md").read_text("utf-8")
    assert [line for line in told if line not in page] == []
    # whatever is in it, each can be read
    for name, _ in columns:
        database.ask(f"SELECT * FROM fleet.{name}")
