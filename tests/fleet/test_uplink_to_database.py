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

from fdhil.store.window_file import read_window
from studies.fleet_cut import Network
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import PATIENCE_S, NatsServer, Postgres, run_nats, wait_until
from tests.store.sample_records import is_bit_identical, make_window

pytestmark = pytest.mark.debian


def count_records(database: Postgres) -> int:
    """Return the number of records in the database; 0 before its tables exist."""
    try:
        return int(database.execute_query("SELECT count(*) FROM fleet.records WHERE sequence > 0")[0][0])
    except psycopg.errors.UndefinedTable:
        return 0


def build_fleet_settings(folder: Path, server: NatsServer, database: Postgres, max_bytes: int = 1 << 26) -> Path:
    """Write the fleet server's configuration."""
    file = folder / "fleet.toml"
    file.write_text(
        f'[server]\nserver = "{server.url}"\n[stream]\nmax_bytes = {max_bytes}\n'
        f'[database]\nconnection = "{database.connection}"\n[objects]\ndirectory = "objects"\n'
    )
    return file


class CommandProcess:
    """A running fdhil command."""

    def __init__(self, log: Path, *words: object) -> None:
        self._log = log
        self._words = [str(word) for word in words]
        self.start_process()

    def start_process(self) -> None:
        with self._log.open("ab") as log:
            self._before = log.tell()
            command = [sys.executable, "-m", "fdhil", *self._words]
            self._process = subprocess.Popen(command, stdout=log, stderr=log)

    def end_process(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it once it runs, and return its exit code."""
        wait_until(lambda: self._log.stat().st_size > self._before, "it runs")
        self._process.send_signal(how)
        return self._process.wait(PATIENCE_S)

    @property
    def said(self) -> str:
        """Its output."""
        return self._log.read_text()


@contextmanager
def run_process(log: Path, *words: object) -> Iterator[CommandProcess]:
    """Run a command until the block is left; it must end on request."""
    process = CommandProcess(log, *words)
    try:
        yield process
    finally:
        code = process.end_process()
    assert code == 0, process.said


def test_records_reach_database_once_and_in_order(tmp_path: Path, database: Postgres) -> None:
    with run_nats(tmp_path) as server:
        file = write_history(tmp_path / "mill", "mill 1", server=server.url, windows="all")
        machine = RecordingMachine(file)
        works = build_fleet_settings(tmp_path, server, database)
        expected = machine.record_windows(10)
        with (
            run_process(tmp_path / "collect.log", "fleet", "collect", works) as collector,
            run_process(tmp_path / "uplink.log", "uplink", file) as uplink,
        ):
            wait_until(lambda: count_records(database) == expected, f"all are there: {collector.said} {uplink.said}")
            expected += machine.record_windows(2)
            wait_until(lambda: count_records(database) == expected, "what was added is there")
        machine.close_store()
    rows = database.execute_query(
        "SELECT sequence, axis FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence"
    )
    for axis in ("X", "Y"):
        reported = [sequence for sequence, of in rows if of == axis]
        assert reported == sorted(reported)
    assert sorted(sequence for sequence, _ in rows) == list(range(1, expected + 1))
    assert database.execute_query("SELECT machine, records, missing FROM fleet.machines") == [("mill_1", expected, 0)]
    ((name,),) = database.execute_query("SELECT window_name FROM fleet.windows WHERE axis = 'Y' AND number = 2")
    stored = read_window(tmp_path / "objects" / name[:2] / f"{name}.parquet")
    assert is_bit_identical(stored, make_window(axis="Y", start_tick=1000, seed=1000))


def test_kill_at_any_point_loses_and_duplicates_nothing(tmp_path: Path, database: Postgres) -> None:
    """Uplink, server, database and both collectors are killed in turn while two machines keep recording."""
    with run_nats(tmp_path) as server:
        works = build_fleet_settings(tmp_path, server, database)
        files = [
            write_history(tmp_path / name, name, server=server.url, windows="refused") for name in ("mill-1", "mill-2")
        ]
        machines = [RecordingMachine(file) for file in files]
        uplinks = [CommandProcess(tmp_path / f"uplink-{k}.log", "uplink", file) for k, file in enumerate(files)]
        collectors = [CommandProcess(tmp_path / f"collect-{k}.log", "fleet", "collect", works) for k in range(2)]
        expected = 0
        for victim in (uplinks[0], collectors[0], "nats", uplinks[1], "postgres", collectors[1]):
            before = count_records(database)
            expected += sum(machine.record_windows(20) for machine in machines)
            wait_until(lambda before=before: count_records(database) > before, "some of it is there")  # type: ignore[misc]
            if victim == "nats":
                server.stop_server(signal.SIGKILL)
                server.start_server()
            elif victim == "postgres":
                database.stop_server(signal.SIGQUIT)
                database.start_server()
            else:
                assert isinstance(victim, CommandProcess)
                victim.end_process(signal.SIGKILL)
                victim.start_process()
        wait_until(lambda: count_records(database) >= expected, "all are there")
        for process in (*uplinks, *collectors):
            assert process.end_process() == 0, process.said
        for machine in machines:
            machine.close_store()
    each = expected // 2
    assert database.execute_query("SELECT machine, records, missing FROM fleet.machines ORDER BY machine") == [
        ("mill-1", each, 0), ("mill-2", each, 0),
    ]  # fmt: skip
    rows = database.execute_query(
        "SELECT machine, sequence, axis FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence"
    )
    for name in ("mill-1", "mill-2"):
        assert sorted(sequence for machine, sequence, _ in rows if machine == name) == list(range(1, each + 1))
        for axis in ("X", "Y"):
            reported = [sequence for machine, sequence, of in rows if (machine, of) == (name, axis)]
            assert reported == sorted(reported)
    assert database.execute_query("SELECT count(*) FROM fleet.refused") == [(0,)]


def test_records_stay_on_machine_when_server_is_full(tmp_path: Path, database: Postgres) -> None:
    """The stream is full without a collector; the rest follows when there is room again."""
    with run_nats(tmp_path) as server:
        file = write_history(tmp_path / "mill", "mill-1", server=server.url, windows="all")
        works = build_fleet_settings(tmp_path, server, database, max_bytes=1 << 17)
        with run_process(tmp_path / "first.log", "fleet", "collect", works) as collector:  # makes the stream
            wait_until(lambda: "connected to the server and the database" in collector.said, "the stream is there")
        machine = RecordingMachine(file)
        expected = machine.record_windows(16)
        log = tmp_path / "uplink.log"
        with run_process(log, "uplink", file) as uplink:
            wait_until(lambda: "maximum bytes exceeded" in uplink.said, "the stream is full")
            with run_process(tmp_path / "second.log", "fleet", "collect", works) as collector:
                wait_until(
                    lambda: count_records(database) == expected, f"all are there: {collector.said} {uplink.said}"
                )
        machine.close_store()
    assert database.execute_query("SELECT records, missing FROM fleet.machines") == [(expected, 0)]


def test_uplink_waits_for_dropped_network(tmp_path: Path, database: Postgres) -> None:
    """The cut is silent; pending records are repeated, and later ones follow."""
    with run_nats(tmp_path) as server:
        network = Network(server.port)
        file = write_history(tmp_path / "mill", "mill-1", server=f"nats://127.0.0.1:{network.port}", windows="refused")
        machine = RecordingMachine(file)
        works = build_fleet_settings(tmp_path, server, database)
        with (
            run_process(tmp_path / "collect.log", "fleet", "collect", works) as collector,
            run_process(tmp_path / "uplink.log", "uplink", file) as uplink,
        ):
            expected = machine.record_windows(2)
            wait_until(
                lambda: count_records(database) == expected, f"the first are there: {collector.said} {uplink.said}"
            )
            network.cut = True
            before, expected = expected, expected + machine.record_windows(20)
            wait_until(lambda: "retrying" in uplink.said, "the uplink gives the connection up")
            assert count_records(database) == before
            network.cut = False
            wait_until(lambda: count_records(database) == expected, "all are there")
        machine.close_store()
        network.close()
    assert database.execute_query("SELECT records, missing FROM fleet.machines") == [(expected, 0)]
    rows = database.execute_query("SELECT sequence FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence")
    assert [sequence for (sequence,) in rows] == list(range(1, expected + 1))
