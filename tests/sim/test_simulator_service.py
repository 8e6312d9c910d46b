"""The simulator's loop inside this process: on python-can's virtual bus, with a caller's commands and files."""

from __future__ import annotations

import json
import os
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from fdhil import config
from fdhil.cli.sim_command import PositionLine, _format_event, _print_json_event
from fdhil.config import MachineConfig
from fdhil.errors import ProgramError
from fdhil.records import Trajectory
from fdhil.sim.simulator_service import LOCKSTEP_WAIT_S, WALL_CLOCK_S, DriveClock, SimulatorService
from tests.bench import bench_document
from tests.sim.bench_simulator import build_corner_rows, build_trajectory
from tests.sim.hub_thread import receive_frames


class ServiceThread:
    """A service in a thread; ``events`` in the order they came."""

    def __init__(self, service_config: MachineConfig, load: Callable[[Path, MachineConfig], Trajectory]) -> None:
        self.events: queue.Queue[dict[str, Any]] = queue.Queue()
        read_end, self._panel = os.pipe()
        self._read_end = read_end
        self.service = SimulatorService(service_config, self.events.put, load, panel_fd=read_end)
        self._thread = threading.Thread(target=self.service.run, name="sim-service")
        self._thread.start()

    def execute_command(self, name: str, **keys: Any) -> None:
        os.write(self._panel, json.dumps({"command": name, **keys}).encode() + b"\n")

    def wait_for_event(self, name: str) -> dict[str, Any]:
        while True:
            event = self.events.get(timeout=300)
            if event["event"] == name:
                return event

    def end_service(self) -> None:
        self.service.stop()
        self._thread.join()
        os.close(self._panel)
        os.close(self._read_end)


@contextmanager
def run_service(
    load: Callable[[Path, MachineConfig], Trajectory], folder: Path, pace: str = "lockstep", **bus: Any
) -> Iterator[ServiceThread]:
    document = bench_document()
    document["bus"] = {"can0": bus}
    document["sim"] = {"pace": pace}
    document["store"] = {"directory": str(folder)}
    thread = ServiceThread(config.parse_config(document), load)
    try:
        yield thread
    finally:
        thread.end_service()


def load_corner_demand(path: Path, _: MachineConfig) -> Trajectory:
    if path.suffix != ".csv":
        raise ProgramError(3, "G7", "lathe diameters are not supported; write radii")
    return build_trajectory(build_corner_rows())


def test_peer_joins_virtual_bus_in_same_process(tmp_path: Path) -> None:
    with (
        can.Bus(interface="virtual", channel="sim-test") as peer,
        run_service(load_corner_demand, tmp_path, interface="virtual", channel="sim-test") as twin,
    ):
        ready = twin.wait_for_event("ready")
        assert ready["buses"] == {"can0": {"interface": "virtual", "channel": "sim-test"}}
        assert receive_frames(peer, 2)[:2] == [(0x701, b"\0"), (0x702, b"\0")]
        twin.execute_command("nc", on=True)
        twin.wait_for_event("nc")
        twin.execute_command("play", file="corner.csv")
        assert twin.wait_for_event("finished")["rows"] == len(build_corner_rows())
        syncs = [data[0] for can_id, data in receive_frames(peer, 6000) if can_id == 0x80]
        assert np.all(np.diff(syncs) % 240 == 1)
        peer.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("4000100000000000"), is_extended_id=False))
        while (answer := receive_frames(peer, 1))[0][0] != 0x581:
            pass
        assert answer == [(0x581, bytes.fromhex("4300100092010200"))]


def test_unreadable_file_does_not_end_machine(tmp_path: Path) -> None:
    with run_service(load_corner_demand, tmp_path, port=0) as twin:
        twin.wait_for_event("ready")
        twin.execute_command("play", file="part.ngc")
        assert twin.wait_for_event("error")["text"] == (
            "part.ngc cannot be played: line 3, 'G7': lathe diameters are not supported; write radii"
        )
        twin.execute_command("play", file="corner.csv")
        assert "switch it on first" in twin.wait_for_event("error")["text"]
        twin.execute_command("quit")
        twin._thread.join(300)
        assert not twin._thread.is_alive()


