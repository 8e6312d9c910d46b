"""From a machine's store to the database with real servers: nothing lost, nothing duplicated, order kept."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest

from fdhil.store.windows import read_window
from studies.fleet_cut import Network
from tests.fleet.machine import Machine, written
from tests.fleet.servers import PATIENCE_S, NatsServer, Postgres, nats, until
from tests.store.made import same, window

pytestmark = pytest.mark.debian


def counted(database: Postgres) -> int:
    """Return the number of records in the database; 0 before its tables exist."""
    try:
        return int(database.ask("SELECT count(*) FROM fleet.records WHERE sequence > 0")[0][0])
    except psycopg.errors.UndefinedTable:
        return 0


def of_the_works(folder: Path, server: NatsServer, database: Postgres, max_bytes: int = 1 << 26) -> Path:
    """Write the fleet server's configuration."""
    file = folder / "fleet.toml"
    file.write_text(
        f'[server]\nserver = "{server.url}"\n[stream]\nmax_bytes = {max_bytes}\n'
        f'[database]\nconnection = "{database.connection}"\n[objects]\ndirectory = "objects"\n'
    )
    return file


class Process:
    """A running fdhil command."""

    def __init__(self, log: Path, *words: object) -> None:
        self._log = log
        self._words = [str(word) for word in words]
        self.start()

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._before = log.tell()
            command = [sys.executable, "-m", "fdhil", *self._words]
            self._process = subprocess.Popen(command, stdout=log, stderr=log)

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it once it runs, and return its exit code."""
        until(lambda: self._log.stat().st_size > self._before, "it runs")
        self._process.send_signal(how)
        return self._process.wait(PATIENCE_S)

    @property
    def said(self) -> str:
        """Its output."""
        return self._log.read_text()


@contextmanager
def running(log: Path, *words: object) -> Iterator[Process]:
    """Run a command until the block is left; it must end on request."""
    process = Process(log, *words)
    try:
        yield process
    finally:
        code = process.end()
    assert code == 0, process.said


def test_what_a_machine_records_comes_to_the_database_once_and_in_order(tmp_path: Path, database: Postgres) -> None:
    with nats(tmp_path) as server:
        file = written(tmp_path / "mill", "mill 1", server=server.url, windows="all")
        machine = Machine(file)
        works = of_the_works(tmp_path, server, database)
        expected = machine.record(10)
        with (
            running(tmp_path / "collect.log", "fleet", "collect", works) as collector,
            running(tmp_path / "uplink.log", "uplink", file) as uplink,
        ):
            until(lambda: counted(database) == expected, f"all are there: {collector.said} {uplink.said}")
            expected += machine.record(2)
            until(lambda: counted(database) == expected, "what was added is there")
        machine.close()
    rows = database.ask("SELECT sequence, axis FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence")
    for axis in ("X", "Y"):
        told = [sequence for sequence, of in rows if of == axis]
        assert told == sorted(told)
    assert sorted(sequence for sequence, _ in rows) == list(range(1, expected + 1))
    assert database.ask("SELECT machine, records, missing FROM fleet.machines") == [("mill_1", expected, 0)]
    ((name,),) = database.ask("SELECT window_name FROM fleet.windows WHERE axis = 'Y' AND number = 2")
    stored = read_window(tmp_path / "objects" / name[:2] / f"{name}.parquet")
    assert same(stored, window(axis="Y", start_tick=1000, seed=1000))


def test_killed_anywhere_loses_and_doubles_nothing(tmp_path: Path, database: Postgres) -> None:
    """Uplink, server, database and both collectors are killed in turn while two machines keep recording."""
    with nats(tmp_path) as server:
        works = of_the_works(tmp_path, server, database)
        files = [written(tmp_path / name, name, server=server.url, windows="refused") for name in ("mill-1", "mill-2")]
        machines = [Machine(file) for file in files]
        uplinks = [Process(tmp_path / f"uplink-{k}.log", "uplink", file) for k, file in enumerate(files)]
        collectors = [Process(tmp_path / f"collect-{k}.log", "fleet", "collect", works) for k in range(2)]
        expected = 0
        for victim in (uplinks[0], collectors[0], "nats", uplinks[1], "postgres", collectors[1]):
            before = counted(database)
            expected += sum(machine.record(20) for machine in machines)
            until(lambda before=before: counted(database) > before, "some of it is there")  # type: ignore[misc]
            if victim == "nats":
                server.stop(signal.SIGKILL)
                server.start()
            elif victim == "postgres":
                database.stop(signal.SIGQUIT)
                database.start()
            else:
                assert isinstance(victim, Process)
                victim.end(signal.SIGKILL)
                victim.start()
        until(lambda: counted(database) >= expected, "all are there")
        for process in (*uplinks, *collectors):
            assert process.end() == 0, process.said
        for machine in machines:
            machine.close()
    each = expected // 2
    assert database.ask("SELECT machine, records, missing FROM fleet.machines ORDER BY machine") == [
        ("mill-1", each, 0), ("mill-2", each, 0),
    ]  # fmt: skip
    rows = database.ask(
        "SELECT machine, sequence, axis FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence"
    )
    for name in ("mill-1", "mill-2"):
        assert sorted(sequence for machine, sequence, _ in rows if machine == name) == list(range(1, each + 1))
        for axis in ("X", "Y"):
            told = [sequence for machine, sequence, of in rows if (machine, of) == (name, axis)]
            assert told == sorted(told)
    assert database.ask("SELECT count(*) FROM fleet.refused") == [(0,)]


def test_what_the_server_has_no_room_for_stays_on_the_machine(tmp_path: Path, database: Postgres) -> None:
    """The stream is full without a collector; the rest follows when there is room again."""
    with nats(tmp_path) as server:
        file = written(tmp_path / "mill", "mill-1", server=server.url, windows="all")
        works = of_the_works(tmp_path, server, database, max_bytes=1 << 17)
        with running(tmp_path / "first.log", "fleet", "collect", works) as collector:  # makes the stream
            until(lambda: "connected to the server and the database" in collector.said, "the stream is there")
        machine = Machine(file)
        expected = machine.record(16)
        log = tmp_path / "uplink.log"
        with running(log, "uplink", file) as uplink:
            until(lambda: "maximum bytes exceeded" in uplink.said, "the stream is full")
            with running(tmp_path / "second.log", "fleet", "collect", works) as collector:
                until(lambda: counted(database) == expected, f"all are there: {collector.said} {uplink.said}")
        machine.close()
    assert database.ask("SELECT records, missing FROM fleet.machines") == [(expected, 0)]


def test_a_network_that_drops_all_is_waited_for(tmp_path: Path, database: Postgres) -> None:
    """The cut is silent; pending records are repeated, and later ones follow."""
    with nats(tmp_path) as server:
        network = Network(server.port)
        file = written(tmp_path / "mill", "mill-1", server=f"nats://127.0.0.1:{network.port}", windows="refused")
        machine = Machine(file)
        works = of_the_works(tmp_path, server, database)
        with (
            running(tmp_path / "collect.log", "fleet", "collect", works) as collector,
            running(tmp_path / "uplink.log", "uplink", file) as uplink,
        ):
            expected = machine.record(2)
            until(lambda: counted(database) == expected, f"the first are there: {collector.said} {uplink.said}")
            network.cut = True
            before, expected = expected, expected + machine.record(20)
            until(lambda: "retrying" in uplink.said, "the uplink gives the connection up")
            assert counted(database) == before
            network.cut = False
            until(lambda: counted(database) == expected, "all are there")
        machine.close()
        network.close()
    assert database.ask("SELECT records, missing FROM fleet.machines") == [(expected, 0)]
    rows = database.ask("SELECT sequence FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence")
    assert [sequence for (sequence,) in rows] == list(range(1, expected + 1))
