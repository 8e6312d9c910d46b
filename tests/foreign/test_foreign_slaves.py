"""Slaves by others: found, compared, refused for the right reason, and received beside a master."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.processes import ChildProcess
from fdhil.commissioning.scan import BusScanner
from fdhil.drivers.bus_source import BusSource
from fdhil.records import AxisSamples, Notice
from fdhil.sim.wire.tcp_hub import TcpHub
from tests.daemon.machine_rig import fdhil
from tests.foreign.peers import ForeignProcess
from tests.sim.hub_thread import join_clients, run_hub
from tests.sim.simulator_process import write_config

NODE = 5
DRIVE = {
    "node": NODE,
    "name": "foreign drive",
    "heartbeat_ms": 0,
    "identity": {"vendorId": 0x1234, "productCode": 7, "revisionNumber": 1, "serialNumber": 99},
    "objects": [
        [0x1000, "Device type", "UNSIGNED32", 0x00020192],
        [0x6041, "Statusword", "UNSIGNED16", 0x0231],
        [0x6064, "Position actual value", "INTEGER32", 1234],
        [0x606C, "Velocity actual value", "INTEGER32", -5],
    ],
    "tpdos": [
        {"cobId": 0x180, "kind": 1, "objects": [0x6064, 0x606C]},
        {"cobId": 0x280, "kind": 1, "objects": [0x6041]},
    ],
}
MODULE = {
    **DRIVE,
    "name": "foreign module",
    "heartbeat_ms": 50,
    "objects": [[0x1000, "Device type", "UNSIGNED32", 0x00030191], [0x6000, "Inputs", "UNSIGNED8", 0]],
    "tpdos": [],
}
EDS = "[DeviceInfo]\nVendorNumber=0x1234\nProductNumber=0xFFFFFFFF\n[1000]\nParameterName=Type\nDataType=7\n"
MAKES = [pytest.param("slave.js", marks=pytest.mark.debian), "python_slave.py"]


@pytest.fixture(autouse=True)
def short_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter waits than on a real machine where nothing is sent, longer ones where something is."""
    monkeypatch.setattr("fdhil.commissioning.scan.LISTEN_S", 0.4)
    monkeypatch.setattr("fdhil.commissioning.config_check.LISTEN_S", 0.4)
    monkeypatch.setattr("fdhil.commissioning.drive_survey.LISTEN_S", 0.4)
    # the slave is a process of its own, on a computer that is busy
    monkeypatch.setattr("fdhil.commissioning.scan.ANSWER_S", 2.0)
    monkeypatch.setattr(BusScanner, "find_answering_nodes", wait_for_answer)
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.RESPONSE_TIMEOUT_S", 60.0)
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.DEADLINE_S", 60.0)


def wait_for_answer(
    scanner: BusScanner, answering: Callable[[BusScanner], set[int]] = BusScanner.find_answering_nodes
) -> set[int]:
    """Scan all nodes until the drive has answered; it is certainly on the bus."""
    while not (found := answering(scanner)):
        pass
    return found


@pytest.fixture
def hub() -> Iterator[TcpHub]:
    with run_hub(TcpHub("can0")) as running:
        yield running.hub


@pytest.fixture
def machine(hub: TcpHub, tmp_path: Path) -> Path:
    """The configuration of a machine whose only drive is the slave under test."""
    return write_configuration(tmp_path, f'interface = "socketcand"\nport = {hub.port}')


def write_configuration(folder: Path, bus: str) -> Path:
    (folder / "foreign.eds").write_text(EDS)
    path = write_config(folder, bus=bus, axes="X")
    path.write_text(path.read_text() + f"[axis.X.drive]\nnode_id = {NODE}\n")
    return path


def start_slave(make: str, hub: TcpHub, settings: dict[str, Any]) -> ForeignProcess:
    return ForeignProcess(make, hub.settings, **settings)


