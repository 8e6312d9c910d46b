"""fdhil play with simulated drives in this process: played, refused, braked."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from fdhil.commissioning.demand_playback import Bench, PlaybackResult, Signals
from fdhil.commissioning.void_mark import is_record_void, mark_record_void
from fdhil.config import MachineConfig, load_config
from tests.arming.guard_peer import GuardPeer
from tests.bench import axis_toml, bench_toml
from tests.commissioning.foreign_nc import (
    A_FEW,
    FOREIGN,
    NMT,
    SDO,
    SYNC,
    TARGET,
    TO_BRAKE,
    ForeignNc,
    LateOperator,
    is_moving_frame,
)
from tests.daemon.machine_rig import fdhil
from tests.drivers.peer import DrivePeer
from tests.integration.conftest import sign_off

pytestmark = pytest.mark.usefixtures("fast_commissioning")
AXIS = axis_toml("{}") + "[axis.{}.setpoints]\ntravel_mm = [-20.0, 60.0]\n"
DRIVES = {base + node for base in (0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700) for node in (1, 2)}
STROKE = "G21 G90 G94\nG1 X12 Y5 F6000\nG1 X20 Y0\nM2\n"


@dataclass
class PlayBench:
    folder: Path
    path: Path
    config: MachineConfig
    peers: dict[str, DrivePeer]
    capsys: pytest.CaptureFixture[str]

    def play_demand(self, text: str = STROKE, *options: str) -> tuple[int, dict[str, Any], str]:
        program = self.folder / "part.ngc"
        program.write_text(text)
        code, out, err = fdhil("play", program, "--config", self.path, "--json", *options, capsys=self.capsys)
        return code, json.loads(out), err

    def read_table_mm(self) -> list[float]:
        return [peer.drive.table_mm for peer in self.peers.values()]

    def list_sent_frames(self) -> set[int]:
        return {can_id for peer in self.peers.values() for can_id in peer.heard}

    def require_switched_off(self) -> bool:
        """The drives are off, and their heartbeat consumers are restored."""
        drives = [peer.drive for peer in self.peers.values()]
        return all(
            drive.power.state.name in ("SWITCH_ON_DISABLED", "FAULT")
            and not any(drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4))
            for drive in drives
        )

    def act_during_playback(self, act: Callable[[], None], mm: float = 0.5) -> threading.Thread:
        def wait() -> None:
            while self.peers["X"].drive.table_mm < mm:
                time.sleep(0.001)
            act()

        thread = threading.Thread(target=wait)
        thread.start()
        return thread


@pytest.fixture
def play_bench(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[PlayBench]:
    text = bench_toml("", corrected=False) + AXIS.format(*"XXXXXXXX"[: AXIS.count("{}")])
    text += AXIS.format(*"YYYYYYYY"[: AXIS.count("{}")])
    text += f'[bus.can0]\ninterface = "virtual"\nchannel = "{uuid.uuid4().hex}"\n'
    text += '[guard]\nclock = "sync"\n'
    path = tmp_path / "machine.toml"
    path.write_text(text)
    config = load_config(path)
    with DrivePeer(config, "X") as x, DrivePeer(config, "Y") as y:
        sign_off(config)
        x.heard.clear()
        y.heard.clear()
        yield PlayBench(tmp_path, path, config, {"X": x, "Y": y}, capsys)


@pytest.mark.usefixtures("long_computation")
def test_demand_is_played_to_end_after_go_to_start(play_bench: PlayBench) -> None:
    time_s = np.arange(301) * 1e-3
    rows = np.column_stack([time_s, 2 + 0.5 * np.sin(np.pi * time_s / 0.3) ** 2])
    demand = play_bench.folder / "part.csv"
    demand.write_text("time_s,X_mm,Y_mm\n" + "\n".join(f"{t:.3f},{x:.6f},0.0" for t, x in rows) + "\n")
    options = ("--config", play_bench.path, "--yes", "--json")
    code, out, _ = fdhil("play", demand, *options, capsys=play_bench.capsys)
    assert code == 1, out
    assert "2.000 mm from the start of the demand; move it there" in json.loads(out)["refused"]
    code, out, _ = fdhil("play", demand, *options, "--go-to-start", capsys=play_bench.capsys)
    message = json.loads(out)
    assert (code, message["stopped"], message["played"]) == (0, None, 301)
    assert message["sync"]["cycles"] >= message["rows"]
    assert play_bench.read_table_mm() == pytest.approx([2.0, 0.0], abs=0.02)
    assert play_bench.require_switched_off()
    # SYNC, NMT, SDO, heartbeat and targets; only the guard sends offsets
    assert play_bench.list_sent_frames() - DRIVES <= {0x000, 0x080, 0x601, 0x602, 0x201, 0x202, 0x765}


@pytest.mark.usefixtures("long_computation")
def test_signal_brakes_axes_and_switches_drives_off(play_bench: PlayBench) -> None:
    thread = play_bench.act_during_playback(lambda: os.kill(os.getpid(), signal.SIGTERM), mm=2.0)
    code, document, _ = play_bench.play_demand(STROKE, "--yes")
    thread.join()
    assert (code, document["stopped"]) == (1, "stopped by SIGTERM")
    assert 50 < document["played"] < document["rows"]
    assert play_bench.require_switched_off()
    x, _ = play_bench.read_table_mm()
    assert 2.0 < x < 10.5


@pytest.mark.usefixtures("long_computation")
def test_drive_fault_stops_all_axes(play_bench: PlayBench) -> None:
    thread = play_bench.act_during_playback(lambda: play_bench.peers["Y"].drive.trip_fault(0x3210))
    code, document, _ = play_bench.play_demand(STROKE, "--yes")
    thread.join()
    assert code == 1
    assert "axis Y: its drive fell from Operation enabled" in document["stopped"]
    assert play_bench.require_switched_off()


@pytest.mark.usefixtures("long_computation")
@pytest.mark.fault("A23")
def test_record_of_drive_that_boots_during_playback_stays_void(play_bench: PlayBench) -> None:
    """A daemon marks both: X for its boot-up, Y for the writes of play."""

    def boot() -> None:
        for axis in "XY":
            mark_record_void(play_bench.config.store.directory, axis, "touched")
        with can.Bus(interface="virtual", channel=play_bench.config.bus["can0"].channel) as bus:
            bus.send(can.Message(arbitration_id=0x701, data=b"\x00", is_extended_id=False))

    play_bench.config.guard_directory.mkdir(parents=True, exist_ok=True)
    guard = GuardPeer(play_bench.config.guard_directory)
    guard.says = lambda _kind: {"ok": True, "state": "OFF", "touched": {"X": 4, "Y": 5}}
    thread = play_bench.act_during_playback(boot)
    code, _, err = play_bench.play_demand(STROKE, "--yes")
    thread.join()
    guard.close()
    assert code == 0, err
    reported = [request for request in guard.requests if request.get("axes")]
    assert [sorted(request["axes"]) for request in reported] == [["X", "Y"], ["Y"]]  # at its start and at its end
    assert [request["touched"] for request in reported] == [{"X": 4, "Y": 5}] * 2
    assert [is_record_void(play_bench.config.store.directory, axis) for axis in "XY"] == [True, False]
    assert "RecordVoid: axis X: its drive rebooted after the comparison" in err
    assert "axis Y" not in err


@pytest.mark.usefixtures("long_computation")
def test_nothing_is_sent_while_nc_runs_bus(play_bench: PlayBench) -> None:
    ended = threading.Event()

    def send_sync() -> None:
        with can.Bus(interface="virtual", channel=play_bench.config.bus["can0"].channel) as bus:
            while not ended.wait(0.005):
                bus.send(can.Message(arbitration_id=0x080, is_extended_id=False))

    thread = threading.Thread(target=send_sync)
    thread.start()
    program = play_bench.folder / "part.ngc"
    program.write_text(STROKE)
    code, _, err = fdhil("play", program, "--config", play_bench.path, "--yes", capsys=play_bench.capsys)
    ended.set()
    thread.join()
    assert code == 3
    assert "an NC is sending SYNC" in err
    assert play_bench.list_sent_frames() - DRIVES <= {0x080}


def run_refused(floor: PlayBench, text: str = STROKE, *options: str) -> str:
    code, message, _ = floor.play_demand(text, *options)
    assert code == 1
    assert floor.read_table_mm() == pytest.approx([0.0, 0.0], abs=1e-3)
    return str(message["refused"])


@pytest.mark.usefixtures("long_computation")
def test_playback_is_refused_on_invalid_preconditions(play_bench: PlayBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert "not confirmed" in run_refused(play_bench)
    play_bench.peers["X"].drive.overwrite_object(0x6007, 0, 0)
    assert "0x6007" in run_refused(play_bench, STROKE, "--yes")
    (play_bench.config.store.directory / "commissioning-X.void").write_text("{}")
    assert "run fdhil check" in run_refused(play_bench, STROKE, "--yes")
    (play_bench.config.store.directory / "commissioning-X.json").unlink()
    assert "drive X: it is not commissioned with this configuration" in run_refused(play_bench, STROKE, "--yes")


def test_demand_outside_travel_is_refused_before_bus_is_opened(play_bench: PlayBench) -> None:
    code, message, _ = play_bench.play_demand(STROKE, "--dry-run")
    assert (code, message["would_play"]) == (0, True)
    text = run_refused(play_bench, "G21 G90 G94\nG1 X70 F6000\nM2\n", "--yes")
    assert "axis X: it could not be braked inside its travel (row " in text
    assert "nothing was sent" in text
    play_bench.path.write_text(
        play_bench.path.read_text().replace("[axis.Y.setpoints]\ntravel_mm = [-20.0, 60.0]\n", "")
    )
    code, _, err = fdhil(
        "play", play_bench.folder / "part.ngc", "--config", play_bench.path, "--yes", capsys=play_bench.capsys
    )
    assert code == 2
    assert "axis.Y.setpoints: is missing, so fdhil may not move this axis" in err
    assert play_bench.list_sent_frames() <= DRIVES


def create_stale_socket(folder: Path) -> None:
    folder.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as killed:
        killed.bind(str(folder / "guard.sock"))


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("what", ["SYNC", "target", "offset"])
def test_another_master_ends_playback(what: str, play_bench: PlayBench) -> None:
    create_stale_socket(play_bench.config.guard_directory)
    with ForeignNc(play_bench.config.bus["can0"].channel, FOREIGN[what], is_moving_frame) as nc:
        code, document, _ = play_bench.play_demand(STROKE, "--yes")
        assert nc.on
        assert nc.count_frames(SYNC) <= A_FEW + TO_BRAKE
        assert nc.count_frames(NMT) == 0
        assert nc.count_frames(SDO) <= 1
        assert what != "target" or nc.count_frames(TARGET) == 0
    assert code == 1
    left = "axis X was left to that master, and axis Y was stopped and its drive switched off"
    assert "bus can0: an NC is sending" in document["stopped"]
    assert (left in document["stopped"]) is (what == "target")
    assert "0x1016 may be as fdhil wrote" in document["stopped"]


@pytest.mark.usefixtures("long_computation")
def test_axes_held_at_start_are_switched_off_when_nc_starts(
    play_bench: PlayBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = 0

    def wait_for_enter() -> bool:
        nonlocal asked
        asked += 1
        nc.on |= asked == 20
        return False

    monkeypatch.setattr("fdhil.cli.play_command._is_enter_pressed", wait_for_enter)
    with ForeignNc(play_bench.config.bus["can0"].channel, FOREIGN["SYNC"], lambda _: False) as nc:
        code, document, _ = play_bench.play_demand(STROKE, "--yes", "--hold")
        assert nc.count_frames(SYNC) <= A_FEW
    assert (code, document["played"]) == (1, 0)
    assert "an NC is sending SYNC" in document["stopped"]
    assert all(peer.drive.power.state.name == "SWITCH_ON_DISABLED" for peer in play_bench.peers.values())


@pytest.mark.usefixtures("long_computation")
def test_playback_ends_when_nc_starts_before_path(play_bench: PlayBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the move to the start and the demand the drives are off before the path is created."""
    nc = ForeignNc(play_bench.config.bus["can0"].channel, FOREIGN["SYNC"], lambda _: False)

    def prepare_late(bench: Bench, signals: Signals) -> PlaybackResult:
        nc.on = True
        bench.loop._landed.wait(60)
        return play(bench, signals)

    play = Bench.play_demand
    monkeypatch.setattr(Bench, "play_demand", prepare_late)
    with nc:
        code, document, _ = play_bench.play_demand(STROKE, "--yes")
    assert (code, document["played"]) == (1, 0)
    assert "an NC is sending SYNC" in document["stopped"]


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("what", FOREIGN)
def test_nothing_is_sent_when_nc_starts_during_question(
    what: str, play_bench: PlayBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ForeignNc(play_bench.config.bus["can0"].channel, FOREIGN[what], lambda _: False) as nc:
        monkeypatch.setattr("sys.stdin", LateOperator(nc))
        code, _, err = play_bench.play_demand(STROKE)
        assert (nc.on, nc.sent) == (True, [])
    assert code == 3, err