def test_program_after_stop_starts_at_standstill(tmp_path: Path) -> None:
    with run_service(load_corner_demand, tmp_path, port=0) as twin:
        twin.wait_for_event("ready")
        twin.execute_command("nc", on=True)
        twin.execute_command("play", file="first.csv")
        twin.wait_for_event("playing")
        twin.execute_command("stop")
        twin.execute_command("play", file="second.csv")
        assert twin.wait_for_event("finished")["file"] == "first.csv"
        assert twin.wait_for_event("playing")["file"] == "second.csv"
        assert twin.wait_for_event("finished")["rows"] == len(build_corner_rows())


def test_eds_is_written_to_run_directory(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    with run_service(load_corner_demand, tmp_path, port=0) as twin:
        eds = twin.wait_for_event("ready")["drives"]["X"]["eds"]
    assert eds == str(run / "eds" / "fdhil_twin_X.eds")
    assert "[6064]" in Path(eds).read_text()


def test_eds_without_run_directory_is_temporary(tmp_path: Path) -> None:
    with run_service(load_corner_demand, tmp_path / "nowhere", port=0) as twin:
        eds = Path(twin.wait_for_event("ready")["drives"]["X"]["eds"])
        assert eds.is_file()
    assert not eds.exists()
    assert not (tmp_path / "nowhere").exists()


def test_events_are_json_lines(capsys: pytest.CaptureFixture[str]) -> None:
    _print_json_event({"event": "error", "text": "two\nlines"})
    assert capsys.readouterr().out == '{"event": "error", "text": "two\\nlines"}\n'


@pytest.mark.parametrize(
    ("event", "text"),
    [
        ({"event": "nc", "on": False}, "NC off"),
        ({"event": "playing", "file": "a.csv", "rows": 3}, "playing a.csv, 3 rows"),
        (
            {"event": "finished", "file": "a", "rows": 3, "stopped": True, "late_rpdo": {"X": 1}, "trace": "t.csv"},
            "stopped after 3 rows of a; late offset frames: X 1, recorded to t.csv",
        ),
        ({"event": "error", "text": "no"}, "error: no"),
        ({"event": "fault", "sync": 5, "fault": "reboot", "axis": "X"}, "fault: sync 5, fault reboot, axis X"),
    ],
)
def test_events_are_readable_sentences_on_terminal(event: dict[str, Any], text: str) -> None:
    assert _format_event(event) == [text]


def test_positions_are_shown_during_motion_and_once_at_end() -> None:
    at_mm = {"X": 0.0, "Y": -3.0}
    shown = PositionLine(lambda: dict(at_mm))
    assert shown.format_line() is None
    at_mm["X"] = 12.5
    assert shown.format_line() == "X 12.500 mm  Y -3.000 mm"
    assert shown.format_line() == "X 12.500 mm  Y -3.000 mm"
    assert shown.format_line() is None


def test_drive_time_follows_sync_in_lockstep_and_the_clock_once_sync_is_missing() -> None:
    clock, real = DriveClock(0.001, lockstep=True), DriveClock(0.001, lockstep=False)
    clock.read_time(10.0, 0)
    for k in range(100):  # a busy host: a SYNC every 5 ms
        lockstep_s, real_s = clock.read_time(10.0 + 0.005 * k, k), real.read_time(10.0 + 0.005 * k, k)
    assert lockstep_s == pytest.approx(WALL_CLOCK_S + 0.099)
    assert real_s == pytest.approx(WALL_CLOCK_S + 0.495)
    stopped_s = 10.0 + 0.005 * 99
    assert clock.read_time(stopped_s + 0.9 * LOCKSTEP_WAIT_S, 99) == lockstep_s
    assert clock.read_time(stopped_s + 1.1 * LOCKSTEP_WAIT_S, 99) == lockstep_s + 2 * WALL_CLOCK_S