def assert_compared(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Check that it is found, each point is compared or reported as absent, and commissioning is refused."""
    code, out, err = fdhil("scan", machine, "--json", capsys=capsys)
    assert (code, err) == (0, "")
    (node,) = json.loads(out)["buses"][0]["nodes"]
    message = node["answers"]
    assert (node["node_id"], node["axis"], message["name"]) == (NODE, "X", "foreign drive")
    assert message["identity"] == {"vendor_id": 0x1234, "product_code": 7, "revision": 1, "serial": 99}
    assert message["eds"] == {"file": "foreign.eds", "fit": "any product"}
    code, out, err = fdhil("check", machine, "--json", capsys=capsys)
    assert (code, err) == (1, "")
    points = {point["point"]: point for point in json.loads(out)["points"]}
    assert {points[name]["state"] for name in ("device", "TPDO1")} == {"ok"}
    assert points["TPDO2"]["state"] == "differs"
    for name in ("mode", "cycle", "communication lost", "stop by a ramp", "following error"):
        assert points[name]["state"] == "not compared"
    code, _, err = fdhil("commission", machine, "--yes", capsys=capsys)
    assert code == 1
    assert err.startswith("refused: drive X: RPDO1 maps nothing, but the profile has")


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("make", MAKES)
def test_foreign_drive_is_found_compared_and_refused(
    make: str, hub: TcpHub, machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with start_slave(make, hub, DRIVE) as peer:
        peer.event("ready")
        assert_compared(machine, capsys)


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("make", MAKES)
def test_foreign_io_module_is_not_a_drive(
    make: str, hub: TcpHub, machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with start_slave(make, hub, MODULE) as peer:
        peer.event("ready")
        code, out, _ = fdhil("check", machine, "--json", capsys=capsys)
        differ = [point["point"] for point in json.loads(out)["points"] if point["state"] == "differs"]
        assert (code, differ) == (1, ["device"])
        code, _, err = fdhil("commission", machine, "--yes", capsys=capsys)
        assert code == 1
        assert "it is not a CiA 402 drive: 0x1000 reports CiA 401, an I/O module" in err


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("make", MAKES)
def test_foreign_drive_without_the_profiles_tpdos_is_reported(
    make: str, hub: TcpHub, machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a master that starts it: TPDO1 is the profile's, TPDO2 is too short, the others are never sent."""
    monkeypatch.setattr("fdhil.drivers.cia402.pdo_monitor.PATIENCE_S", 0.2)
    source = BusSource("can0", machine_config.load_config(machine))
    with start_slave(make, hub, DRIVE) as peer, join_clients(hub) as (master,):
        peer.event("ready")
        source.open()
        try:
            master.send(can.Message(arbitration_id=0, data=[1, NODE], is_extended_id=False))
            out = []
            for k in range(300):
                master.send(can.Message(arbitration_id=0x80, data=[k % 240 + 1], is_extended_id=False))
                while (message := master.recv(100.0)) is not None and message.arbitration_id != 0x280 + NODE:
                    pass  # the drive has answered this SYNC
                assert message is not None
            while source.read_counters()["frames"] < 901:
                out += source.process_frames(0)
            out += source.process_frames(0)
        finally:
            source.close()
    reported = {record.code: record.text for record in out if isinstance(record, Notice)}
    assert set(reported) == {"PdoLength", "PdoMissing"}
    assert "never sent TPDO3 (385), TPDO4 (485) though SYNC runs" in reported["PdoMissing"]
    assert source.decoder.read_counters()["pdo_lost"] == 0
    assert sum(record.tick.size for record in out if isinstance(record, AxisSamples)) == 0


@pytest.mark.socketcan
def test_foreign_drive_is_found_and_compared_on_socketcan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine = write_configuration(tmp_path, 'interface = "socketcan"\nchannel = "vcan0"')
    with ForeignProcess("python_slave.py", {"interface": "socketcan", "channel": "vcan0"}, **DRIVE) as peer:
        peer.event("ready")
        assert_compared(machine, capsys)


@pytest.mark.debian
def test_daemon_waits_for_a_silent_foreign_drive(hub: TcpHub, machine: Path, tmp_path: Path) -> None:
    """With the NC off, a drive without a heartbeat is silent: the daemon waits and samples once the NC starts."""
    log = tmp_path / "daemon.log"
    with start_slave("slave.js", hub, DRIVE) as peer, join_clients(hub) as (master,):
        peer.event("ready")
        with ChildProcess("daemon", ["fdhil", "run", str(machine)], log) as daemon:
            _wait_until(daemon, lambda: "BusSilent: No frame is received on bus can0" in log.read_text())
            master.send(can.Message(arbitration_id=0, data=[1, NODE], is_extended_id=False))

            def heard_again() -> bool:
                master.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                return "BusSilent: Bus can0 is active again" in log.read_text()

            _wait_until(daemon, heard_again)
            assert daemon.stop() == 0
    assert "ready: bench, axes X; listening, sending nothing" in log.read_text()


def _wait_until(process: ChildProcess, done: Callable[[], bool]) -> None:
    while not done():
        process.check_running()
        time.sleep(0.05)
