"""Reception and deviations from the config: reported with the reason, in the status and as a notice."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.cli.status_view import format_counters, open_console, show_status
from fdhil.config import MachineConfig
from fdhil.daemon.bus_health import FEW_SYNCS, BusHealth
from fdhil.daemon.daemon_status import DaemonStatus
from fdhil.drivers import open_machine
from fdhil.pipeline import Record
from fdhil.records import AxisSamples, Notice, TickTimes, freeze_array, freeze_integers
from fdhil.sim.wire.tcp_hub import encode_frames
from tests.bench import bench_axis
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving, status_when
from tests.drivers.frame_builder import FrameBuilder

WRONG = {"SyncPeriodSuspect", "NodeNeverHeard"}
STEP_S = 0.002  # of the SYNC on the wire, where the config says 1 ms
WIRED = 2400  # SYNCs, again and again: a busy host's daemon hears them whenever it begins to listen


class Line:
    def __init__(self) -> None:
        self._cut = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            peer, _ = self._listener.accept()
            with peer:
                peer.sendall(b"< hi >")
                for _ in ("open", "rawmode"):
                    peer.recv(256)
                    peer.sendall(b"< ok >")
                self._send(peer)
                peer.recv(1)  # the bus is dead, the hub is not

    def _send(self, peer: socket.socket) -> None:
        begun_s, sent = time.time(), 0
        rows = FrameBuilder(WIRED, period_ns=round(STEP_S * 1e9), start_ns=0).build_rows()
        while not self._cut.is_set():
            text = b""
            while True:
                again, row = divmod(sent, len(rows))
                t_ns, can_id, data = rows[row]
                at_s = again * WIRED * STEP_S + t_ns * 1e-9
                if at_s > time.time() - begun_s:
                    break
                text += encode_frames([(can_id, data)], begun_s + at_s)
                sent += 1
            peer.sendall(text)
            time.sleep(0.05)

    def cut(self) -> None:
        self._cut.set()

    def close(self) -> None:
        self.cut()
        self._listener.close()


@pytest.fixture
def bus_line() -> Iterator[Line]:
    made = Line()
    yield made
    made.close()


@pytest.fixture(autouse=True)
def _skip_kernel_warmup(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)


def shown(status: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    show_status(status, open_console())
    return " ".join(capsys.readouterr().out.split())


class Opens:
    open = staticmethod(open_machine)


@pytest.mark.usefixtures("long_computation")
async def test_wrong_period_silent_node_and_dead_bus_are_reported(
    bus_line: Line, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.daemon.bus_health.PERIOD_S", 3.0)
    bus = {"can0": {"interface": "socketcand", "port": bus_line.port}}
    config = config_of(tmp_path, ("X", "Y"), bus=bus)
    async with serving(config, Opens()) as path:  # type: ignore[arg-type]
        status = await status_when(path, lambda s: {t["code"] for t in s["troubles"]} >= WRONG)
        assert status["source"]["state"] == "listening"
        assert status["sync"]["rate_hz"] == pytest.approx(500.0, rel=0.01)
        troubles = {(each["code"], each["axis"]): each["text"] for each in status["troubles"]}
        expected = r"SYNC runs at (499\.\d|500(\.\d)?) Hz instead of 1000 Hz .* set sync_period_s = 0\.00(2|1999)"
        assert re.search(expected, troubles["SyncPeriodSuspect", ""])
        assert "the drive (node 2 on can0) has never sent a frame" in troubles["NodeNeverHeard", "Y"]
        assert {notice["code"] for notice in status["notices"]} >= WRONG
        text = shown(status, capsys)
        assert re.search(r"listening, SYNC (499|500)\.\d Hz of 1000", text)
        assert "Y: NodeNeverHeard: the drive (node 2 on can0) has never sent a frame" in text
        bus_line.cut()
        status = await status_when(path, lambda s: s["source"]["state"] == "silent" and s["sync"]["rate_hz"] is None)
        assert status["source"]["heard_s_ago"] > 1.0
        assert status["sync"]["heard_s_ago"] >= 1.0  # told in whole milliseconds
        text = shown(status, capsys)
        assert "silent for" in text
        assert "no SYNC for" in text
        assert "Hz of" not in text


def test_sync_rate_covers_recent_reception_only(tmp_path: Path) -> None:
    hearing = BusHealth(config_of(tmp_path), 0.0)
    hearing.note_source_opened(0.0)
    ticks = np.arange(400)
    hearing.take_record(TickTimes(freeze_integers(ticks), freeze_integers(ticks * 1_370_000)), 0.6)
    assert hearing.measure_sync_rate_hz(1.0) == pytest.approx(730.0, rel=0.001)
    assert hearing.measure_sync_rate_hz(21.0) is None
    assert hearing.build_status(21.0)["sync"]["heard_s_ago"] == pytest.approx(20.4)
    hearing.take_counters({"frames": 5, "can0.frames": 5}, 1.0)
    assert hearing.build_status(1.9)["source"]["state"] == "listening"
    hearing.take_counters({"frames": 5, "can0.frames": 5}, 2.1)
    assert hearing.build_status(2.1)["source"]["state"] == "silent"
    assert hearing.build_status(2.1)["source"]["buses"] == {"can0": 1.1}
    hearing.note_source_lost(3.0)
    assert hearing.build_status(3.0)["source"]["state"] == "reconnecting"


@pytest.mark.parametrize(
    ("periods_us", "expected"),
    [
        ((1000,), None),
        ((1200,), "set sync_period_s = 0.0012"),
        (
            (1059, 1307, 1509),
            "is uneven, 663 to 944 Hz instead of the configured 1000 Hz: no period can be determined",
        ),
    ],
)
def test_sync_period_is_checked_over_a_minute_and_quantified_when_steady(
    periods_us: tuple[int, ...], expected: str | None, tmp_path: Path
) -> None:
    hearing = BusHealth(config_of(tmp_path), 0.0)
    hearing.note_source_opened(0.0)
    tick, t_ns, first_s = 0, 0, None
    for k in range(4 * 70):
        ticks, step_ns = tick + 1 + np.arange(800), periods_us[k // 4 % len(periods_us)] * 1000
        stamps = t_ns + step_ns * (1 + np.arange(800))
        tick, t_ns, now_s = int(ticks[-1]), int(stamps[-1]), 0.25 * k
        hearing.take_record(TickTimes(freeze_integers(ticks), freeze_integers(stamps)), now_s)
        found = {code: text for (code, _), text in hearing.find_lasting_troubles({}, now_s).items()}
        if "SyncPeriodSuspect" in found and first_s is None:
            first_s = now_s
    assert (first_s is None) is (expected is None)
    if expected is not None:
        assert expected in found["SyncPeriodSuspect"]
        assert first_s is not None
        assert first_s > 59.0


def test_repeated_ticks_of_two_buses_give_no_rate(tmp_path: Path) -> None:
    """On a busy host a bus was read long after another: its newest tick was also the oldest."""
    hearing = BusHealth(config_of(tmp_path), 0.0)
    hearing.note_source_opened(0.0)
    for late_ns in (0, 300_000_000):
        ticks = np.full(FEW_SYNCS, 5)
        hearing.take_record(TickTimes(freeze_integers(ticks), freeze_integers(late_ns + np.arange(FEW_SYNCS))), 0.5)
    assert hearing.measure_sync_rate_hz(0.6) is None
    assert not any(code == "SyncPeriodSuspect" for code, _ in hearing.find_lasting_troubles({}, 100.0))


def test_drive_without_samples_is_reported_once_and_its_recovery_too(tmp_path: Path) -> None:
    watch = DaemonStatus(config_of(tmp_path), 0.0)
    watch.hearing.note_source_opened(0.0)
    result: list[tuple[float, Notice]] = []
    for k in range(1, 120):
        now_s, ticks = k * 0.25, np.arange(k * 250, k * 250 + 250)
        watch.hearing.take_record(TickTimes(freeze_integers(ticks), freeze_integers(ticks * 1_000_000)), now_s)
        watch.hearing.take_counters({"frames": k, "can0.frames": k, "can0.X.heard": k}, now_s)
        whole = 250 if now_s > 20.0 else 0  # before that a TPDO is missing, and no sample is whole
        if now_s > 5.0:
            still, tick = freeze_array(np.zeros(whole)), freeze_integers(ticks[:whole])
            samples = AxisSamples("X", tick, still, still, still, still, None, still, tick)
            watch.hearing.take_record(samples, now_s)
        result += [(now_s, notice) for notice in watch.update_troubles(now_s)]
    assert [(n.code, n.severity, n.axis) for _, n in result] == [
        ("NoSamples", "MAJOR", "X"),
        ("NoSamples", "info", "X"),
    ]
    assert 10.0 <= result[0][0] <= 11.0


@pytest.mark.parametrize(
    ("synced", "words"), [(True, "monitored; check node_id"), (False, "no heartbeat (0x1017), else check")]
)
def test_silent_drive_without_sync_may_lack_a_heartbeat(synced: bool, words: str, tmp_path: Path) -> None:
    hearing = BusHealth(config_of(tmp_path), 0.0)
    hearing.note_source_opened(0.0)
    for k in range(1, 20):
        ticks = np.arange(k * 250, k * 250 + 250)
        if synced:
            hearing.take_record(TickTimes(freeze_integers(ticks), freeze_integers(ticks * 1_000_000)), k * 0.25)
        hearing.take_counters({"frames": k, "can0.frames": k, "can0.X.heard": 0}, k * 0.25)
        result = hearing.find_lasting_troubles({}, k * 0.25)
    assert words in result["NodeNeverHeard", "X"]


def fed(config: MachineConfig, records: list[Record], windows: int = 0) -> dict[tuple[str, str], str]:
    hearing = BusHealth(config, 0.0)
    hearing.note_source_opened(0.0)
    now_s = 0.0
    for record in records:
        if isinstance(record, TickTimes):
            now_s = float(record.tick[-1]) * 1e-3
        hearing.take_record(record, now_s)
    return hearing.find_lasting_troubles({"X": windows}, now_s + 6.0)


def other(folder: Path, **axis: Any) -> MachineConfig:
    document = {"machine": {"name": "bench"}, "axis": {"X": bench_axis(**axis)}}
    return machine_config.parse_config(document, "test", folder)


def test_unused_moves_are_reported_with_their_reason(tmp_path: Path) -> None:
    true = config_of(tmp_path)
    records = rapids(true, count=4)
    assert fed(true, records, windows=4) == {}
    ((key, text),) = fed(other(tmp_path, rapid_speed_mm_s=1000.0), records).items()
    assert key == ("MovesNotUsed", "X")
    assert "4 moves recorded, none used: 4 stay below 90% of the rapid speed of 1000 mm/s, the fastest at 5" in text
    assert "correct rapid_speed_mm_s or screw_pitch_mm" in text
    ((key, text),) = fed(true, records).items()
    assert key == ("MovesNotUsed", "X")
    assert "no event of the G0 source inferred came" in text
    ((key, text),) = fed(other(tmp_path, rapid_speed_mm_s=250.0), records, windows=4).items()
    assert key == ("PitchSuspect", "X")
    assert "times the rapid speed" in text
    ((key, text),) = fed(other(tmp_path, screw_pitch_mm=10.0), records, windows=4).items()
    assert key == ("ScaleSuspect", "X")
    assert "the position travels 2 times the integral of the speed" in text


def test_moves_without_a_plateau_are_reported(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    period_s = config.machine.sync_period_s
    moves: list[Record] = []
    ramp = np.linspace(0.0, 480.0, 120)
    speed = np.concatenate([np.zeros(200), ramp, ramp[::-1], np.zeros(200)] * 4) * np.repeat([1, -1, 1, -1], 640)
    place = np.cumsum(speed) * period_s
    ticks = np.arange(speed.size)
    pitch = config.axis["X"].screw_pitch_mm
    for start in range(0, speed.size, 40):
        part = slice(start, start + 40)
        tick = freeze_integers(ticks[part])
        zeros = freeze_array(np.zeros(tick.size))
        position, turning = freeze_array(place[part]), freeze_array(speed[part] / pitch * 2 * np.pi)
        moves.append(TickTimes(tick, freeze_integers(ticks[part] * 1_000_000)))
        moves.append(AxisSamples("X", tick, position, position, turning, zeros, None, zeros, freeze_integers(zeros)))
    ((key, text),) = fed(config, moves).items()
    assert key == ("MovesNotUsed", "X")
    assert "no plateau of 0.1 s; run longer rapids" in text


async def test_daemon_reports_unusable_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = rapids(config_of(tmp_path), count=3)
    async with serving(other(tmp_path, rapid_speed_mm_s=1000.0), SimulatedMachine(records)) as path:
        status = await status_when(path, lambda s: s["troubles"] and s["axes"]["X"]["moves"]["seen"] == 3)
        text = shown(status, capsys)
    assert [notice["code"] for notice in status["notices"]].count("MovesNotUsed") == 1
    assert "X 0/0" in text
    assert "X: MovesNotUsed: 3 moves recorded, none used" in text
    assert "X: 3 moves detected; not used: 3 slower than a rapid (the fastest of all reached 5" in text


def test_counters_are_reported_in_words() -> None:
    counters = {"frames": 41230, "lost": 2, "can0.frames": 41230, "can0.pdo_lost": 2, "can0.sync_missed": 0}
    assert format_counters(counters) == "frames received 41 230, lost 2 (can0: PDO lost 2)"
    assert format_counters({"frames": 7}) == "frames received 7, lost 0"
    assert format_counters({}) == "frames: none"
