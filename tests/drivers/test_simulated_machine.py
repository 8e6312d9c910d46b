"""The drivers against the simulated machine in its own process, over its hub and its Modbus sensors."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.config import MachineConfig
from fdhil.drivers import MachineSource, Record, open_machine
from fdhil.errors import ConnectError, DriveFault, ProtocolError
from fdhil.records import AxisSamples, MoveEvent, MoveKind, Notice, Temperature, VoltageSamples
from tests.bench import bench_toml
from tests.daemon.machine_rig import patient
from tests.drivers.frame_builder import build_machine_config

HELD_UP = {"SyncLost", "SyncJitter", "HeartbeatLost", "BusSilent"}  # what is true of a machine whose process sleeps


class SimulatorProcess:
    """The process, its ready event and its panel."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "bench.toml").write_text(bench_toml("X", corrected=False))
        command = [sys.executable, "-m", "fdhil.cli.main", "sim", str(folder / "bench.toml"), "--json"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=folder)
        self.ready = self.read_event("ready")

    def read_event(self, name: str) -> dict[str, Any]:
        assert self.process.stdout is not None
        while True:
            line = self.process.stdout.readline()
            assert line, "the simulated machine ended"
            event: dict[str, Any] = json.loads(line)
            assert event["event"] != "error", event
            if event["event"] == name:
                return event

    def send_command(self, **command: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def build_config(self, **voltage: Any) -> MachineConfig:
        bus = self.ready["buses"]["can0"]
        sensor = self.ready["modbus"]["X"]
        return build_machine_config(
            folder=self.folder,
            bus={"interface": "socketcand", "host": bus["host"], "port": bus["port"]},
            voltage={"host": sensor["host"], "port": sensor["port"], "unit": sensor["unit"], **voltage},
            guard={"clock": "sync"},  # by SYNC: the machine is a process that may be held up
        )

    def close(self) -> None:
        if self.process.poll() is None:
            self.send_command(command="quit")
            self.process.communicate()


@pytest.fixture(scope="module")
def simulator_process(tmp_path_factory: pytest.TempPathFactory, processes: None) -> Iterator[SimulatorProcess]:
    running = SimulatorProcess(tmp_path_factory.mktemp("twin"))
    yield running
    running.close()


def run_rapid(folder: Path) -> Path:
    """A demand: 200 mm at 500 mm/s and 4 m/s2, then rest."""
    t = np.arange(0, 1.2, 0.001)
    speed = np.clip(np.minimum(t * 4000, (0.525 - t) * 4000), 0, 500)
    position = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * 0.001
    path = folder / "demand.csv"
    path.write_text("time_s,X_mm\n" + "".join(f"{a:.3f},{b:.6f}\n" for a, b in zip(t, position, strict=True)))
    return path


async def collect_records(
    source: MachineSource, until: Callable[[list[Record]], bool], seconds: float = 300
) -> list[Record]:
    """Return the records of a source from now on, up to the one that meets the condition."""
    records: list[Record] = []
    enough = asyncio.Event()

    def take(record: Record) -> None:
        if not enough.is_set():
            records.append(record)
            if until(records):
                enough.set()

    running = asyncio.create_task(source.run(take))
    async with asyncio.timeout(seconds):
        await enough.wait()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return records


def has_moved(records: list[Record]) -> bool:
    return any(isinstance(r, MoveEvent) and r.kind is MoveKind.REST for r in records)


@pytest.mark.usefixtures("processes")
def test_simulated_drive_is_commissioned(simulator_process: SimulatorProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.drive_survey.LISTEN_S", 0.3)
    monkeypatch.setattr("fdhil.commissioning.commissioning_steps.SETTLE_CYCLES", 150)
    monkeypatch.setattr("fdhil.commissioning.commissioning_steps.AVERAGE_CYCLES", 80)
    with patient():
        record = commission_axis(simulator_process.build_config(), "X")
    assert record.offset_in_feedforward is True
    assert record.watchdog == "proven"
    assert record.sign_test_um == pytest.approx(10, abs=3)


@pytest.mark.usefixtures("real_time")
def test_wrong_window_setting_is_refused(simulator_process: SimulatorProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.drive_survey.LISTEN_S", 0.3)
    settings = simulator_process.build_config()
    wrong = settings.axis["X"].model_copy(
        update={"drive": settings.axis["X"].drive.model_copy(update={"increments_per_rev": 4096})}
    )
    with patient(), pytest.raises(DriveFault, match="65536 position increments per motor revolution"):
        commission_axis(settings.model_copy(update={"axis": {"X": wrong}}), "X")


@pytest.mark.usefixtures("real_time")
async def test_rapid_is_recorded_completely(simulator_process: SimulatorProcess) -> None:
    simulator_process.send_command(command="nc", on=True)
    trace = simulator_process.folder / "trace.csv"
    async with open_machine(simulator_process.build_config()) as source:
        await collect_records(source, lambda rs: any(isinstance(r, AxisSamples) and r.tick.size for r in rs))
        simulator_process.send_command(command="trace", file=str(trace))
        simulator_process.send_command(command="play", file=str(run_rapid(simulator_process.folder)))
        records = await collect_records(source, has_moved)
        counters = source.get_counters()
    await asyncio.to_thread(simulator_process.read_event, "finished")
    assert counters["lost"] == 0
    assert {r.code for r in records if isinstance(r, Notice)} <= HELD_UP
    blocks = [r for r in records if isinstance(r, AxisSamples)]
    tick = np.concatenate([b.tick for b in blocks])
    demand = np.concatenate([b.demand_mm for b in blocks])
    position = np.concatenate([b.position_mm for b in blocks])
    assert np.all(np.diff(tick) == 1)
    (start,) = [r.tick for r in records if isinstance(r, MoveEvent) and r.kind is MoveKind.RAPID]
    truth = np.genfromtxt(trace, delimiter=",", names=True)
    # the rapid to the demand's start may come first: find the trace's rows by the demand itself
    first = int(np.argmin(np.abs(tick - start)))
    moving = int(np.argmax(truth["X_reference_mm"] > 0.005))
    begin = first + int(np.argmax(demand[first:] > 0.005)) - moving
    n = min(truth.size, demand.size - begin) - 1
    increment = 20 / 65536
    np.testing.assert_allclose(demand[begin : begin + n], truth["X_reference_mm"][:n], atol=0.6 * increment)
    np.testing.assert_allclose(position[begin : begin + n], truth["X_table_mm"][:n], atol=1.1 * increment)


async def test_active_nc_prevents_commissioning(
    simulator_process: SimulatorProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.commissioning.drive_survey.LISTEN_S", 60.0)  # it ends with the first SYNC
    simulator_process.send_command(command="nc", on=True)
    with pytest.raises(ProtocolError, match="an NC is sending"):
        await asyncio.to_thread(commission_axis, simulator_process.build_config(), "X")


async def test_voltage_sensor_is_read_and_its_loss_reported(simulator_process: SimulatorProcess) -> None:
    simulator_process.send_command(command="nc", on=True)
    async with open_machine(simulator_process.build_config(source="modbus", timeout_s=0.3)) as source:
        records = await collect_records(source, lambda rs: sum(isinstance(r, VoltageSamples) for r in rs) >= 8)
        assert any(isinstance(r, Temperature) for r in records)
        assert all(r.voltage_v is None for r in records if isinstance(r, AxisSamples))
        simulator_process.send_command(command="fault", axis="X", fault="sensor_silent")
        await collect_records(source, lambda rs: "ModbusTimeout" in {r.code for r in rs if isinstance(r, Notice)})


async def test_switched_off_machine_is_reported_and_not_fatal(simulator_process: SimulatorProcess) -> None:
    """Must be the last test: it ends the process that the others share."""
    simulator_process.send_command(command="nc", on=True)
    async with open_machine(simulator_process.build_config()) as source:
        await collect_records(source, lambda rs: any(isinstance(r, AxisSamples) for r in rs))
        await asyncio.to_thread(simulator_process.close)
        records = await collect_records(source, lambda rs: "BusDown" in {r.code for r in rs if isinstance(r, Notice)})
    assert isinstance(records[-1], Notice)
    assert "the CAN hub ended the connection" in records[-1].text
    with pytest.raises(ConnectError, match="cannot be reached"):
        async with open_machine(simulator_process.build_config()):
            pass
