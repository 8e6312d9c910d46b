"""Order and position of the sent records, with a server that accepts some messages and refuses others."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import nats.errors
import pytest
from nats.js import JetStreamContext

from fdhil.config.uplink_section import NatsServer
from fdhil.fleet import record_uplink
from fdhil.fleet.nats_transport import connect_to_server
from fdhil.fleet.record_message import Record, decode_message
from fdhil.fleet.record_uplink import OutboxSender
from fdhil.store.outbox import read_position
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.free_ports import find_free_port


class FakeStream:
    """Accepts messages like JetStream, except those it is told to refuse; a message id is accepted once."""

    def __init__(self) -> None:
        self.taken: dict[str, tuple[str, bytes]] = {}
        self.refuse: set[int] = set()
        self.calls = 0

    async def publish(self, subject: str, payload: bytes, timeout: float, headers: dict[str, str]) -> None:
        self.calls += 1
        if self.calls in self.refuse:
            raise nats.errors.TimeoutError
        self.taken.setdefault(headers["Nats-Msg-Id"], (subject, payload))

    def list_of_kind(self, axis: str) -> list[int]:
        """Return the sequence numbers of an axis in the order of acceptance."""
        return [record.sequence for record in self.list_records if record.axis == axis and record.sequence]

    @property
    def list_records(self) -> list[Record]:
        """All accepted records, in that order."""
        reported = [told for message in self.taken.values() for told in decode_message(*message)]
        return [record for record in reported if isinstance(record, Record)]


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[RecordingMachine]:
    made = RecordingMachine(write_history(tmp_path, windows="all"))
    yield made
    made.close_store()


def create_sender(machine: RecordingMachine) -> OutboxSender:
    assert machine.config.uplink is not None
    return OutboxSender(machine.config, machine.config.uplink)


async def send_all(sender: OutboxSender, stream: FakeStream, most: int = 1 << 20) -> int:
    """Send all waiting entries and return their number."""
    of_nats = cast(JetStreamContext, stream)
    while True:
        position, entries = await sender._read_next_entries(of_nats)
        if not entries:
            return sender.sent
        await sender._send_entries(of_nats, position, entries, most)


@pytest.mark.parametrize("refused", range(1, 16, 2))
async def test_refused_message_is_repeated_before_later_ones(
    refused: int, machine: RecordingMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_uplink, "MESSAGE_BYTES", 1)  # each record goes alone
    count = machine.record_windows(2)
    stream = FakeStream()
    stream.refuse = {refused, refused + 3}
    tries = 0
    while True:
        sender = create_sender(machine)  # a new process each time: only the position is known
        try:
            await send_all(sender, stream)
            break
        except nats.errors.TimeoutError:
            tries += 1
    assert tries in (1, 2)
    for axis in ("X", "Y"):
        assert stream.list_of_kind(axis) == sorted(stream.list_of_kind(axis))
    assert len(stream.list_of_kind("X")) + len(stream.list_of_kind("Y")) == count
    assert read_position(machine.config.uplink_directory).entry == count


async def test_sent_records_and_description_are_not_repeated(machine: RecordingMachine) -> None:
    count = machine.record_windows(1)
    stream = FakeStream()
    assert await send_all(create_sender(machine), stream) == count
    calls = stream.calls
    assert len(stream.list_records) == count + 1  # and what the machine is
    assert await send_all(create_sender(machine), stream) == 0
    assert stream.calls == calls


async def test_record_of_missing_or_large_window_is_sent_without_file(machine: RecordingMachine) -> None:
    machine.record_windows(1)
    sorted((machine.config.store.directory / "windows").iterdir())[1].unlink()
    stream = FakeStream()
    await send_all(create_sender(machine), stream)
    windows = [record for record in stream.list_records if record.kind == "window"]
    assert [record.window is not None for record in windows] == [True, False]
    assert "no longer kept" in windows[1].text
    stream = FakeStream()
    read_position(machine.config.uplink_directory)
    (machine.config.uplink_directory / "position.json").unlink()
    await send_all(create_sender(machine), stream, most=70_000)
    windows = [record for record in stream.list_records if record.kind == "window"]
    assert [record.window for record in windows] == [None, None]


async def test_unavailable_server_is_retried_later() -> None:
    """The client itself would retry silently for minutes."""
    both = ",".join(f"nats://127.0.0.1:{find_free_port()}" for _ in range(2))
    async with asyncio.timeout(60):
        with pytest.raises(ConnectionRefusedError):
            await connect_to_server(NatsServer(server=both), "fdhil-mill-1", "uplink").__aenter__()


def test_only_own_machine_name_is_sent(tmp_path: Path) -> None:
    names: dict[str, dict[str, Any]] = {"mill_1__X": {}, "line-3": {"machine": "line-3"}}
    for reported, settings in names.items():
        machine = RecordingMachine(write_history(tmp_path / reported, "mill 1: X", **settings))
        assert create_sender(machine).machine == reported
        machine.close_store()
