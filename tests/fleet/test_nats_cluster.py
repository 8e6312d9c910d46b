"""Three replicated NATS servers: killing the leader loses no acknowledged message."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from nats.aio.client import Client

from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import NatsServer, Postgres, wait_until
from tests.fleet.test_uplink_to_database import count_records, run_process
from tests.free_ports import find_free_port

pytestmark = pytest.mark.debian


def start_cluster(folder: Path) -> list[NatsServer]:
    ports = [find_free_port() for _ in range(3)]
    routes = ", ".join(f"nats-route://127.0.0.1:{port}" for port in ports)
    servers = []
    for k, port in enumerate(ports):
        place = folder / f"nats-{k}"
        place.mkdir()
        clustered = f"cluster {{ name: works, listen: '127.0.0.1:{port}', routes: [{routes}] }}\n"
        servers.append(NatsServer(place, f"server_name: n{k}\n{clustered}"))
    return servers


async def find_leader(url: str) -> str:
    client = Client()
    await client.connect(url)
    try:
        answer = await client.request("$JS.API.STREAM.INFO.fdhil", b"", timeout=60)
        return str(json.loads(answer.data)["cluster"]["leader"])
    finally:
        await client.close()


async def test_killed_leader_loses_no_record(tmp_path: Path, database: Postgres) -> None:
    servers = start_cluster(tmp_path)
    together = ",".join(server.url for server in servers)
    works = tmp_path / "fleet.toml"
    works.write_text(
        f'[server]\nserver = "{together}"\n[stream]\nreplicas = 3\nmax_bytes = {1 << 26}\n'
        f'[database]\nconnection = "{database.connection}"\n'
    )
    file = write_history(tmp_path / "mill", "mill-1", server=together, windows="none")
    machine = RecordingMachine(file)
    try:
        for server in servers:
            server.start_server()
        with (
            run_process(tmp_path / "collect.log", "fleet", "collect", works) as collector,
            run_process(tmp_path / "uplink.log", "uplink", file) as uplink,
        ):
            expected = machine.record_windows(5)
            wait_until(
                lambda: count_records(database) == expected, f"the first are there: {collector.said} {uplink.said}"
            )
            first = int((await find_leader(servers[0].url))[1:])
            expected += machine.record_windows(30)
            servers[first].stop_server(signal.SIGKILL)
            expected += machine.record_windows(5)
            wait_until(lambda: count_records(database) == expected, "all are there, from two servers")
    finally:
        for server in servers:
            server.stop_server(signal.SIGKILL)
        machine.close_store()
    rows = database.execute_query("SELECT sequence FROM fleet.records WHERE sequence > 0 ORDER BY stored_at, sequence")
    assert [sequence for (sequence,) in rows] == list(range(1, expected + 1))
    assert database.execute_query("SELECT records, missing FROM fleet.machines") == [(expected, 0)]
