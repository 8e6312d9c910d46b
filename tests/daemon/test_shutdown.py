"""The daemon stops on request, whatever its devices, its disk and its libraries do."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.config import MachineConfig
from fdhil.daemon.daemon_service import DaemonService
from fdhil.daemon.shutdown import Shutdown, StepBudgets
from fdhil.errors import ConnectError, DeviceError
from tests.daemon.simulated_machine import SimulatedMachine, config_of

UNIT = Path(__file__).parents[2] / "systemd" / "fdhil.service"


@pytest.fixture(autouse=True)
def _skip_kernel_warmup(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)


class ClosingMachine(SimulatedMachine):
    def __init__(self, error: Exception | None = None) -> None:
        super().__init__()
        self.error = error
        self.released, self.running = asyncio.Event(), asyncio.Event()

    @asynccontextmanager
    async def open(self, config: MachineConfig) -> AsyncIterator[SimulatedMachine]:
        self.opened += 1
        self.running.set()
        try:
            yield self
        finally:
            if self.error is not None:
                raise self.error
            while not self.released.is_set():
                try:
                    await self.released.wait()
                except asyncio.CancelledError:
                    continue


async def stopped(service: DaemonService, running: asyncio.Event) -> None:
    task = asyncio.create_task(service.run())
    await asyncio.wait([task, asyncio.create_task(running.wait())], return_when=asyncio.FIRST_COMPLETED)
    os.kill(os.getpid(), signal.SIGTERM)
    await task


@pytest.mark.parametrize("error", [ConnectError("can0", "went away"), OSError("bad descriptor"), RuntimeError("bug")])
async def test_daemon_stops_while_closing_its_source_fails(tmp_path: Path, error: Exception) -> None:
    machine = ClosingMachine(error)
    await stopped(DaemonService(config_of(tmp_path), machine.open), machine.running)
    assert machine.opened == 1


async def test_daemon_stops_between_two_failures_of_its_source(tmp_path: Path) -> None:
    machine = SimulatedMachine()
    seen = asyncio.Event()

    @asynccontextmanager
    async def open_source(config: MachineConfig) -> AsyncIterator[SimulatedMachine]:
        async with machine.open(config) as source:
            machine.give(DeviceError("can0", "went away"))
            if machine.opened == 2:
                seen.set()
            yield source

    await stopped(DaemonService(config_of(tmp_path), open_source), seen)


@pytest.mark.usefixtures("real_time")
async def test_device_that_does_not_close_is_reported_and_abandoned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine, left = ClosingMachine(), list[int]()
    service = DaemonService(config_of(tmp_path), machine.open, None, replace(StepBudgets(), source_s=0.01), left.append)
    await stopped(service, machine.running)
    service.shutdown.leave_overrun()
    service.shutdown.cancel_deadline()
    assert "closing buses and sensors is not finished after 0.01 s and is abandoned" in capsys.readouterr().err
    assert left == [3]
    machine.released.set()


async def test_hanging_disk_is_reported_and_abandoned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    disk_answers, machine = threading.Event(), ClosingMachine(ConnectError("can0", "went away"))
    service = DaemonService(config_of(tmp_path), machine.open, None, replace(StepBudgets(), store_s=0.01))
    close: Callable[[], Any] = service._store.close
    monkeypatch.setattr(service._store, "close", lambda: (disk_answers.wait(), close()))
    try:
        await stopped(service, machine.running)
        assert "closing the store is not finished after 0.01 s and is abandoned" in capsys.readouterr().err
    finally:
        disk_answers.set()


def test_process_that_stops_too_late_is_ended() -> None:
    left, ended = list[int](), threading.Event()

    def leave(code: int) -> None:
        left.append(code)
        ended.set()

    shutdown = Shutdown(0.0, leave)
    shutdown.start_deadline()
    shutdown.start_deadline()
    ended.wait()
    assert left == [3]


def test_systemd_timeout_exceeds_all_steps() -> None:
    (stop_s,) = (line.split("=")[1] for line in UNIT.read_text().splitlines() if line.startswith("TimeoutStopSec="))
    assert float(stop_s) > StepBudgets().total_s
