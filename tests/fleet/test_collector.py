"""A collector acknowledges a message only after it is in the database."""

from __future__ import annotations

import asyncio
import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import nats.errors
import psycopg
import pytest

from fdhil.config.fleet_config import Fleet, Objects
from fdhil.errors import StoreError
from fdhil.fleet import objects
from fdhil.fleet.collector import Collector, Received, _fetch, _give_back, _next
from fdhil.fleet.message import Message, Unread, of_entry
from fdhil.store import atomic
from fdhil.store.outbox import Entry

DIGEST, STORE = "a" * 64, "5" * 32


@dataclass
class Told:
    """A message of the stream; ``log`` records the answers."""

    subject: str
    data: bytes
    log: list[str]
    metadata: Any = field(default_factory=lambda: SimpleNamespace(timestamp=datetime(2027, 1, 15, tzinfo=UTC)))

    async def ack(self) -> None:
        self.log.append("ack")

    async def nak(self) -> None:
        self.log.append("nak")


class Reader:
    """Returns its messages once."""

    nothing: type[Exception] = nats.errors.TimeoutError

    def __init__(self, *messages: Told) -> None:
        self._messages = messages

    async def fetch(self, batch: int, timeout: float) -> Sequence[Told]:
        if not self._messages:
            raise self.nothing
        given, self._messages = self._messages, ()
        return given


def told(log: list[str], window: bytes | None = None) -> Told:
    row = {"id": 1, "wall_s": 1_800_000_000.0, "accepted": 1}
    message: Message = of_entry(Entry(1, "window", "X", DIGEST, row, "", False), "mill-1", STORE, window)
    return Told(message.subject, message.payload, log)


async def take(collector: Collector, *messages: Told) -> None:
    await collector._take(*await _next(cast(Any, Reader(*messages))), cast(Any, None))


@pytest.fixture
def collector(tmp_path: Path) -> Collector:
    return Collector(Fleet(objects=Objects(directory=tmp_path)))


async def test_first_the_database_then_the_answer(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    async def write(self: Collector, received: Sequence[Received], db: object) -> None:
        assert [each.content.reason for each in received if isinstance(each.content, Unread)] == [
            "it has no fdhil-record-1 header"
        ]
        log.append("written")

    monkeypatch.setattr(Collector, Collector._write.__name__, write)
    await take(collector, told(log), Told("fdhil.v1.mill-1.records", b"{\n{}\n", log))
    assert log == ["written", "ack", "ack"]
    assert collector.kept == 2
    await take(collector)  # nothing more is waiting
    assert collector.kept == 2


async def test_what_is_not_in_the_database_is_given_back(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    async def write(self: Collector, received: Sequence[Received], db: object) -> None:
        raise psycopg.OperationalError("the disk is full")

    monkeypatch.setattr(Collector, Collector._write.__name__, write)
    with pytest.raises(psycopg.OperationalError):
        await take(collector, told(log), told(log))
    assert (log, collector.kept) == (["nak", "nak"], 0)


async def test_a_window_that_cannot_be_kept_is_given_back(tmp_path: Path) -> None:
    log: list[str] = []
    (tmp_path / "file").touch()
    collector = Collector(Fleet(objects=Objects(directory=tmp_path / "file")))
    with pytest.raises(StoreError):
        await take(collector, told(log, b"PAR1"))
    assert log == ["nak"]


@pytest.mark.parametrize("nothing", [nats.errors.TimeoutError, TimeoutError])
async def test_that_nothing_came_is_no_fault(nothing: type[Exception]) -> None:
    reader = Reader()
    reader.nothing = nothing
    assert await _fetch(cast(Any, reader)) == []


async def test_what_came_meanwhile_is_given_back_when_the_collector_ends() -> None:
    log: list[str] = []
    coming = asyncio.ensure_future(_next(cast(Any, Reader(told(log), told(log)))))
    await asyncio.wait([coming])
    await _give_back(coming)
    assert log == ["nak", "nak"]
    await _give_back(asyncio.get_running_loop().create_future())  # nothing came yet


def test_a_window_is_written_once_under_the_name_of_its_content(tmp_path: Path) -> None:
    name = "ab" + "0" * 62
    objects.check_folder(tmp_path)
    for _ in range(2):
        objects.keep(tmp_path, name, b"PAR1")
    assert objects.path_of(tmp_path, name).read_bytes() == b"PAR1"
    assert sorted(path.name for path in tmp_path.rglob("*.part")) == []


def test_a_collector_that_is_killed_spoils_no_window_that_another_one_keeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, window, fsync = "ab" + "0" * 62, b"w" * 5_000, os.fsync

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    def other_begins(descriptor: int) -> None:
        """Let another collector write the same window between this one's last byte and its rename."""
        fsync(descriptor)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            with monkeypatch.context() as inner:
                inner.setattr(atomic, "write_all", killed)
                with pytest.raises(KeyboardInterrupt):
                    objects.keep(tmp_path, name, window)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", other_begins)
        objects.keep(tmp_path, name, window)
    assert objects.path_of(tmp_path, name).read_bytes() == window
    left = [path.stem for path in tmp_path.rglob("*") if path.is_file() and path.stem != name]
    assert [objects.path_of(tmp_path, each).is_file() for each in left] == [True], "retention finds what is left behind"
