"""An NC that reports its moves: its report of a rapid reaches history and status with the window."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fdhil.pipeline import Record
from fdhil.records import MoveEvent, MoveKind, NcMove, NcState, Notice
from fdhil.store.history_database import History
from fdhil.store.window_file import list_windows, read_window
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving, status_when


def said(records: Sequence[Record], moves: Sequence[NcMove]) -> list[Record]:
    result = iter(moves)
    return [
        replace(record, nc=next(result)) if isinstance(record, MoveEvent) and record.kind is MoveKind.RAPID else record
        for record in records
    ]


async def test_nc_report_of_a_rapid_is_stored_with_its_window(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    moves = [NcMove(12, "part.ngc", (1.0, 1.0), False), NcMove(14, "part.ngc", (0.7, 0.7), False)]
    state = NcState(time.monotonic_ns(), 1000, MoveKind.RAPID, 14, rapid_override=0.7, program="/nc/part.ngc")
    machine = SimulatedMachine(said(rapids(config, count=2), moves))
    machine.give(state, Notice("BusSilent", "MAJOR", "nothing is heard"))
    async with serving(config, machine) as path:
        status = await status_when(path, lambda s: s["axes"]["X"]["accepted"] and s["axes"]["X"]["refused"])
    assert status["nc"]["line"] == 14
    assert status["axes"]["X"]["refused_by"] == {"EpisodeAborted": 1}
    assert status["axes"]["X"]["last_window"]["nc"]["override"] == [0.7, 0.7]
    texts = {notice["code"]: notice["text"] for notice in status["notices"]}
    assert texts["BusSilent"] == "nothing is heard (the NC is at line 14 of part.ngc)"
    assert "rapid override is 70 %" in texts["OverrideChanged"]
    with History.open_read_only(config.store.directory) as history:
        first, second = history.read_windows("X")
    assert [window.nc and window.nc["line"] for window in (first, second)] == [12, 14]
    assert second.reasons[0] == "EpisodeAborted: the NC reports an override of 70 % in line 14"
    stored = [read_window(file.path).nc for file in list_windows(config.store.directory / "windows").windows]
    assert moves[0] in stored
