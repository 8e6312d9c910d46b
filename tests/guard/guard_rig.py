"""Runs the guard's loop in this process, one turn at a time: a bus of lists, drives, and clients on its real socket."""

from __future__ import annotations

import hashlib
import json
import os
import socket
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fdhil.guard import correction_table
from fdhil.guard.can_socket import BusDown, CanSocket, Frame
from fdhil.guard.event_journal import EventJournal, SystemdNotifier
from fdhil.guard.guard_access import ClientProcess, Role
from fdhil.guard.guard_process import Guard
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.turn_lateness import TurnLateness
from tests.guard.simulated_bus import DIGEST, FACTS_GIVEN, Drive, commissioned, settings, smooth_path

TOKEN = "the operator's"
OWNER = ClientProcess(os.getuid(), os.getpid(), Role.COMMISSION)
DEMAND, OFFSET = smooth_path()


class Wire(CanSocket):
    """A bus; ``sent`` are (COB-ID, data); ``down``: the bus is down, ``full``: the transmit queue is full.

    Frames of the COB-IDs in ``kept_back`` do not leave; the first of those in ``ends_at`` takes the bus down.
    """

    def __init__(self, allowed: frozenset[int]) -> None:
        near, self._far = socket.socketpair()
        super().__init__(near, allowed)
        self._waiting: list[Frame] = []
        self.sent: list[tuple[int, bytes]] = []
        self.down = self.full = False
        self.kept_back: Collection[int] = ()
        self.ends_at: Collection[int] = ()

    def feed(self, frames: Sequence[Frame]) -> None:
        self._waiting += frames
        self._far.send(b"x")

    def receive(self) -> list[Frame]:
        self._socket.recv(4096)
        if self.down:
            raise BusDown("the cable is cut")
        waiting, self._waiting = self._waiting, []
        return waiting

    def try_restore(self) -> bool:
        self._waiting.clear()
        return not self.down

    def _send(self, cob_id: int, data: bytes) -> bool:
        self.down = self.down or cob_id in self.ends_at
        if self.down:
            raise OSError(100, "Network is down")
        left = not self.full and cob_id not in self.kept_back
        if left:
            self.sent.append((cob_id, data))
        return left

    def close(self) -> None:
        super().close()
        self._far.close()


class GuardRig:
    def __init__(
        self, folder: Path, made: GuardSettings | None = None, notify: str | None = None, **changes: Any
    ) -> None:
        made = made or commissioned(settings(**changes))
        digest = hashlib.sha256(TOKEN.encode()).hexdigest()
        self.settings = replace(made, run_directory=str(folder), token_sha256=digest)
        self.wire = Wire(self.settings.sent_ids)
        self.wake, self.stop = socket.socketpair()
        self.wake.setblocking(False)
        self.lines = folder / "journal"
        self._journal = self.lines.open("wb")
        journal, self.notifier = EventJournal(self._journal.fileno()), SystemdNotifier(notify)
        self.guard = Guard(self.settings, self.wire, journal, self.notifier, self.wake)
        # how late this process is decides nothing here
        self.guard._turns = TurnLateness(replace(self.settings, clock="sync"))
        self.drives = [Drive(axis.node_id) for axis in self.settings.axes]
        for drive, column in zip(self.drives, DEMAND, strict=False):
            drive.queue = [(column[0], 0)] * 2
        self.tick = self.row = self.taken = 0
        self.playing = False
        self._clients: list[socket.socket] = []

    def cycle(self) -> None:
        self.tick += 1
        sampled = [frame for drive in self.drives for frame in drive.at_sync(self.tick)]
        targets = [column[min(self.row, len(column) - 1)] for column in DEMAND]
        self.row += self.playing
        frames = [(0x080, bytes([(self.tick - 1) % 240 + 1])), *sampled]
        for drive, target in zip(self.drives, targets, strict=True):
            drive.received_target = target
            frames.append((0x200 + drive.node_id, struct.pack("<Hi", 0x0F, target)))
        self.wire.feed([(cob_id, data, self.tick * 1e-3) for cob_id, data in frames])
        self.turn()

    def turn(self) -> None:
        self.guard._serve_sockets()
        for cob_id, data in self.wire.sent[self.taken :]:
            for drive in self.drives:
                if cob_id == 0x300 + drive.node_id:
                    drive.received_offset = struct.unpack("<i", data)[0]
        self.taken = len(self.wire.sent)

    def serve(self) -> None:
        for _ in range(3):
            self.guard._rested_s = 0.0
            self.turn()

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle()

    def connect(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.connect(str(self.guard.control.path))
        client.setblocking(False)
        self._clients.append(client)
        return client

    def ask(self, client: socket.socket, request: Mapping[str, Any] | bytes, *descriptors: int) -> dict[str, Any]:
        line = request if isinstance(request, bytes) else json.dumps(request).encode()
        socket.send_fds(client, [line + b"\n"], descriptors)
        return self.answer(client)

    def answer(self, client: socket.socket, syncing: bool = True) -> dict[str, Any]:
        text = b""
        while not text.endswith(b"\n"):
            if syncing:
                self.cycle()
            else:
                self.turn()
            try:
                text += client.recv(1 << 16)
            except BlockingIOError:
                continue
        return dict(json.loads(text))

    def load(self, client: socket.socket, amplitude: int = 1) -> None:
        names = [axis.name for axis in self.settings.axes]
        offsets = [[amplitude * value for value in column] for column in OFFSET]
        body = correction_table.encode_table(
            names, dict(zip(names, DEMAND, strict=True)), dict(zip(names, offsets, strict=True)), DIGEST
        )
        sealed = correction_table.seal_table(body)
        answer = self.ask(client, {"request": "table"}, sealed)
        os.close(sealed)
        assert answer["ok"], answer

    def arm(self) -> socket.socket:
        client = self.connect()
        self.load(client)
        self.run(150)
        armed = {"request": "arm", "token": TOKEN, "program_digest": DIGEST, "facts": dict(FACTS_GIVEN)}
        answer = self.ask(client, armed)
        assert answer["ok"], answer
        return client

    def into_the_cut(self) -> socket.socket:
        client = self.arm()
        self.playing = True
        self.run(250)
        assert self.state == "ACTIVE", self.events()[-3:]
        assert abs(self.offsets()[-1]) > 50
        return client

    @property
    def state(self) -> str:
        return self.guard.state.mode.value

    def offsets(self, node: int = 1) -> list[int]:
        return [struct.unpack("<i", data)[0] for cob_id, data in self.wire.sent if cob_id == 0x300 + node]

    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.lines.read_text().splitlines()]

    def close(self) -> None:
        self.guard.control.close()
        self.notifier.close()
        self.wire.close()
        self._journal.close()
        for each in (self.wake, self.stop, *self._clients):
            each.close()
