"""Masters by others run the simulated drive: the daemon's readings are right, and it sends nothing."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.drivers import Record, open_machine
from fdhil.records import AxisSamples, Notice
from tests.daemon.machine_rig import fdhil
from tests.foreign.peers import ForeignProcess
from tests.sim.simulator_process import SimulatorProcess, write_config

pytestmark = pytest.mark.usefixtures("processes")

PERIOD_MS = 5
MAKES = [pytest.param("master.js", marks=pytest.mark.debian), "python_master.py"]


@pytest.fixture
def simulator_process(tmp_path: Path) -> Iterator[tuple[SimulatorProcess, Path]]:
    """A simulated drive without an NC, and the configuration of the machine that listens to it."""
    path = write_config(tmp_path, bus='interface = "socketcand"\nport = 0', axes="X", sim="nc = false")
    text = path.read_text().replace("sync_period_s = 0.001", f"sync_period_s = {PERIOD_MS / 1e3}")
    path.write_text('[guard]\nclock = "sync"\n' + text)  # time is the SYNC count
    with SimulatorProcess(path) as running:
        path.write_text(path.read_text().replace("port = 0", f"port = {running.bus_settings['port']}", 1))
        yield running, path


def start_master(make: str, twin: SimulatorProcess) -> ForeignProcess:
    """SYNC with a counter up to 10, where the master has a counter."""
    settings = {"node": twin.ready["drives"]["X"]["node_id"], "own_node": 100, "period_ms": PERIOD_MS, "overflow": 10}
    return ForeignProcess(make, twin.bus_settings, **settings)


@pytest.mark.parametrize("make", MAKES)
async def test_drive_run_by_a_foreign_master_is_sampled(
    make: str, simulator_process: tuple[SimulatorProcess, Path]
) -> None:
    process, path = simulator_process
    records, lost = await collect_samples(make, process, path)
    codes = {record.code for record in records if isinstance(record, Notice)}
    assert not codes & {"SyncCollision", "ForeignProducer", "DemandMismatch", "PdoLength", "PdoMissing"}
    assert set(lost) == {lost[0]}
    enabled = [record for record in records if isinstance(record, AxisSamples) and record.tick.size]
    assert int(enabled[-1].statusword[-1]) & 0x6F == 0x27


async def collect_samples(make: str, process: SimulatorProcess, path: Path) -> tuple[list[Record], list[int]]:
    """Let a master run the drive until 300 samples came; return all records, and what was lost.

    That is counted from the hundredth sample on: a counter that does not go up to 240 is known from its second turn.
    """
    records: list[Record] = []
    lost: list[int] = []
    enough = asyncio.Event()

    def take(record: Record) -> None:
        records.append(record)
        samples = sum(each.tick.size for each in records if isinstance(each, AxisSamples))
        if samples >= 100:
            counters = source.get_counters()
            lost.append(sum(counters[f"can0.{name}"] for name in ("sync_missed", "pdo_lost", "pdo_ambiguous")))
        if samples >= 300:
            enough.set()

    async with open_machine(machine_config.load_config(path)) as source:
        running = asyncio.create_task(source.run(take))
        with start_master(make, process) as nc:
            identity = await asyncio.to_thread(nc.event, "identity")
            assert (identity["device_type"] & 0xFFFF, identity["name"]) == (402, "fdhil twin drive")
            assert identity.get("by_block", identity["name"]) == identity["name"]
            await asyncio.to_thread(nc.event, "enabled")
            await asyncio.wait_for(enough.wait(), 300)
        running.cancel()
    return records, lost


@pytest.mark.parametrize("make", MAKES)
def test_no_request_is_sent_next_to_a_foreign_master(
    make: str,
    simulator_process: tuple[SimulatorProcess, Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fdhil.commissioning.drive_survey.LISTEN_S", 60.0)  # it ends with the master's first frame
    process, path = simulator_process
    with start_master(make, process) as nc, process.join_bus() as bus:
        nc.event("enabled")
        while bus.recv(0) is not None:
            pass  # what the master itself asked
        code, out, _ = fdhil("scan", path, "--json", capsys=capsys)
        (found,) = json.loads(out)["buses"]
        assert (code, found["master"], [node["answers"] for node in found["nodes"]]) == (0, "SYNC", [None])
        _, out, _ = fdhil("check", path, "--json", capsys=capsys)
        points = {point["point"]: point["state"] for point in json.loads(out)["points"]}
        assert points["TPDO1"] == points["TPDO2"] == points["RPDO1"] == points["drive"] == "ok"
        assert points["identity"] == points["device"] == "not compared"
        code, _, err = fdhil("commission", path, "--yes", capsys=capsys)
        assert code == 3
        assert "an NC is sending SYNC or set-points" in err
        received = {message.arbitration_id for message in iter(lambda: bus.recv(0), None)}
        assert not {can_id for can_id in received if can_id & 0x780 in (0x580, 0x600)}
