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
from fdhil.fleet import window_files
from fdhil.fleet.collector import Collector, ReceivedRecord, _fetch_messages, _receive_batch, _return_pending_batch
from fdhil.fleet.record_message import Message, UnreadableRecord, encode_entry
from fdhil.store import atomic_file
from fdhil.store.outbox import OutboxEntry

DIGEST, STORE = "a" * 64, "5" * 32


@dataclass
class FakeMessage:
    """A message of the stream; ``log`` records the answers."""

    subject: str
    data: bytes
    log: list[str]
    metadata: Any = field(default_factory=lambda: SimpleNamespace(timestamp=datetime(2027, 1, 15, tzinfo=UTC)))

    async def ack(self) -> None:
        self.log.append("ack")

    async def nak(self) -> None:
        self.log.append("nak")


class FakeReader:
    """Returns its messages once."""

    nothing: type[Exception] = nats.errors.TimeoutError

    def __init__(self, *messages: FakeMessage) -> None:
        self._messages = messages

    async def fetch(self, batch: int, timeout: float) -> Sequence[FakeMessage]:
        if not self._messages:
            raise self.nothing
        given, self._messages = self._messages, ()
        return given


def create_messages(log: list[str], window: bytes | None = None) -> FakeMessage:
    row = {"id": 1, "wall_s": 1_800_000_000.0, "accepted": 1}
    message: Message = encode_entry(OutboxEntry(1, "window", "X", DIGEST, row, "", False), "mill-1", STORE, window)
    return FakeMessage(message.subject, message.payload, log)


async def collect_messages(collector: Collector, *messages: FakeMessage) -> None:
    await collector._store_and_acknowledge(*await _receive_batch(cast(Any, FakeReader(*messages))), cast(Any, None))


@pytest.fixture
def collector(tmp_path: Path) -> Collector:
    return Collector(Fleet(objects=Objects(directory=tmp_path)))


async def test_message_is_acknowledged_after_commit(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    async def record_write(self: Collector, received: Sequence[ReceivedRecord], db: object) -> None:
        assert [each.content.reason for each in received if isinstance(each.content, UnreadableRecord)] == [
            "it has no fdhil-record-1 header"
        ]
        log.append("written")

    monkeypatch.setattr(Collector, Collector._write_transaction.__name__, record_write)
    await collect_messages(collector, create_messages(log), FakeMessage("fdhil.v1.mill-1.records", b"{\n{}\n", log))
    assert log == ["written", "ack", "ack"]
    assert collector.kept == 2
    await collect_messages(collector)  # nothing more is waiting
    assert collector.kept == 2


async def test_message_is_returned_when_database_fails(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    async def fail_write(self: Collector, received: Sequence[ReceivedRecord], db: object) -> None:
        raise psycopg.OperationalError("the disk is full")

    monkeypatch.setattr(Collector, Collector._write_transaction.__name__, fail_write)
    with pytest.raises(psycopg.OperationalError):
        await collect_messages(collector, create_messages(log), create_messages(log))
    assert (log, collector.kept) == (["nak", "nak"], 0)


async def test_message_is_returned_when_window_cannot_be_stored(tmp_path: Path) -> None:
    log: list[str] = []
    (tmp_path / "file").touch()
    collector = Collector(Fleet(objects=Objects(directory=tmp_path / "file")))
    with pytest.raises(StoreError):
        await collect_messages(collector, create_messages(log, b"PAR1"))
    assert log == ["nak"]


@pytest.mark.parametrize("nothing", [nats.errors.TimeoutError, TimeoutError])
async def test_empty_fetch_is_no_error(nothing: type[Exception]) -> None:
    reader = FakeReader()
    reader.nothing = nothing
    assert await _fetch_messages(cast(Any, reader)) == []


async def test_pending_messages_are_returned_when_collector_ends() -> None:
    log: list[str] = []
    coming = asyncio.ensure_future(_receive_batch(cast(Any, FakeReader(create_messages(log), create_messages(log)))))
    await asyncio.wait([coming])
    await _return_pending_batch(coming)
    assert log == ["nak", "nak"]
    await _return_pending_batch(asyncio.get_running_loop().create_future())  # nothing came yet


def test_window_is_written_once_under_its_digest(tmp_path: Path) -> None:
    name = "ab" + "0" * 62
    window_files.check_folder(tmp_path)
    for _ in range(2):
        window_files.store_window(tmp_path, name, b"PAR1")
    assert window_files.build_window_path(tmp_path, name).read_bytes() == b"PAR1"
    assert sorted(path.name for path in tmp_path.rglob("*.part")) == []


def test_killed_collector_does_not_corrupt_window_of_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, window, fsync = "ab" + "0" * 62, b"w" * 5_000, os.fsync

    def kill_writer(*_: object) -> None:
        raise KeyboardInterrupt

    def start_other_writer(descriptor: int) -> None:
        """Let another collector write the same window between this one's last byte and its rename."""
        fsync(descriptor)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            with monkeypatch.context() as inner:
                inner.setattr(atomic_file, "write_all", kill_writer)
                with pytest.raises(KeyboardInterrupt):
                    window_files.store_window(tmp_path, name, window)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", start_other_writer)
        window_files.store_window(tmp_path, name, window)
    assert window_files.build_window_path(tmp_path, name).read_bytes() == window
    left = [path.stem for path in tmp_path.rglob("*") if path.is_file() and path.stem != name]
    assert [window_files.build_window_path(tmp_path, each).is_file() for each in left] == [True], (
        "retention finds what is left behind"
    )
