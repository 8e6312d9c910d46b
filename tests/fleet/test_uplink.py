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
from fdhil.fleet import uplink
from fdhil.fleet.message import Record, decode
from fdhil.fleet.transport import connected
from fdhil.fleet.uplink import Sender
from fdhil.store.outbox import read_position
from tests.fleet.machine import Machine, written
from tests.ports import free_port


class Stream:
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

    def of(self, axis: str) -> list[int]:
        """Return the sequence numbers of an axis in the order of acceptance."""
        return [record.sequence for record in self.records if record.axis == axis and record.sequence]

    @property
    def records(self) -> list[Record]:
        """All accepted records, in that order."""
        told = [told for message in self.taken.values() for told in decode(*message)]
        return [record for record in told if isinstance(record, Record)]


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    made = Machine(written(tmp_path, windows="all"))
    yield made
    made.close()


def sender_of(machine: Machine) -> Sender:
    assert machine.config.uplink is not None
    return Sender(machine.config, machine.config.uplink)


async def send_all(sender: Sender, stream: Stream, most: int = 1 << 20) -> int:
    """Send all waiting entries and return their number."""
    of_nats = cast(JetStreamContext, stream)
    while True:
        position, entries = await sender._next(of_nats)
        if not entries:
            return sender.sent
        await sender._send(of_nats, position, entries, most)


@pytest.mark.parametrize("refused", range(1, 16, 2))
async def test_a_refused_message_is_sent_again_before_any_later_one_of_its_axis(
    refused: int, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uplink, "MESSAGE_BYTES", 1)  # each record goes alone
    count = machine.record(2)
    stream = Stream()
    stream.refuse = {refused, refused + 3}
    tries = 0
    while True:
        sender = sender_of(machine)  # a new process each time: only the position is known
        try:
            await send_all(sender, stream)
            break
        except nats.errors.TimeoutError:
            tries += 1
    assert tries in (1, 2)
    for axis in ("X", "Y"):
        assert stream.of(axis) == sorted(stream.of(axis))
    assert len(stream.of("X")) + len(stream.of("Y")) == count
    assert read_position(machine.config.uplink_directory).entry == count


async def test_what_was_sent_is_not_sent_again_and_the_machine_is_told_once(machine: Machine) -> None:
    count = machine.record(1)
    stream = Stream()
    assert await send_all(sender_of(machine), stream) == count
    calls = stream.calls
    assert len(stream.records) == count + 1  # and what the machine is
    assert await send_all(sender_of(machine), stream) == 0
    assert stream.calls == calls


async def test_a_window_that_is_too_large_or_gone_is_told_without_its_file(machine: Machine) -> None:
    machine.record(1)
    sorted((machine.config.store.directory / "windows").iterdir())[1].unlink()
    stream = Stream()
    await send_all(sender_of(machine), stream)
    windows = [record for record in stream.records if record.kind == "window"]
    assert [record.window is not None for record in windows] == [True, False]
    assert "no longer kept" in windows[1].text
    stream = Stream()
    read_position(machine.config.uplink_directory)
    (machine.config.uplink_directory / "position.json").unlink()
    await send_all(sender_of(machine), stream, most=70_000)
    windows = [record for record in stream.records if record.kind == "window"]
    assert [record.window for record in windows] == [None, None]


async def test_a_server_that_is_not_there_is_left_to_the_next_attempt() -> None:
    """The client itself would retry silently for minutes."""
    both = ",".join(f"nats://127.0.0.1:{free_port()}" for _ in range(2))
    async with asyncio.timeout(60):
        with pytest.raises(ConnectionRefusedError):
            await connected(NatsServer(server=both), "fdhil-mill-1", "uplink").__aenter__()


def test_only_the_machine_s_own_name_is_told(tmp_path: Path) -> None:
    names: dict[str, dict[str, Any]] = {"mill_1__X": {}, "line-3": {"machine": "line-3"}}
    for told, settings in names.items():
        machine = Machine(written(tmp_path / told, "mill 1: X", **settings))
        assert sender_of(machine).machine == told
        machine.close()
