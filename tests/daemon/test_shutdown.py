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
from fdhil.daemon.service import Service
from fdhil.daemon.shutdown import Budgets, Shutdown
from fdhil.errors import ConnectError, DeviceError
from tests.daemon.machine import Machine, config_of

UNIT = Path(__file__).parents[2] / "systemd" / "fdhil.service"


@pytest.fixture(autouse=True)
def _quick_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.service.warm", lambda config, method: None)


class ClosingMachine(Machine):
    def __init__(self, error: Exception | None = None) -> None:
        super().__init__()
        self.error = error
        self.released, self.running = asyncio.Event(), asyncio.Event()

    @asynccontextmanager
    async def open(self, config: MachineConfig) -> AsyncIterator[Machine]:
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


async def stopped(service: Service, running: asyncio.Event) -> None:
    task = asyncio.create_task(service.run())
    await asyncio.wait([task, asyncio.create_task(running.wait())], return_when=asyncio.FIRST_COMPLETED)
    os.kill(os.getpid(), signal.SIGTERM)
    await task


@pytest.mark.parametrize("error", [ConnectError("can0", "went away"), OSError("bad descriptor"), RuntimeError("bug")])
async def test_daemon_stops_while_its_source_fails_at_closing(tmp_path: Path, error: Exception) -> None:
    machine = ClosingMachine(error)
    await stopped(Service(config_of(tmp_path), machine.open), machine.running)
    assert machine.opened == 1


async def test_daemon_stops_between_two_failures_of_its_source(tmp_path: Path) -> None:
    machine = Machine()
    seen = asyncio.Event()

    @asynccontextmanager
    async def open_source(config: MachineConfig) -> AsyncIterator[Machine]:
        async with machine.open(config) as source:
            machine.give(DeviceError("can0", "went away"))
            if machine.opened == 2:
                seen.set()
            yield source

    await stopped(Service(config_of(tmp_path), open_source), seen)


@pytest.mark.usefixtures("real_time")
async def test_device_that_does_not_close_is_reported_and_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine, left = ClosingMachine(), list[int]()
    service = Service(config_of(tmp_path), machine.open, None, replace(Budgets(), source_s=0.01), left.append)
    await stopped(service, machine.running)
    service.shutdown.leave_overrun()
    service.shutdown.end()
    assert "closing buses and sensors is not finished after 0.01 s and is abandoned" in capsys.readouterr().err
    assert left == [3]
    machine.released.set()


async def test_disk_that_does_not_answer_is_reported_and_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    disk_answers, machine = threading.Event(), ClosingMachine(ConnectError("can0", "went away"))
    service = Service(config_of(tmp_path), machine.open, None, replace(Budgets(), store_s=0.01))
    close: Callable[[], Any] = service._store.close
    monkeypatch.setattr(service._store, "close", lambda: (disk_answers.wait(), close()))
    try:
        await stopped(service, machine.running)
        assert "closing the store is not finished after 0.01 s and is abandoned" in capsys.readouterr().err
    finally:
        disk_answers.set()


def test_process_that_has_not_stopped_in_time_is_ended() -> None:
    left, ended = list[int](), threading.Event()

    def leave(code: int) -> None:
        left.append(code)
        ended.set()

    shutdown = Shutdown(0.0, leave)
    shutdown.begin()
    shutdown.begin()
    ended.wait()
    assert left == [3]


def test_systemd_waits_longer_than_all_steps_take() -> None:
    (stop_s,) = (line.split("=")[1] for line in UNIT.read_text().splitlines() if line.startswith("TimeoutStopSec="))
    assert float(stop_s) > Budgets().total_s
