"""The guard as a process, on a socketcand hub with a machine behind it."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.arming.guard_client import GuardClient, GuardLost
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.cli.cli_errors import run_safely
from fdhil.cli.main import cli
from fdhil.guard.guard_settings import encode_settings
from tests.guard import short_timeouts
from tests.guard.drive_peer import NEVER, Peer, open_bus, write_config
from tests.guard.simulated_bus import DIGEST, FACTS_GIVEN, LIMITS, commissioned, smooth_path
from tests.listening_ports import list_tcp_ports

pytestmark = pytest.mark.usefixtures("processes")

DEMAND, OFFSET = smooth_path(rows=800)
TOKEN = "the operator's"
ENDS_S = 100.0  # a process that ends or answers does so at once, on a host that has time for it


class Rig:
    def __init__(
        self, folder: Path, clock: str = "sync", program: Sequence[str] = ("-m", short_timeouts.__name__)
    ) -> None:
        self.peer = Peer(DEMAND)
        self.peer.start()
        self.config = machine_config.load_config(write_config(folder, self.peer.port, clock))
        self.run_directory = folder
        self.program = program
        self.settings = folder / "guard.json"
        token = hashlib.sha256(TOKEN.encode()).hexdigest()
        self.settings.write_text(encode_settings(commissioned(make_guard_settings(self.config, "can0", folder, token))))
        self.journal = (folder / "journal").open("a")
        self.process = self.start()
        self.client: GuardClient | None = None
        self.alive = threading.Event()
        self._ended = threading.Event()
        self._keeper = threading.Thread(target=self._keep_alive, daemon=True)

    def adopt(self) -> int:
        token = self.run_directory / "token"
        token.touch(0o600)
        token.write_text(TOKEN)
        config = self.run_directory / "machine.toml"
        config.write_text(config.read_text().partition("[store]")[0] + '[store]\nrun_directory = "."\n')
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", ["fdhil", "adopt", str(config), "--yes"])
            return run_safely(cli)

    def start(self) -> subprocess.Popen[bytes]:
        with open_bus("can0", self.config.bus["can0"]) as bus:
            arguments = ["--settings", str(self.settings), "--descriptor", str(bus.fileno())]
            return subprocess.Popen(
                [sys.executable, *self.program, *arguments],
                stdout=self.journal,
                stderr=subprocess.PIPE,
                pass_fds=[bus.fileno()],
            )

    def connect(self) -> GuardClient:
        self.peer.wait(lambda: any(e["event"] == "ready" for e in self.events()), "the guard")
        self.client = GuardClient(self.run_directory, timeout_s=ENDS_S)
        self.alive.set()
        self._keeper.start()
        return self.client

    def _keep_alive(self) -> None:
        assert self.client is not None
        while not self._ended.wait(0.05):
            if self.alive.is_set():
                try:
                    self.client.send_alive()
                except GuardLost:
                    return

    def arm(self, amplitude: float = 1.0) -> None:
        client = self.client or self.connect()
        demand = dict(zip("XY", DEMAND, strict=True))
        offset = {axis: [round(amplitude * v) for v in column] for axis, column in zip("XY", OFFSET, strict=True)}
        answer = client.load_table("XY", demand, offset, DIGEST)
        assert answer["ok"], answer
        self.peer.wait(lambda: client.read_status()["good_for"] > 100, "good interlocks")
        answer = client.arm(TOKEN, DIGEST, FACTS_GIVEN)
        assert answer["ok"], answer
        self.peer.wait(lambda: len(self.peer.offsets_sent()) > 30, "zeros")

    def settle(self) -> None:
        client = self.client
        assert client is not None
        self.peer.stand()
        self.peer.wait(lambda: client.read_status()["tick"] == self.peer.tick, "the last SYNC")
        self.peer.read_out()
        self.peer.syncing = True

    def state(self) -> str:
        assert self.client is not None
        return str(self.client.read_status()["state"])

    def into_the_cut(self) -> None:
        self.arm()
        self.play_into_the_cut()

    def into_the_cut_blindly(self) -> None:
        client = self.connect()
        columns = [dict(zip("XY", rows, strict=True)) for rows in (DEMAND, OFFSET)]
        assert client.load_table("XY", columns[0], columns[1], DIGEST)["ok"]
        self.peer.wait(lambda: client.arm(TOKEN, DIGEST, FACTS_GIVEN)["ok"], "arming")
        self.peer.wait(lambda: len(self.peer.offsets_sent()) > 30, "zeros")
        self.play_into_the_cut()

    def play_into_the_cut(self) -> None:
        self.peer.slow_from = 320
        self.peer.playing = True
        self.peer.wait(lambda: self.peer.row > 330, "the path")

    def events(self) -> list[dict[str, object]]:
        lines = Path(self.journal.name).read_text().split("\n")
        return [json.loads(line) for line in lines[:-1]]  # the last one may still be on its way

    def close(self) -> None:
        self._ended.set()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
        self.process.communicate()
        self.peer.ended.set()
        self.peer.join()
        if self.client is not None:
            self._keeper.join()
            self.client.close()
        self.journal.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


def check_limits(rig: Rig) -> None:
    missed = max([int(str(event["missed"])) for event in rig.events() if event["event"] == "state"], default=0)
    for node in (1, 2):
        values = [0, 0, *[offset for _, offset in rig.peer.offsets_sent(node)]]
        rates = [b - a for a, b in itertools.pairwise(values)]
        assert max(map(abs, values)) <= LIMITS.offset
        assert max(map(abs, rates)) <= LIMITS.hard_rate
        assert sum(abs(b - a) > LIMITS.hard_acceleration for a, b in itertools.pairwise(rates)) <= missed


def test_guard_process_is_mute_until_armed_then_aligned_then_off(rig: Rig) -> None:
    client = rig.connect()
    rig.peer.wait(lambda: client.read_status()["good_for"] > 200, "SYNC")
    assert rig.peer.sent == []
    assert list_tcp_ports(rig.process.pid) == set()
    rig.arm()
    rig.settle()
    rig.peer.playing = True
    rig.peer.wait(lambda: rig.peer.row > 780, "the path")
    rig.peer.wait(lambda: rig.state() == "OFF", "the end")
    rows = {target: k for k, target in enumerate(DEMAND[0])}
    moving = [(t, o) for _, t, o in rig.peer.latched if DEMAND[0][50] < t[0] < DEMAND[0][-50]]
    assert len(moving) > 600
    assert [o for _, o in moving] == [(OFFSET[0][rows[t[0]]], OFFSET[1][rows[t[0]]]) for t, _ in moving]
    check_limits(rig)
    assert client.read_status()["cause"]["code"] == "Finished", "\n".join(map(str, rig.events()))
    rig.peer.expected = False
    rig.peer.read_out()
    count = len(rig.peer.sent)
    ticks = rig.peer.tick
    rig.peer.wait(lambda: rig.peer.tick > ticks + 50, "SYNC")
    assert len(rig.peer.sent) == count
    assert {i for _, i, _ in rig.peer.sent} == {0x301, 0x302, 0x764}


@pytest.mark.fault("E18")
def test_disarm_ramps_down(rig: Rig) -> None:
    rig.into_the_cut()
    assert rig.client is not None
    assert abs(rig.peer.offsets_sent()[-1][1]) > 100
    assert rig.client.disarm()["ok"]
    rig.peer.wait(lambda: rig.state() == "OFF", "off")
    assert rig.peer.offsets_sent()[-1][1] == 0
    check_limits(rig)


@pytest.mark.fault("F13")
def test_sigterm_ramps_down_and_exits_0(rig: Rig) -> None:
    rig.into_the_cut()
    rig.process.send_signal(signal.SIGTERM)
    assert rig.process.wait(ENDS_S) == 0
    assert rig.peer.offsets_sent()[-1][1] == 0
    check_limits(rig)
    last = rig.events()[-1]
    assert (last["event"], last["state"], last["offset_um"]) == ("stopped", "OFF", {"X": 0.0, "Y": 0.0})


@pytest.mark.parametrize("how", ["closes", "falls silent"])
@pytest.mark.fault("F15")
def test_lost_daemon_ramps_down(rig: Rig, how: str) -> None:
    rig.into_the_cut()
    assert rig.client is not None
    rig.alive.clear()
    if how == "falls silent":
        (rig.run_directory / short_timeouts.DAEMON).touch()
    if how == "closes":
        rig.client.close()
    rig.peer.wait(lambda: any(e.get("code") == "MainLost" for e in rig.events()), "MainLost")
    rig.peer.wait(lambda: any(e.get("state") == "OFF" for e in rig.events()), "off")
    assert rig.peer.offsets_sent()[-1][1] == 0
    check_limits(rig)


@pytest.mark.fault("A7", "E8")
def test_lost_sync_freezes_and_adopt_ramps_to_zero(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.into_the_cut()
    assert rig.client is not None
    rig.peer.playing = rig.peer.expected = False
    rig.peer.stand()
    (rig.run_directory / short_timeouts.BUS).touch()
    rig.peer.wait(lambda: rig.state() == "FROZEN", "frozen")
    rig.peer.read_out()
    count = len(rig.peer.sent)
    held = rig.peer.offsets_sent()[-1][1]
    time.sleep(0.1)
    assert len(rig.peer.sent) == count
    assert rig.client.read_status()["cause"]["code"] == "SyncLost"
    assert rig.adopt() == 1
    assert "refused: SyncLost" in capsys.readouterr().err
    (rig.run_directory / short_timeouts.BUS).unlink()
    tick, rig.peer.syncing = rig.peer.tick, True
    rig.peer.wait(lambda: rig.peer.tick > tick + 1, "SYNC")
    rig.peer.expected = True
    rig.peer.wait(lambda: rig.adopt() == 0, "adoption")
    assert capsys.readouterr().out == "guard: OFF, offset 0\n"
    assert rig.state() == "OFF"
    assert rig.peer.offsets_sent()[-1][1] == 0
    assert held != 0
    check_limits(rig)


@pytest.mark.fault("F14")
def test_stopped_process_sends_nothing(rig: Rig) -> None:
    rig.into_the_cut()
    rig.peer.lockstep, rig.peer.slow_from = False, NEVER
    rig.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, rig.process.pid, os.WSTOPPED | os.WNOWAIT)
    rig.peer.expected = False
    rig.peer.read_out()  # what it had sent
    count, tick = len(rig.peer.sent), rig.peer.tick
    rig.peer.wait(lambda: rig.peer.tick > tick + 200, "SYNC")
    assert len(rig.peer.sent) == count
    rig.peer.slow_from = 0  # a guard that no processor is left for would be late at each SYNC from now on
    rig.process.send_signal(signal.SIGCONT)
    rig.peer.wait(lambda: rig.state() == "OFF", "off")
    assert rig.client is not None
    assert rig.client.read_status()["cause"]["code"] in ("LoopOverrun", "MainLost")
    check_limits(rig)


@pytest.mark.fault("F16", "E13")
def test_next_guard_adopts_the_offset_of_a_killed_one(rig: Rig) -> None:
    rig.into_the_cut()
    rig.process.kill()
    rig.process.wait()
    rig.peer.playing = False
    rig.peer.wait(lambda: rig.peer.hung_up, "all that it had sent")
    drive = rig.peer.drives[0]
    held = drive.offset if drive.received_offset is None else drive.received_offset
    assert held != 0
    count = len(rig.peer.offsets_sent())
    again = rig.start()
    try:
        rig.peer.wait(lambda: len(rig.peer.offsets_sent()) > count and drive.offset == 0, "adoption")
        values = [offset for _, offset in rig.peer.offsets_sent()[count:]]
        assert abs(values[0] - held) <= LIMITS.rate
        check_limits(rig)
    finally:
        again.terminate()
        assert again.wait(ENDS_S) == 0
        again.communicate()


@pytest.mark.fault("G9", "A19", "F16")
@pytest.mark.parametrize("cob_id", [0x301, 0x501], ids=["our COB-ID", "another RPDO of the drive"])
def test_forged_foreign_or_missing_frames_cause_no_step(rig: Rig, cob_id: int) -> None:
    client, peer, drive = rig.connect(), rig.peer, rig.peer.drives[0]
    for value in (300, 300, 983_040, -983_040):
        peer.inject((0x381, value.to_bytes(4, "little", signed=True) * 2))
        tick = peer.tick
        peer.wait(lambda tick=tick: peer.tick > tick + 40, "SYNC")  # type: ignore[misc]
    assert peer.sent == []
    rig.into_the_cut()
    peer.inject((cob_id, (-819).to_bytes(4, "little", signed=True)))
    drive.received_offset = -819
    peer.wait(lambda: rig.state() == "OFF", "off")
    peer.expected = False  # the guard is silent, whatever the drives hold
    assert client.read_status()["cause"]["code"] == "OffsetHijack"
    held = [offsets[0] for _, _, offsets in peer.latched]
    steps = [abs(b - a) for a, b in itertools.pairwise(held)]
    # the foreign one, and one back where a frame of ours was on its way already
    assert sum(step > LIMITS.hard_rate for step in steps) <= 2 + client.read_status()["missed_cycles"]
    peer.playing, peer.row = False, 0
    tick = peer.tick
    peer.wait(lambda: peer.tick > tick + 1, "SYNC")
    peer.expected, peer.slow_from = True, NEVER
    rig.into_the_cut()
    drive.shows_offset = False
    peer.wait(lambda: rig.state() == "FROZEN", "frozen: no zero is read back")
    assert "ReadBackStale" in {event.get("code") for event in rig.events()}
    assert peer.offsets_sent()[-1][1] == 0
    rig.process.kill()
    rig.process.wait()
    client.close()
    peer.slow_from = NEVER
    peer.wait(lambda: peer.hung_up, "all that it had sent")
    count = len(peer.sent)
    again = rig.start()
    try:
        peer.wait(lambda: [event["event"] for event in rig.events()].count("ready") == 2, "the next guard")
        tick = peer.tick
        peer.wait(lambda: peer.tick > tick + 300, "SYNC")
        with GuardClient(rig.run_directory, timeout_s=ENDS_S) as other:
            refused = other.arm(TOKEN, DIGEST, FACTS_GIVEN)["refused"]
            assert "ReadBackStale" in {result["code"] for result in refused}
            assert not other.adopt(TOKEN)["ok"]
        assert len(peer.sent) == count
    finally:
        again.kill()
        again.communicate()
