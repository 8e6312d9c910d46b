"""Long operation of the daemon: once its buffers are full, further rapids and clients use no more memory."""

from __future__ import annotations

import asyncio
import gc
import socket
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.can.node_monitor import NodeMonitor
from fdhil.pipeline import Record
from fdhil.records import AxisSamples, MoveEvent, Notice, TickTimes, freeze_integers
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving, status_when

FULL = 36  # rapids after which the longest memory of the pipeline, 32 windows, is full
ROUNDS = 8
RAPIDS = 2  # of a round
BLOCKS_A_RAPID = 60  # of memory: what the collector has not looked at comes and goes; a stored window is a thousand
EMERGENCIES = 100_000
EMERGENCY = 0x081


def later(records: Sequence[Record], ticks: int, period_s: float) -> list[Record]:
    shifted: list[Record] = []
    for record in records:
        if isinstance(record, AxisSamples):
            shifted.append(replace(record, tick=freeze_integers(record.tick + ticks)))
        elif isinstance(record, TickTimes):
            t_ns = freeze_integers(record.t_ns + round(ticks * period_s * 1e9))
            shifted.append(TickTimes(freeze_integers(record.tick + ticks), t_ns))
        else:
            assert isinstance(record, MoveEvent)
            shifted.append(replace(record, tick=record.tick + ticks))
    return shifted


def look_on_and_leave(path: Path) -> None:
    for output in (b'{"request": "live"}\n', b'{"request": "sta'):
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
            client.sendall(output)
            if output.endswith(b"\n"):
                client.recv(10)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.fault("F10")
async def test_further_rapids_and_clients_do_not_grow_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "fdhil.daemon.live_stream.ALIVE_S", 0.05
    )  # how soon a viewer's end is seen where nothing passes
    config = config_of(tmp_path, store={"keep_windows": 4})
    machine, period_s = SimulatedMachine(), config.machine.sync_period_s
    two = rapids(config, count=RAPIDS)
    length = 1 + max(int(np.max(record.tick)) for record in two if isinstance(record, AxisSamples))
    used: list[tuple[int, int, int, int]] = []
    async with serving(config, machine) as path:
        for done in range(RAPIDS, FULL + ROUNDS * RAPIDS + 1, RAPIDS):
            machine.give(*later(two, done // RAPIDS * length, period_s))
            machine.give(Notice("StuckValue", "minor", f"rapid {done}", "X"))
            await asyncio.to_thread(look_on_and_leave, path)
            status = await status_when(
                path, lambda s, n=done: s["axes"]["X"]["accepted"] + s["axes"]["X"]["refused"] == n
            )
            while any("ControlServer._accept" in repr(task) for task in asyncio.all_tasks()):  # noqa: ASYNC110 - no event
                await asyncio.sleep(0.01)  # a client has left, its task not yet
            gc.collect()
            descriptors = len(list(Path("/proc/self/fd").iterdir()))
            used.append((sys.getallocatedblocks(), len(gc.get_objects()), len(asyncio.all_tasks()), descriptors))
    assert status["axes"]["X"]["refused"] == 0
    blocks, containers, tasks, opened = zip(*used[FULL // RAPIDS :], strict=True)
    assert blocks[-1] - blocks[0] < BLOCKS_A_RAPID * RAPIDS * ROUNDS, blocks
    assert containers[-1] - containers[0] < BLOCKS_A_RAPID * RAPIDS * ROUNDS, containers
    assert max(tasks) - min(tasks) <= 2, tasks
    assert max(opened) - min(opened) <= 4, opened


@pytest.mark.fault("A21", "F10")
def test_flood_of_emergencies_is_counted_without_growing_memory() -> None:
    watch = NodeMonitor("X", 1)
    rng = np.random.default_rng(1)
    result, blocks = [], []
    for start in range(0, EMERGENCIES, 1000):
        codes = rng.integers(0x0100, 0xFFFF, 1000).tolist()
        flood = [(start * 1000, EMERGENCY, code.to_bytes(2, "little") + bytes(6)) for code in codes]
        result += watch.watch_frames(pack_frames(flood), start)
        del flood, codes
        blocks.append(sys.getallocatedblocks())
    assert watch.emcy_count == EMERGENCIES
    assert len(result) <= 32
    assert blocks[-1] - blocks[len(blocks) // 2] < 100, blocks
