"""``fdhil play`` with the simulator: the drives stop if the process or its bus fails."""

from __future__ import annotations

import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import can
import pytest

from fdhil import config as machine_config
from fdhil.store import audit_file
from tests.integration.conftest import sign_off
from tests.sim.simulator_process import SimulatorProcess, write_config

pytestmark = pytest.mark.usefixtures("processes")

PER_MM = 65536 / 20
HEARTBEAT_LOST = 0x8130
STROKE = "G21 G90 G94\nG1 X300 F1500\nM2\n"  # longer than any delay of the host
SETPOINTS = "[axis.X.setpoints]\ntravel_mm = [-10.0, 400.0]\n[axis.Y.setpoints]\ntravel_mm = [-10.0, 10.0]\n"
# fdhil as a process of its own that waits a shorter time than on a real machine
QUICK = """
from fdhil.commissioning import commissioning_steps, drive_survey
from fdhil.drivers.can import sdo_channel
drive_survey.LISTEN_S, commissioning_steps.SETTLE_CYCLES = 0.3, 50
sdo_channel.RESPONSE_TIMEOUT_S, sdo_channel.DEADLINE_S = 1.0, 20.0
from fdhil.cli.main import main
main()
"""


class TcpRelay:
    """A connection between fdhil and the hub that can be closed."""

    def __init__(self, port: int) -> None:
        self._hub = port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._ends: list[socket.socket] = []
        self._thread = threading.Thread(target=self._forward, daemon=True)
        self._thread.start()

    def _forward(self) -> None:
        near, _ = self._listening.accept()
        far = socket.create_connection(("127.0.0.1", self._hub))
        self._ends = [near, far]
        other = {near: far, far: near}
        try:
            while True:
                for end in select.select(self._ends, (), ())[0]:
                    data = end.recv(65536)
                    if not data:
                        return
                    other[end].sendall(data)
        except OSError:
            return

    def close_connections(self) -> None:
        for end in self._ends:
            end.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        for end in (*self._ends, self._listening):
            end.close()


@dataclass
class BenchSetup:
    twin: SimulatorProcess
    folder: Path
    bus: can.BusABC

    def write_config(self, port: int) -> Path:
        path = write_config(self.folder, bus=f'interface = "socketcand"\nport = {port}')
        path.write_text(path.read_text() + SETPOINTS + '[guard]\nclock = "sync"\n[play]\nheartbeat_s = 1.0\n')
        return path

    def start_play(self, port: int) -> subprocess.Popen[str]:
        program = self.folder / "part.ngc"
        program.write_text(STROKE)
        arguments = ["play", program, "--config", self.write_config(port), "--yes", "--go-to-start"]
        process = subprocess.Popen(
            [sys.executable, "-c", QUICK, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        targets: list[float] = []

        def is_moving() -> bool:
            while (frame := self.bus.recv(0)) is not None:
                if frame.arbitration_id == 0x201:
                    targets.append(struct.unpack("<Hi", frame.data)[1] / PER_MM)
            return process.poll() is not None or (bool(targets) and max(targets) - min(targets) > 5.0)

        self.wait(is_moving)
        return process

    def read_last_audit_entry(self) -> tuple[str, str | None]:
        *_, (entry, _) = audit_file.read_entries(
            machine_config.load_config(self.folder / "machine.toml").store.directory
        )
        return entry.get("asked") or entry["answered"], entry.get("result")

    def wait(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 300
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def assert_drives_stopped(self) -> bool:
        """Both drives report the lost heartbeat, enter the fault state and stop."""
        lost: set[int] = set()

        def is_reported() -> bool:
            while (frame := self.bus.recv(0)) is not None:
                if frame.arbitration_id in (0x081, 0x082) and frame.data[:2] == HEARTBEAT_LOST.to_bytes(2, "little"):
                    lost.add(frame.arbitration_id)
            return len(lost) == 2

        self.wait(is_reported)
        places = [self.read_object(0x6064)]

        def is_standing() -> bool:
            time.sleep(0.2)
            places.append(self.read_object(0x6064))
            return self.read_object(0x6041) & 0x4F == 0x08 and places[-1] == places[-2]

        self.wait(is_standing)
        return places[-1] < 300 * PER_MM

    def read_object(self, index: int) -> int:
        request = bytes([0x40]) + struct.pack("<HB", index, 0) + bytes(4)
        self.bus.send(can.Message(arbitration_id=0x601, data=request, is_extended_id=False))
        answers: list[bytes] = []

        def has_answered() -> bool:
            while (frame := self.bus.recv(0)) is not None:
                if frame.arbitration_id == 0x581 and frame.data[1:3] == request[1:3]:
                    answers.append(bytes(frame.data))
            return bool(answers)

        self.wait(has_answered)
        return int.from_bytes(answers[-1][4:], "little", signed=True)


@pytest.fixture(scope="module")
def bench_setup(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BenchSetup]:
    folder = tmp_path_factory.mktemp("play")
    with SimulatorProcess(write_config(folder)) as twin, twin.join_bus() as bus:
        made = BenchSetup(twin, folder, bus)
        sign_off(machine_config.load_config(made.write_config(twin.bus_settings["port"])))
        yield made


def test_drives_stop_when_play_is_killed(bench_setup: BenchSetup) -> None:
    process = bench_setup.start_play(bench_setup.twin.bus_settings["port"])
    process.send_signal(signal.SIGKILL)
    message = process.communicate()
    assert process.returncode == -signal.SIGKILL, message
    assert bench_setup.read_last_audit_entry() == ("play", None)  # without a result
    assert bench_setup.assert_drives_stopped()


def test_drives_stop_and_error_is_reported_when_bus_is_lost(bench_setup: BenchSetup) -> None:
    cable = TcpRelay(bench_setup.twin.bus_settings["port"])
    process = bench_setup.start_play(cable.port)
    cable.close_connections()
    _, err = process.communicate()
    assert process.returncode == 3
    assert "drives stop by themselves" in err
    assert bench_setup.read_last_audit_entry()[1] not in (None, "done")
    assert "Traceback" not in err
    assert bench_setup.assert_drives_stopped()
