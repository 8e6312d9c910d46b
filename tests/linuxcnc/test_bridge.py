"""fdhil next to a real LinuxCNC: the bridge reports its moves, exact to a cycle, regardless of the bus's lag."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.bridges import linuxcnc as bridge
from fdhil.config import MachineConfig
from fdhil.drivers import Record, open_machine
from fdhil.pipeline import AxisPipeline
from fdhil.records import AxisSamples, Float, Int, MoveEvent, MoveKind, NcState, Notice, WindowOutcome
from tests.free_ports import find_free_port
from tests.linuxcnc.linuxcnc_process import LinuxCnc
from tests.sim.simulator_process import SimulatorProcess, write_config

pytestmark = pytest.mark.debian

PATIENCE_S = 300.0
KINDS = {0: MoveKind.REST, 1: MoveKind.RAPID, 2: MoveKind.FEED, 3: MoveKind.ARC}
PART = """G21 G90 G17 G64 P0.02
G0 X200 Y50
G1 X230 Y80 F6000
G2 X270 Y120 I40
G0 X0 Y0
G4 P0.4
G0 X450
G0 X0
G1 X5 F2000
G1 X0
M2
"""
STROKE_MM = 450.0
RAPIDS = """G21 G90
G0 X450
G4 P0.6
G0 X0
G4 P0.6
M2
"""
TRUTH = """
net x sampler.2.pin.0
net y sampler.2.pin.1
net z sampler.2.pin.2
net kind motion.motion-type => sampler.2.pin.3
addf sampler.2 servo-thread
"""


@dataclass
class SourceRecorder:
    """Records received from the machine's source."""

    records: list[Record] = field(default_factory=list)
    came: asyncio.Event = field(default_factory=asyncio.Event)

    def add_record(self, record: Record) -> None:
        self.records.append(record)
        self.came.set()

    def select_axis(self, axis: str, newest: int | None = None) -> tuple[Int, Float]:
        """Return ticks and demand (n,) of an axis, from the bus; only of the ``newest`` blocks."""
        mine = (r for r in reversed(self.records) if isinstance(r, AxisSamples) and r.axis == axis)
        blocks = list(islice(mine, newest))[::-1]
        return np.concatenate([b.tick for b in blocks]), np.concatenate([b.demand_mm for b in blocks])

    def list_events(self, axis: str) -> list[MoveEvent]:
        return [r for r in self.records if isinstance(r, MoveEvent) and r.axis == axis]

    @property
    def state(self) -> NcState:
        """The NC's last state."""
        return next(r for r in reversed(self.records) if isinstance(r, NcState))

    def get_position_mm(self, axis: str) -> float:
        """The axis' position as reported by the NC, mm."""
        return (self.state.demand_mm or {})[axis]

    async def wait_until(self, holds: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not holds():
                self.came.clear()
                await self.came.wait()

    async def wait_for_rest(self, strokes: int) -> None:
        """Wait until the bus has caught up: so many strokes of X are completed, and it rests at the NC's position."""

        def is_at_standstill() -> bool:
            if self.state.motion is not MoveKind.REST:
                return False
            if np.count_nonzero(np.diff(self.select_axis("X")[1] > STROKE_MM / 2)) < strokes:
                return False
            return self.is_at_standstill(1500)

        await self.wait_until(is_at_standstill)

    def is_at_standstill(self, ticks: int) -> bool:
        """Return whether the bus has rested long enough at the NC's position."""
        demand = {axis: self.select_axis(axis, 100)[1][-ticks:] for axis in "XY"}
        return all(
            np.ptp(demand[axis]) == 0 and abs(demand[axis][-1] - self.get_position_mm(axis)) < 0.001 for axis in "XY"
        )


@asynccontextmanager
async def listen_to_machine(config: MachineConfig) -> AsyncIterator[SourceRecorder]:
    received = SourceRecorder()
    async with open_machine(config) as source:
        running = asyncio.create_task(source.run(received.add_record))
        await received.wait_until(lambda: any(isinstance(r, NcState) for r in received.records))
        yield received
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


def build_config(path: Path, twin: SimulatorProcess, port: int) -> MachineConfig:
    """The simulator's machine in fdhil's configuration, with LinuxCNC's bridge as its source of rapids."""
    bus = twin.ready["buses"]["can0"]
    text = path.read_text().replace("[bus.can0]\n", f"[bus.can0]\nport = {bus['port']}\n")
    listener = path.with_name("listener.toml")
    listener.write_text(f'{text}[g0]\nsource = "linuxcnc"\n[nc_source.linuxcnc]\nport = {port}\n')
    return machine_config.load_config(listener)


def find_hal(port: int) -> str:
    return f"{TRUTH}loadusr -Wn {bridge.NAME} /usr/bin/python3 {bridge.__file__} --port {port} --channel 1\n"


def cut_windows(received: SourceRecorder, config: MachineConfig) -> list[WindowOutcome]:
    pipeline = AxisPipeline("X", config)
    records = [r for r in received.records if not isinstance(r, NcState | Notice)]
    return [o for r in records for o in pipeline.process_record(r) if isinstance(o, WindowOutcome)]


def find_first_motion(demand: Float) -> int:
    return int(np.flatnonzero(np.abs(np.diff(demand)) > 1e-3)[0])


@contextmanager
def record_samples(nc: LinuxCnc, path: Path) -> Iterator[None]:
    """Write the sampler's data to a file, one row per servo cycle."""
    with (nc.folder / "log").open("ab") as log, path.open("wb") as rows:
        command = ("stdbuf", "-oL", "halsampler", "-c", "2")
        sampler = nc._start_unprivileged(*command, environment=os.environ, log=log, out=rows.fileno())
        try:
            yield
        finally:
            sampler.terminate()
            sampler.wait()


async def test_bridge_recovers_linuxcnc_sequence(tmp_path: Path) -> None:
    port, path = find_free_port(), write_config(tmp_path, 'pace = "lockstep"\nmodbus = false')
    with SimulatorProcess(path, "--demand", "-") as twin, LinuxCnc(hal=find_hal(port)) as nc:
        config = build_config(path, twin, port)
        with record_samples(nc, tmp_path / "truth"):
            async with listen_to_machine(config) as received:
                with nc.drive_simulator(twin):
                    await asyncio.to_thread(nc.run, PART)
                    await received.wait_for_rest(4)
    truth = np.loadtxt(tmp_path / "truth")
    for axis, column in (("X", 0), ("Y", 1)):
        require_same_sequence(received, axis, truth[:, column], truth[:, 3].astype(int).tolist())
    rapids = [w for w in cut_windows(received, config) if w.window.nc is not None]
    assert [w.window.nc and w.window.nc.line for w in rapids] == [2, 5, 7, 8]


def require_same_sequence(received: SourceRecorder, axis: str, demand: Float, types: Sequence[int]) -> None:
    """Compare with the sampler's data row by row; both begin with the first motion."""
    ticks, bus = received.select_axis(axis)
    offset = int(ticks[find_first_motion(bus)]) - find_first_motion(demand)
    n = min(demand.size, int(ticks[-1]) - offset)
    reported = np.full(n, MoveKind.REST, object)
    for event in received.list_events(axis):
        reported[max(0, event.tick - offset + 1) :] = event.kind
    true = np.array([KINDS[k] for k in types[:n]], object)
    moves = np.abs(np.diff(demand[:n], prepend=demand[0])) > 2e-3
    edges = np.flatnonzero(np.diff(np.array(types[:n])) != 0)
    wrong = [k for k in np.flatnonzero(moves & (reported != true)).tolist() if np.abs(edges - k).min() > 5]
    assert wrong == [], [(k, reported[k], true[k]) for k in wrong[:5]]
    assert set(reported[moves]) == {MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC}


async def test_overrides_and_holds_are_reported_and_their_rapids_refused(tmp_path: Path) -> None:
    port, path = find_free_port(), write_config(tmp_path, 'pace = "lockstep"\nmodbus = false')
    with SimulatorProcess(path, "--demand", "-") as twin, LinuxCnc(hal=find_hal(port)) as nc:
        config = build_config(path, twin, port)
        async with listen_to_machine(config) as received:
            with nc.drive_simulator(twin):
                for value in (0.8, 1.0):
                    await asyncio.to_thread(nc.send_order, "override", value=value)
                    await received.wait_until(lambda value=value: received.state.feed_override == value)  # type: ignore[misc]
                for run, value in enumerate((1.0, 0.9, 1.0), 1):
                    if value != received.state.rapid_override:
                        await asyncio.to_thread(nc.send_order, "rapid_override", value=value)
                    await received.wait_until(lambda value=value: received.state.rapid_override == value)  # type: ignore[misc]
                    await asyncio.to_thread(nc.run, RAPIDS)
                    await received.wait_for_rest(2 * run)
                await asyncio.to_thread(nc.start, RAPIDS)
                await received.wait_until(
                    lambda: received.state.motion is MoveKind.RAPID and received.get_position_mm("X") > 20.0
                )
                await asyncio.to_thread(nc.send_order, "pause")
                await received.wait_until(
                    lambda: received.state.motion is MoveKind.HOLD and received.is_at_standstill(300)
                )
                await asyncio.to_thread(nc.send_order, "resume")
                await asyncio.to_thread(nc.send_order, "rest")
                await received.wait_for_rest(8)
    outcomes = cut_windows(received, config)
    texts = [str(o.verdict.reasons[0]) for o in outcomes if not o.verdict.accepted]
    accepted = [o.window.nc for o in outcomes if o.verdict.accepted]
    assert {nc and (nc.override, nc.held) for nc in accepted} == {((1.0, 1.0), False)}, texts
    assert len(accepted) >= 4, [(o.window.start_tick, o.window.nc, str(o.verdict.reasons)) for o in outcomes]
    assert [t for t in texts if "an override of 90 % in line" in t and t.startswith("EpisodeAborted")], texts
    assert [t for t in texts if "a feed hold in line 2" in t], texts
