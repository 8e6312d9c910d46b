"""``fdhil sim`` as a process, joined by stock clients: python-can, the canopen library, pymodbus."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import can
import canopen
import numpy as np
import pytest
from pymodbus.client import ModbusTcpClient

from fdhil import config
from fdhil.cli.main import cli, run_safely
from fdhil.program import load_trajectory
from fdhil.sim import fault_script
from fdhil.sim.simulator_service import LOCKSTEP_WAIT_S, SimulatorService
from tests.sim.bench_simulator import build_corner_rows
from tests.sim.hub_thread import receive_frames
from tests.sim.simulator_process import PATIENCE_S, SimulatorProcess, write_config

PER_MM = 65536 / 20


def write_demand(path: Path, rows_mm: np.ndarray) -> Path:
    lines = [f"{k * 0.001:.6f},{x:.9f},{y:.9f}" for k, (x, y) in enumerate(rows_mm)]
    path.write_text("time_s,X_mm,Y_mm\n" + "\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory, processes: None) -> Iterator[SimulatorProcess]:
    """One process without NC; tests leave its drives in pre-operational."""
    with SimulatorProcess(write_config(tmp_path_factory.mktemp("twin"))) as process:
        yield process


@pytest.fixture
def bus(simulator: SimulatorProcess) -> Iterator[can.BusABC]:
    bus = simulator.join_bus()
    yield bus
    bus.send(can.Message(arbitration_id=0, data=b"\x81\0", is_extended_id=False))
    bus.shutdown()


@pytest.mark.usefixtures("processes")
def test_ready_event_describes_how_to_join(simulator: SimulatorProcess) -> None:
    ready = simulator.ready
    assert ready["buses"]["can0"].keys() == {"interface", "channel", "host", "port"}
    assert ready["modbus"]["Y"].keys() == {"host", "port", "unit"}
    x = ready["drives"]["X"]
    assert (x["node_id"], x["increments_per_mm"], x["sync_counter"]) == (1, PER_MM, 0)
    assert Path(x["eds"]).is_file()
    assert [pdo["cob_id"] for pdo in x["tpdo"]] == [0x181, 0x281, 0x381, 0x481]
    assert [pdo["cob_id"] for pdo in x["rpdo"]][:2] == [0x201, 0x301]
    assert x["tpdo"][0]["entries"][0] == [0x6064, 0, 32, "mm", 1 / PER_MM]
    assert 0.7 < ready["bus_load"]["can0"] < 1.0 < ready["bus_load_worst"]["can0"] < 1.1


@pytest.mark.usefixtures("real_time")
def test_canopen_library_finds_configures_and_reads_drives(simulator: SimulatorProcess, bus: can.BusABC) -> None:
    network = canopen.Network(bus)
    network.connect()
    try:
        node = network.add_node(1, simulator.ready["drives"]["X"]["eds"])
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        assert node.nmt.wait_for_heartbeat(100) == "PRE-OPERATIONAL"
        assert node.sdo[0x1000].raw == 0x00020192
        assert node.sdo["Modes of operation"].raw == 0
        node.sdo["Modes of operation"].raw = 8
        assert node.sdo["Modes of operation"].raw == 8
        with pytest.raises(canopen.SdoAbortedError) as abort:
            node.sdo.upload(0x5FFF, 0)
        assert abort.value.code == 0x06020000
        node.nmt.state = "OPERATIONAL"
        while node.nmt.wait_for_heartbeat(100) != "OPERATIONAL":
            pass  # sent before the drive received the command
    finally:
        assert network.notifier is not None
        network.notifier.stop()


def test_foreign_master_takes_over_with_stock_client(bus: can.BusABC) -> None:
    def send_frame(can_id: int, data: bytes) -> None:
        bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def wait_for_answer(can_id: int) -> bytes:
        for got, data in iter(lambda: receive_frames(bus, 1)[0], None):
            if got == can_id:
                return data
        raise AssertionError("unreachable")

    send_frame(0x000, b"\1\1")
    send_frame(0x601, bytes.fromhex("2f60600008000000"))
    assert wait_for_answer(0x581)[0] == 0x60
    for word in (0x06, 0x07, 0x0F):
        send_frame(0x201, struct.pack("<Hi", word, 0))
        send_frame(0x080, b"")
        status = wait_for_answer(0x281)
    assert status[0] & 0x6F == 0x27
    for k in range(300):
        send_frame(0x201, struct.pack("<Hi", 0x0F, min(100 * k, 20000)))
        send_frame(0x080, b"")
        position = wait_for_answer(0x181)
        wait_for_answer(0x281)
    assert struct.unpack("<i", position[:4])[0] == pytest.approx(20000, abs=50)


def test_modbus_client_reads_sensor(simulator: SimulatorProcess) -> None:
    place = simulator.ready["modbus"]["X"]
    with ModbusTcpClient(place["host"], port=place["port"], timeout=60) as client:
        registers = client.read_input_registers(0, count=10, device_id=place["unit"]).registers
        assert struct.unpack(">f", struct.pack(">2H", *registers[4:6])) == (1000.0,)
        assert client.read_holding_registers(500, count=1).exception_code == 2


def test_invalid_panel_commands_are_events(simulator: SimulatorProcess, tmp_path: Path) -> None:
    simulator.send_command("dance")
    assert "unknown panel command 'dance'" in simulator.wait_for_event("error")["text"]
    simulator.send_command("play", file=str(tmp_path / "missing.csv"))
    assert "missing.csv" in simulator.wait_for_event("error")["text"]


@pytest.mark.usefixtures("real_time")
def test_nc_plays_in_real_time_without_losing_sync(simulator: SimulatorProcess, tmp_path: Path) -> None:
    demand = write_demand(tmp_path / "corner.csv", build_corner_rows())
    trace = tmp_path / "trace.csv"
    with simulator.join_bus() as bus:
        simulator.send_command("nc", on=True)
        simulator.wait_for_event("nc")
        simulator.send_command("trace", file=str(trace))
        simulator.send_command("play", file=str(demand))
        frames = receive_frames(bus, 5000, timeout_s=PATIENCE_S)
    finished = simulator.wait_for_event("finished")
    simulator.send_command("nc", on=False)
    assert simulator.wait_for_event("nc")["on"] is False
    counters = [data[0] for can_id, data in frames if can_id == 0x80]
    assert len(counters) > 500
    assert all(after == before % 240 + 1 for before, after in pairwise(counters))
    assert finished["rows"] == len(build_corner_rows())
    table = np.genfromtxt(trace, delimiter=",", names=True)
    assert len(table) == len(build_corner_rows()) + 300
    assert np.abs(table["Y_table_mm"] - table["Y_reference_mm"]).max() < 0.3


@pytest.mark.usefixtures("processes")
def test_two_lockstep_runs_are_bit_identical(tmp_path: Path) -> None:
    """One in a separate process, one in this process."""
    path = write_config(tmp_path, 'pace = "lockstep"')
    demand = write_demand(tmp_path / "corner.csv", build_corner_rows() + 2.0)
    script = _build_load_torque_script(tmp_path)
    with SimulatorProcess(path, "--demand", demand, "--trace", tmp_path / "process.csv", "--faults", script) as twin:
        _play_in_process(path, demand, tmp_path / "here.csv", script)
        assert twin.wait_for_event("finished")["late_rpdo"] == {"X": 0, "Y": 0}
    first, second = ((tmp_path / name).read_bytes() for name in ("process.csv", "here.csv"))
    assert first == second
    assert first.count(b"\n") == 1 + len(build_corner_rows()) + 300


def _play_in_process(path: Path, demand: Path, trace: Path, script: Path) -> None:
    def record_event(event: dict[str, object]) -> None:
        if event["event"] == "finished":
            service.stop()

    service = SimulatorService(
        config.load_config(path), record_event, load_trajectory, faults=fault_script.load_script(script, ("X", "Y"))
    )
    service.run(demand, trace)


def _build_load_torque_script(folder: Path) -> Path:
    script = folder / "faults.toml"
    script.write_text("[[fault]]\nat_row = 100\naxis = 'Y'\nfault = 'load_torque'\nvalue = 3.0\nduration_s = 0.1\n")
    return script


@pytest.mark.usefixtures("processes")
def test_lockstep_waits_for_a_client_that_answers_every_sync(tmp_path: Path) -> None:
    """No offset frame is late, however slow the client is."""
    path = write_config(tmp_path, 'pace = "lockstep"\nlockstep_rpdo = ["X:2"]')
    demand = write_demand(tmp_path / "corner.csv", build_corner_rows())
    with SimulatorProcess(path) as twin, twin.join_bus() as bus:
        twin.send_command("nc", on=True)
        twin.wait_for_event("nc")
        for _ in range(200):  # the NC stands: what came before the first answer is worked off before it moves
            answer_demand(bus)
        twin.send_command("trace", file=str(tmp_path / "trace.csv"))
        twin.send_command("play", file=str(demand))
        while not twin.has_happened("finished"):
            answer_demand(bus)
        finished = twin.events[-1]
        assert finished["late_rpdo"] == {"X": 0, "Y": 0}
        assert finished["trace"] == str(tmp_path / "trace.csv")
        twin.close_panel()
        while receive_frames(bus, 1)[0][0] != 0x701:  # it lives on without a panel, and its heartbeat with it
            pass
        assert twin.end_process(signal.SIGINT) == (0, "")
        first = np.genfromtxt(tmp_path / "trace.csv", delimiter=",", names=True)
    increments = np.round(first["X_reference_mm"] * PER_MM).astype(int)
    expected = (99 - increments // 1000) / PER_MM * 1e3
    assert first["X_offset_um"][3:] == pytest.approx(expected[3:], abs=1e-5)


@pytest.mark.usefixtures("processes")
def test_machine_with_dead_operator_serves_until_bus_is_left(tmp_path: Path) -> None:
    with SimulatorProcess(write_config(tmp_path)) as twin:
        with twin.join_bus() as bus:
            twin.send_signal(signal.SIGUSR1)
            for _ in range(3):
                while receive_frames(bus, 1)[0][0] != 0x701:  # it lives on, and its heartbeat with it
                    pass
        assert twin.wait_for_end() == (0, "")


@pytest.mark.usefixtures("processes")
def test_lockstep_waits_for_a_client_whose_offset_is_zero_while_a_program_runs(tmp_path: Path) -> None:
    """Also while the delayed guard's offset is still 0."""
    path = write_config(tmp_path, 'pace = "lockstep"\nlockstep_rpdo = ["X:2"]')
    demand = write_demand(tmp_path / "corner.csv", build_corner_rows())
    with SimulatorProcess(path) as twin, twin.join_bus() as bus:
        twin.send_command("nc", on=True)
        twin.wait_for_event("nc")
        for _ in range(200):
            answer_demand(bus, 0.0)
        twin.send_command("play", file=str(demand))
        while not twin.has_happened("playing"):
            answer_demand(bus, 0.0)
        for _ in range(100):
            answer_demand(bus, 0.0)
        time.sleep(LOCKSTEP_WAIT_S + 1.0)
        while not twin.has_happened("finished"):
            answer_demand(bus, 0.0)
        assert twin.events[-1]["late_rpdo"] == {"X": 0, "Y": 0}


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_silent_pipe_can_be_interrupted(number: signal.Signals, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    command = [
        sys.executable,
        "-m",
        "fdhil",
        "sim",
        str(write_config(tmp_path)),
        "--demand",
        str(tmp_path / "pipe.csv"),
    ]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while not _has_signal_handler(process.pid, signal.SIGTERM):
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(0.2)  # it waits for the pipe by now; were it not so far, it would end all the same
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == 130
        assert process.stderr is not None
        assert process.stderr.read().strip() == b"fdhil: stopped by the operator"


def _has_signal_handler(pid: int, number: signal.Signals) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def answer_demand(bus: can.BusABC, gain: float = 1.0) -> None:
    """Answer the next demand of X like a correction: by a function of it, zero only for a gain of 0."""
    while (message := bus.recv(100)) is not None and message.arbitration_id != 0x201:
        pass
    assert message is not None
    offset = round(gain * (99 - struct.unpack("<i", message.data[2:6])[0] // 1000))
    bus.send(can.Message(arbitration_id=0x301, data=struct.pack("<i", offset), is_extended_id=False))


# -- what cannot be started


@pytest.fixture
def failing_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Run the command in this process; return its exit code and its single message."""

    def run_command(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["fdhil", "sim", *map(str, arguments)])
        code = run_safely(cli)
        out, err = capsys.readouterr()
        assert out == ""
        return code, err

    return run_command


def test_port_in_use_exits_3_with_one_sentence(failing_command: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        code, text = failing_command(write_config(tmp_path, bus=f"port = {port}"))
        assert code == 3
        assert f"bus can0: TCP port {port}" in text
        assert text.count("\n") == 1
        code, text = failing_command(write_config(tmp_path, axes="X", voltage=f"port = {port}"))
        assert code == 3
        assert f"voltage sensor X: TCP port {port}" in text
        assert text.count("\n") == 1


def test_unknown_bus_exits_3(failing_command: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    code, text = failing_command(write_config(tmp_path, bus='interface = "socketcan"\nchannel = "nocan7"'))
    assert code == 3
    assert "socketcan nocan7 cannot be opened" in text
    assert text.count("\n") == 1


def test_invalid_scripts_and_options_exit_2(failing_command: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    path = write_config(tmp_path)
    script = tmp_path / "faults.toml"
    script.write_text("[[fault]]\nfault = 'meteor'\n")
    code, text = failing_command(path, "--faults", script)
    assert code == 2
    assert "unknown fault 'meteor'" in text
    code, text = failing_command(path, "--demand", "a.csv", "--program", "b.ngc")
    assert code == 2
    assert "exclude each other" in text
    code, text = failing_command(tmp_path / "missing.toml")
    assert code == 2
    assert "cannot be read" in text
