"""The parts of a fleet as processes that are killed and started again: uplinks, collectors, server and database.

``python -m studies.fleet_parts FILE...`` runs the uplinks of many machines in one process, each as ``fdhil uplink``.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psycopg

from fdhil import config as machine_config
from fdhil.fleet import record_uplink
from tests.fleet.servers import NatsServer, Postgres

Part = tuple[Callable[[], None], Callable[[], None]]  # how it is killed, and started again


class Process:
    """A command in a process of its own."""

    def __init__(self, log: Path, *words: object) -> None:
        self.log = log
        self._words = [sys.executable, "-m", *map(str, words)]
        self.start()

    def start(self) -> None:
        """Start it."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(self._words, stdout=log, stderr=log)

    def kill(self, how: signal.Signals = signal.SIGKILL) -> None:
        """End it."""
        self._process.send_signal(how)
        self._process.wait()

    @property
    def processor_s(self) -> float:
        """The processor's time that it has had since it was started."""
        return measure_processor_s(self._process.pid)


def measure_processor_s(pid: int) -> float:
    """Return the processor's time that a process has had, and its children that have ended."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")


def measure_database_s(database: Postgres) -> float:
    """Return the processor's time that PostgreSQL has had."""
    assert database._process is not None
    first = database._process.pid
    children = Path(f"/proc/{first}/task/{first}/children").read_text().split()
    return sum(measure_processor_s(pid) for pid in (first, *map(int, children)))


def kill_database(database: Postgres) -> None:
    """Kill PostgreSQL and all that it has started, with SIGKILL."""
    assert database._process is not None
    reported = subprocess.run(["pgrep", "-P", str(database._process.pid)], capture_output=True, text=True, check=False)
    database._process.send_signal(signal.SIGSTOP)  # else it would start some again
    for pid in [*map(int, reported.stdout.split()), database._process.pid]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    database._process.wait()
    database._process = None


def list_killable_parts(
    uplinks: Sequence[Process], collectors: Sequence[Process], server: NatsServer, database: Postgres
) -> dict[str, Part]:
    """Return what can be killed."""
    named = {f"uplinks {k + 1}": each for k, each in enumerate(uplinks)}
    named |= {f"collector {k + 1}": each for k, each in enumerate(collectors)}
    parts: dict[str, Part] = {name: (each.kill, each.start) for name, each in named.items()}
    parts["nats-server"] = (lambda: server.stop_server(signal.SIGKILL), server.start_server)
    parts["PostgreSQL"] = (lambda: kill_database(database), database.start_server)
    return parts


def count_records(database: Postgres) -> int:
    """Return how many records of machines the database has; 0 while it has no tables or does not answer."""
    try:
        return int(database.execute_query("SELECT coalesce(sum(records), 0) FROM fleet.heard")[0][0])
    except psycopg.Error:
        return 0


def wait_for(holds: Callable[[], bool], what: str, patience_s: float = 1200.0) -> float:
    """Wait for a condition, and return how long it took."""
    begin_s = time.monotonic()
    while not holds():
        if time.monotonic() - begin_s > patience_s:
            raise TimeoutError(f"waited in vain until {what}")
        time.sleep(0.1)
    return time.monotonic() - begin_s


async def _send(files: Sequence[str]) -> None:
    configs = [machine_config.load_config(Path(file)) for file in files]
    await asyncio.gather(*(record_uplink.send_records(config, lambda _: None) for config in configs))


if __name__ == "__main__":
    asyncio.run(_send(sys.argv[1:]))
