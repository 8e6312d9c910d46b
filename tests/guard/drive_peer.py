"""A socketcand hub with a machine behind it, in a thread; it paces SYNC and waits for clients only in lockstep."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fdhil.config import CanBus
from fdhil.guard.transmit_socket import greet_hub, open_transmit_socket
from tests.bench import bench_toml
from tests.guard.simulated_bus import DEMAND_AT_REST, Drive, Frame

ANSWER_S = 8.0  # a guard takes ten seconds without SYNC for a bus that is dead
NEVER = 1 << 30
SLOW_S = 0.02


def open_bus(name: str, bus: CanBus) -> socket.socket:
    transmit = open_transmit_socket(name, bus)
    greet_hub(name, bus, transmit)
    return transmit


def encode(frames: list[Frame]) -> bytes:
    return b"".join(f"< frame {i:03X} {time.time():.6f} {d.hex()} >".encode() for i, d in frames)


class Peer(threading.Thread):
    """One client is the guard; ``sent`` lists (SYNC count, COB-ID, data) of everything that it sent.

    Each cycle: SYNC, the drives' TPDOs, then the NC's targets. While ``lockstep`` the next SYNC waits for the offset
    frames of a guard that sent some in the cycle before, until a test clears ``expected``. ``turns`` counts the turns
    of the thread. ``row`` runs over ``demand`` while ``playing``, slowly from ``slow_from``, so that a test on a busy
    host still meets the intended part of the path. ``at_row`` are frames of another node sent once with the TPDOs of
    that row; ``rows_at`` is the row of each SYNC.
    """

    def __init__(self, demand: list[list[int]], period_s: float = 0.001) -> None:
        super().__init__(daemon=True)
        self.demand, self.period_s = demand, period_s
        self.drives = [Drive(k + 1) for k in range(len(demand))]
        self.sent: list[tuple[int, int, bytes]] = []
        self.latched: list[tuple[int, tuple[int, ...], tuple[int, ...]]] = []
        self.tick = self.row = self.turns = 0
        self.playing = False
        self.at_row: dict[int, Frame] = {}
        self.rows_at: dict[int, int] = {}
        self.slow_from = NEVER
        self.lockstep = self.syncing = self.expected = True
        self.ended = threading.Event()
        self._inbox = b""
        self._offset_frames = 0
        self._frames_before = 0
        self.standing = False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._client: socket.socket | None = None
        self._lock = threading.Lock()

    def run(self) -> None:
        self._server.settimeout(0.05)
        while not self.ended.is_set():
            self.turns += 1
            self.standing = not self.syncing
            if self._client is None:
                self._accept()
            elif not self.standing:
                self._cycle()
            else:
                self._listen(self.period_s)
        for each in (self._client, self._server):
            if each is not None:
                each.close()

    @property
    def hung_up(self) -> bool:
        return self._client is None

    def _accept(self) -> None:
        try:
            client, _ = self._server.accept()
        except TimeoutError:
            return
        try:
            self._greet(client)
        except OSError:  # it has gone again
            client.close()
        else:
            self._client = client

    @staticmethod
    def _greet(client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.sendall(b"< hi >")
        for command in (b"< open can0 >", b"< rawmode >"):
            got = b""
            while not got.endswith(b">"):
                byte = client.recv(1)
                if not byte:
                    raise ConnectionError
                got += byte
            assert got == command
            client.sendall(b"< ok >")

    def inject(self, *frames: Frame) -> None:
        with self._lock:
            assert self._client is not None
            self._client.sendall(encode(list(frames)))

    def _cycle(self) -> None:
        time.sleep(SLOW_S if self.row >= self.slow_from else 0.0)
        self.tick += 1
        waits = self.lockstep and self._offset_frames > self._frames_before
        self._frames_before = before = self._offset_frames
        sampled = [frame for drive in self.drives for frame in drive.at_sync(self.tick)]
        self.latched.append((self.tick, tuple(d.target for d in self.drives), tuple(d.offset for d in self.drives)))
        last = len(self.demand[0]) - 1
        targets = [column[min(self.row, last)] for column in self.demand]
        streamed = []
        for drive, target in zip(self.drives, targets, strict=True):
            drive.received_target = target
            streamed.append((0x200 + drive.node_id, b"\x0f\x00" + target.to_bytes(4, "little", signed=True)))
        self.rows_at[self.tick] = self.row
        if self.row in self.at_row:
            sampled.append(self.at_row.pop(self.row))
        self.row += self.playing
        sync = (0x080, bytes([(self.tick - 1) % 240 + 1]))
        self._transmit(encode([sync, *sampled, *streamed]))
        deadline_s = time.monotonic() + (ANSWER_S if waits else self.period_s)
        while time.monotonic() < deadline_s and not self.ended.is_set() and self._client is not None:
            if waits and (not self.expected or self._offset_frames - before >= len(self.drives)):
                break
            self._listen(min(0.02, max(0.0, deadline_s - time.monotonic())))

    def _transmit(self, text: bytes) -> None:
        assert self._client is not None
        try:
            with self._lock:
                self._client.sendall(text)
        except OSError:
            self._client.close()
            self._client = None

    def _listen(self, wait_s: float) -> None:
        if self._client is None or not select.select([self._client], [], [], wait_s)[0]:
            return
        try:
            chunk = self._client.recv(4096)
        except OSError:
            chunk = b""
        if not chunk:
            self._client.close()
            self._client = None
            return
        *commands, self._inbox = (self._inbox + chunk).split(b">")
        for command in commands:
            words = command.split()
            assert words[:2] == [b"<", b"send"], command
            cob_id, data = int(words[2], 16), bytes(int(word, 16) for word in words[4:])
            assert len(data) == int(words[3], 16)
            self.sent.append((self.tick, cob_id, data))
            for drive in self.drives:
                if cob_id == 0x300 + drive.node_id:
                    self._offset_frames += 1
                    drive.received_offset = int.from_bytes(data, "little", signed=True)

    def stand(self) -> None:
        self.syncing = False
        self.wait(lambda: self.standing, "a standstill")

    def read_out(self) -> None:
        client = self._client
        assert client is not None
        self.wait(lambda: not select.select([client], [], [], 0)[0], "an empty socket")
        turns = self.turns
        self.wait(lambda: self.turns > turns + 1, "the end of the turn that emptied it")

    def offsets_sent(self, node: int = 1) -> list[tuple[int, int]]:
        """Return (SYNC count, increments) of the offset frames to one node."""
        return [(k, int.from_bytes(d, "little", signed=True)) for k, i, d in list(self.sent) if i == 0x300 + node]

    def wait(self, condition: Callable[[], bool], what: str, limit_s: float = 100.0) -> None:
        deadline_s = time.monotonic() + limit_s
        while not condition():
            assert time.monotonic() < deadline_s, f"{what} did not come about"
            time.sleep(0.002)


@contextmanager
def hold_demand() -> Iterator[Peer]:
    peer = Peer(DEMAND_AT_REST)
    peer.start()
    yield peer
    peer.ended.set()
    peer.join()


def write_config(folder: Path, port: int, clock: str = "sync", axes: str = "XY", corrected: bool = True) -> Path:
    bus = f'[bus.can0]\ninterface = "socketcand"\nhost = "127.0.0.1"\nport = {port}\n[guard]\nclock = "{clock}"\n'
    file = folder / "machine.toml"
    file.write_text(bench_toml(axes, corrected) + bus, "utf-8")
    return file
