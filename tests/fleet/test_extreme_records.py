"""Extreme records of one machine do not break the queries about all machines."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from fdhil.cli import fleet_view
from fdhil.fleet.anonymous_export import KEY_BYTES, export_tables
from fdhil.fleet.axis_services import list_services
from fdhil.fleet.fleet_queries import compare_parameter, compute_trend, find_outliers, read_fleet_status
from fdhil.fleet.parameter_sets import open_database, open_read_only
from fdhil.fleet.record_message import Message, compute_digest
from tests.fleet.fleet_database import STORED, build_fleet, collect_messages, list_messages
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

ABSURD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 2**40, 2**61, 2**63, 1e30, -1e30, 1e300, -1e308, 1e-300, 0.5, "", "x", "1e999",
    "NaN", "\x1b[2J", [], [[]], [1e300] * 9, [[1e308] * 6] * 6, [["x"] * 6] * 6, [[{}] * 6] * 6, {}, {"0": {"0": 1}},
    {"x": 1}, {"x": [1]}, {"x": {"y": []}}, {"X": {"type": 1e300}}, {"R": {"value": 1e308, "std": "x"}}, [None] * 7,
)  # fmt: skip
MORE = ("terms", "maintenance", "axis_labels", "temperature_c", "unexplained_um", "left_out", "answer")


def build_extreme_record(message: Message, machine: str, record: Any, **head: str) -> Message:
    """Return a message of another machine with another record and other header fields."""
    first, _, _ = message.payload.split(b"\n", 2)
    words = first.decode().split()
    words[4], words[7] = compute_digest(record, machine), "-"
    for name, value in head.items():
        words[{"store": 1, "axis": 2, "kind": 3, "sequence": 5, "at": 6}[name]] = value
    payload = " ".join(words).encode() + b"\n" + json.dumps(record).encode() + b"\n"
    return replace(message, subject=f"fdhil.v1.{machine}.records", payload=payload)


def list_cases(messages: list[Message]) -> Iterator[Message]:
    """Yield every field of every kind of record with every extreme value, each for a separate machine."""
    for message in {m.payload.split(b" ", 4)[3]: m for m in messages}.values():
        record = json.loads(message.payload.split(b"\n", 2)[1])
        for field in (*record, *MORE):
            for k, value in enumerate(ABSURD):
                yield build_extreme_record(message, f"bad-{field}-{k}", record | {field: value})
    offer = {"name": "n", "version": 1, "stage": 1, "answer": "accepted", "by": "x", "reason": "", "document": ""}
    for field in offer:
        for k, value in enumerate(ABSURD):
            yield build_extreme_record(
                messages[0], f"bad-offer-{field}-{k}", offer | {field: value}, kind="offer", axis="-"
            )
    for k in range(12):  # more than a bigint together
        yield build_extreme_record(messages[1], "bad-stores", {"k": k}, store=f"{k:032x}", sequence="9" * 18)
    for k in range(12 * 30):  # a partition for each month makes every question slow
        month = datetime(2060 + k // 12, k % 12 + 1, 2, tzinfo=UTC)
        yield build_extreme_record(messages[1], "bad-months", {"k": k}, at=f"{month.timestamp():.6f}")
    for k, at in enumerate(("0.000000", "9999999999.000000", "4102444800.000000")):
        yield build_extreme_record(
            messages[1], f"bad-clock-{k}", json.loads(messages[1].payload.split(b"\n", 2)[1]), at=at
        )


@pytest.mark.debian
@pytest.mark.usefixtures("processes")
async def test_extreme_record_does_not_break_fleet_queries(database: Postgres, tmp_path: Path) -> None:
    fleet = build_fleet(database, tmp_path)
    sound: list[Message] = []
    for k in range(6):
        machine = RecordingMachine(write_history(tmp_path / str(k), f"mill-{k}"))
        machine.record_windows(3)
        machine.store.store_acknowledgement({"up_to": 1, "by": "Anna"})
        machine.close_store()
        sound += list_messages(machine)
    await collect_messages(fleet, [*sound, *list_cases(sound)])
    partitions = database.execute_query("SELECT count(*) FROM pg_inherits WHERE inhparent = 'fleet.records'::regclass")
    assert partitions[0][0] < 10
    with open_database(fleet) as db:
        for machine in [row["machine"] for row in db.execute("SELECT machine FROM fleet.machines").fetchall()]:
            db.execute("INSERT INTO fleet.services VALUES (%s, '', %s, 'oil')", (machine, STORED))
    with open_read_only(fleet) as db, warnings.catch_warnings():
        warnings.simplefilter("error")
        asked: dict[str, Callable[[], Any]] = {
            "status": lambda: read_fleet_status(db),
            "outliers": lambda: find_outliers(db, "type", None),
            "compare": lambda: compare_parameter(db, "R", "type", None),
            "services": lambda: list_services(db),
        }
        for question, ask in asked.items():
            answer = ask()
            json.dumps(answer, allow_nan=False)
            assert list(fleet_view.LINES[question](answer))
        for machine in answer["services"]:
            json.dumps(compute_trend(db, machine["machine"], "X", "R"), allow_nan=False)
        export_tables(db, tmp_path / "export", b"k" * KEY_BYTES, ("type",))
        for (view,) in database.execute_query(
            "SELECT table_name FROM information_schema.views WHERE table_schema = 'fleet'"
        ):
            database.execute_query(f"SELECT * FROM fleet.{view}")
