"""The daemon as a kind of record: it receives rapids; those its store took without a fault are acknowledged."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import patch

from fdhil.config import MachineConfig
from fdhil.daemon import daemon_service
from fdhil.daemon.daemon_service import DaemonService, InternalError
from fdhil.daemon.outcome_store import WINDOWS_FOLDER, OutcomeStore
from fdhil.errors import FdhilError
from fdhil.records import Notice, Outcome, ParameterSet, WindowOutcome
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from tests.crash.stored_records import check_readable, configured
from tests.daemon.simulated_machine import SimulatedMachine, rapids

RAPIDS = 2
FIRST_RAPID = 403  # the tick at which it begins
SETS = 100_000  # what a revision is numbered from, so that it is no rapid


class Daemon:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.said: list[str] = []

    def keep(self, number: int) -> None:
        del number
        _run(self.folder, lambda **_: None)

    def found(self) -> set[int]:
        if not (self.folder / HISTORY_FILE_NAME).exists():
            return set()
        with History.open_read_only(self.folder) as history:
            windows, sets = history.read_windows("X"), history.read_revisions("X")
        whole = []
        for row in windows[-RAPIDS:]:
            if (window := check_readable(self.folder / WINDOWS_FOLDER / row.file)) is not None:
                assert window.start_tick == row.start_tick
                whole.append(row.start_tick)
        return {
            *whole,
            *(row.start_tick for row in windows[:-RAPIDS]),
            *(SETS + result.set.revision for result in sets),
        }

    def close(self) -> None:
        """Nothing is open."""


def run_daemon(folder: Path, tell: Callable[..., None]) -> None:
    try:
        _run(folder, tell)
    except InternalError as error:
        raise AssertionError(str(error)) from None
    except FdhilError as error:
        tell(refused=str(error))


def _run(folder: Path, tell: Callable[..., None]) -> None:
    asyncio.run(_served(configured(folder), tell))


async def _served(config: MachineConfig, tell: Callable[..., None]) -> None:
    daemon, loop, received = (
        DaemonService(config, SimulatedMachine(rapids(config, count=RAPIDS)).open),
        asyncio.get_running_loop(),
        0,
    )
    before = OutcomeStore.store_outcomes

    def keep(self: OutcomeStore, outcomes: Sequence[Outcome]) -> list[Notice]:
        nonlocal received
        notices = before(self, outcomes)
        for number in map(_number, outcomes) if self.fault is None else ():
            if number is not None:
                tell(kept=number)
        for notice in notices:
            if notice.severity == "MAJOR":
                tell(refused=notice.text)
        received += sum(isinstance(outcome, WindowOutcome) for outcome in outcomes)
        if received >= RAPIDS:
            loop.call_soon_threadsafe(daemon._stop.set)
        return notices

    warmed = patch.object(daemon_service, "compile_kernels", lambda *_: None)  # the kernels are compiled already
    with warmed, patch.object(OutcomeStore, "store_outcomes", keep):
        await daemon.run()


def _number(outcome: Outcome) -> int | None:
    if isinstance(outcome, WindowOutcome):
        return outcome.window.start_tick
    return SETS + outcome.revision if isinstance(outcome, ParameterSet) else None
