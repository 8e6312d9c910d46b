"""One suite, three transports: python-can's ``virtual``, the TCP hub, and a real SocketCAN interface (vcan0)."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import can
import pytest

from fdhil import config as machine_config
from fdhil.commissioning.commissioning_record import CommissioningRecord, compute_axis_digest, save_record
from fdhil.commissioning.drive_survey import survey_drive
from fdhil.commissioning.master import Master
from fdhil.config import MachineConfig
from fdhil.pipeline import AxisPipeline
from fdhil.program import load_trajectory
from fdhil.records import Notice, Outcome
from fdhil.sim import simulator_service as sim_service
from fdhil.sim.simulator_service import LOCKSTEP_HOLDING_WAIT_S, SimulatorService
from tests.bench import bench_document

PATIENCE_S = 500.0
_channel = itertools.count()


@dataclass
class Bench:
    config: MachineConfig
    service: SimulatorService
    events: queue.Queue[dict[str, Any]]
    ready: Mapping[str, Any] = field(default_factory=dict)

    def event(self, kind: str) -> dict[str, Any]:
        while True:
            event = self.events.get(timeout=PATIENCE_S)
            assert event["event"] != "error", event
            if event["event"] == kind:
                return event

    def command(self, line: str) -> None:
        self.service.execute_command(line)

    def join(self) -> can.BusABC:
        place = {k: v for k, v in self.ready["buses"]["can0"].items() if v is not None}
        return can.Bus(**place)


def sign_off(config: MachineConfig) -> None:
    for axis in config.axis:
        with Master(config, axis) as master:
            found = survey_drive(master)
        record = CommissioningRecord(
            axis=axis,
            **asdict(found.identity),
            config_digest=compute_axis_digest(config, axis),
            mapping_fingerprint=found.fingerprint,
            options=found.options,
            following_error_window_um=found.window_um,
            offset_in_feedforward=True,
            sign_test_um=10.0,
            readback_ok=True,
            watchdog="proven",
            created_utc="",
        )
        save_record(record, config.store.directory)


def take_voltage_from_sensors(bench: Bench) -> Bench:
    for axis, settings in bench.config.axis.items():
        voltage = settings.voltage.model_copy(update={"source": "modbus"})
        bench.config.axis[axis].__dict__["voltage"] = voltage
    return bench


def digested(pipeline: AxisPipeline, records: Sequence[Any]) -> list[Outcome]:
    return [o for record in records if not isinstance(record, Notice) for o in pipeline.process_record(record)]


def _virtual(document: dict[str, Any]) -> None:
    document["bus"] = {"can0": {"interface": "virtual", "channel": f"bench-{next(_channel)}"}}


def _hub(document: dict[str, Any]) -> None:
    document["bus"] = {"can0": {"interface": "socketcand"}}


def _socketcan(document: dict[str, Any]) -> None:
    document["bus"] = {"can0": {"interface": "socketcan", "channel": "vcan0"}}


TRANSPORTS: Mapping[str, Callable[[dict[str, Any]], None]] = {
    "virtual": _virtual,
    "hub": _hub,
    "socketcan": _socketcan,
}


@pytest.fixture(params=["virtual", "hub", pytest.param("socketcan", marks=pytest.mark.socketcan)])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def short_settling_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.drive_survey.LISTEN_S", 0.3)
    monkeypatch.setattr("fdhil.commissioning.transmit.LOOK_S", 0.05)
    monkeypatch.setattr("fdhil.commissioning.commissioning_steps.SETTLE_CYCLES", 150)
    monkeypatch.setattr("fdhil.commissioning.commissioning_steps.AVERAGE_CYCLES", 80)
    monkeypatch.setattr(
        "fdhil.commissioning.commissioning_steps.MOST_RAMPS", 1000
    )  # a slow host sees few of them begin
    monkeypatch.setattr("fdhil.commissioning.watchdog.STARVE_TIMEOUT_S", 15.0)  # a slow host's drives live slower


@pytest.fixture
def sections() -> dict[str, Any]:
    return {"sim": {"pace": "lockstep", "modbus": False}}


@pytest.fixture
def bench(transport: str, sections: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(sim_service, "LOCKSTEP_WAIT_S", LOCKSTEP_HOLDING_WAIT_S)
    document = bench_document() | sections
    TRANSPORTS[transport](document)
    events: queue.Queue[dict[str, Any]] = queue.Queue()
    config = machine_config.parse_config(document, folder=tmp_path)
    service = SimulatorService(config, events.put, load_trajectory)
    thread = threading.Thread(target=service.run, name="twin")
    thread.start()
    bench = Bench(config, service, events)
    try:
        bench.ready = bench.event("ready")
        for name, place in bench.ready["buses"].items():
            document["bus"][name] |= {k: v for k, v in place.items() if v is not None}
        for axis, place in bench.ready["modbus"].items():
            document["axis"][axis].setdefault("voltage", {}).update(place)
        bench.config = machine_config.parse_config(document, folder=tmp_path)
        yield bench
    finally:
        service.stop()
        thread.join()
