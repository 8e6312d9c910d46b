"""A real NATS server with JetStream and a real PostgreSQL, as separate processes on free ports."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import psycopg

from tests.free_ports import find_free_port

NATS = shutil.which("nats-server") or "/usr/sbin/nats-server"
POSTGRES = next(iter(sorted(Path("/usr/lib/postgresql").glob("*/bin"))), Path("/usr/lib/postgresql/15/bin"))
PATIENCE_S = 180.0


def wait_until(holds: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, f"waited in vain until {what}"
        time.sleep(0.05)


def is_listening(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


def run_inside(folder: str) -> list[Path]:
    """Return the content of a folder of /proc; nothing if its process has ended."""
    with suppress(OSError):
        return list(Path(folder).iterdir())
    return []


def list_children(pid: int) -> list[int]:
    """Return the descendants of a process."""
    own: list[int] = []
    for task in run_inside(f"/proc/{pid}/task"):
        with suppress(OSError):  # ended in between
            own += map(int, (task / "children").read_text().split())
    return own + [grandchild for child in own for grandchild in list_children(child)]


def list_listening_addresses(*pids: int) -> set[str]:
    """Return the addresses that processes listen at, by IPv4 and IPv6."""
    sockets = set()
    for file in (file for pid in pids for file in run_inside(f"/proc/{pid}/fd")):
        with suppress(OSError):  # closed in between
            sockets.add(os.fspath(file.readlink()))
    found = set()
    for table in ("tcp", "tcp6"):
        for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            place, state, inode = (row.split()[k] for k in (1, 3, 9))
            if state == "0A" and f"socket:[{inode}]" in sockets:
                words = struct.unpack(f"<{len(place.split(':')[0]) // 8}I", bytes.fromhex(place.split(":")[0]))
                found.add(str(ip_address(struct.pack(f">{len(words)}I", *words))))
    return found


class NatsServer:
    """A NATS server that may be killed and restarted with its stored data."""

    def __init__(self, folder: Path, more: str = "") -> None:
        self.port = find_free_port()
        self.url = f"nats://127.0.0.1:{self.port}"
        self._file = folder / "nats.conf"
        self._file.write_text(
            f"host: 127.0.0.1\nport: {self.port}\njetstream {{ store_dir: '{folder}/jetstream' }}\n{more}"
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start_server(self) -> None:
        """Start it and wait until it listens."""
        self._process = subprocess.Popen([NATS, "-c", self._file], stderr=subprocess.DEVNULL)
        wait_until(lambda: is_listening(self.port), "nats-server listens")

    def stop_server(self, how: signal.Signals = signal.SIGTERM) -> None:
        """End it; SIGKILL as a power cut would."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait()
            self._process = None


def _as_nobody() -> dict[str, int | list[int]]:
    return {"user": 65534, "group": 65534, "extra_groups": []} if os.getuid() == 0 else {}


class Postgres:
    """A PostgreSQL server, reached by a UNIX socket, that may be killed and restarted."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="fdhil-pg-"))
        if os.getuid() == 0:
            os.chown(self.folder, 65534, 65534)
        self.connection = f"host={self.folder} user=fleet dbname=postgres connect_timeout=120"
        data = self.folder / "data"
        made: list[str | Path] = [
            POSTGRES / "initdb",
            "-D",
            data,
            "-U",
            "fleet",
            "-A",
            "trust",
            "-N",
            "-E",
            "UTF8",
            "--locale=C",
        ]
        self._run(made)
        self._process: subprocess.Popen[bytes] | None = None

    def _run(self, command: list[str | Path]) -> None:
        subprocess.run(command, check=True, capture_output=True, cwd=self.folder, **_as_nobody())  # type: ignore[call-overload]

    def start_server(self) -> None:
        """Start it and wait until it answers."""
        command = [POSTGRES / "postgres", "-D", self.folder / "data", "-k", self.folder, "-c", "listen_addresses="]
        self._process = subprocess.Popen(
            command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, cwd=self.folder, **_as_nobody()  # type: ignore[call-overload]
        )  # fmt: skip
        asked: list[str | Path] = [POSTGRES / "pg_isready", "-q", "-h", self.folder]
        wait_until(lambda: subprocess.run(asked, check=False).returncode == 0, "PostgreSQL answers")

    def execute_query(self, query: str) -> list[tuple[Any, ...]]:
        """Return the rows of a query."""
        with psycopg.connect(self.connection, autocommit=True) as db:
            cursor = db.execute(query.encode())
            return cursor.fetchall() if cursor.description else []

    def stop_server(self, how: signal.Signals = signal.SIGINT) -> None:
        """End it; SIGQUIT simulates a crash: committed data are recovered from its log."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait()
            self._process = None

    def remove_files(self) -> None:
        self.stop_server(signal.SIGINT)
        shutil.rmtree(self.folder)


@contextmanager
def run_postgres() -> Iterator[Postgres]:
    """Run PostgreSQL until the block is left."""
    server = Postgres()
    try:
        server.start_server()
        yield server
    finally:
        server.remove_files()


@contextmanager
def run_nats(folder: Path, more: str = "") -> Iterator[NatsServer]:
    """Run a NATS server until the block is left."""
    server = NatsServer(folder, more)
    try:
        server.start_server()
        yield server
    finally:
        server.stop_server()
