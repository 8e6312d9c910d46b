"""A demand that arrives row by row: lead, gaps, invalid rows, and the NC that plays it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from fdhil.records import Float
from fdhil.sim.nc.demand_stream import LEAD_S, LONG_REST_S, DemandStream, StreamError
from tests.sim.bench_simulator import (
    PERIOD_S,
    SteppedSimulator,
    build_corner_rows,
    build_simulator_config,
    build_trajectory,
)
from tests.sim.simulator_process import SimulatorProcess, write_config

LEAD = round(LEAD_S / PERIOD_S)
HEAD = "time_s,X_mm,Y_mm"


def format_lines(rows: Float, first: int = 0) -> list[str]:
    return [f"{(first + k) * PERIOD_S:.6f},{x:.9f},{y:.9f}" for k, (x, y) in enumerate(rows)]


def create_stream(lines: Iterable[str]) -> DemandStream:
    stream = DemandStream("XY", PERIOD_S)
    for line in (HEAD, *lines):
        stream.receive_line(line)
    return stream


def build_moving_rows(rows: int, first: int = 0) -> Float:
    return np.column_stack([np.arange(first, first + rows) * 0.01, np.zeros(rows)])


def play_rows(stream: DemandStream, steps: int) -> list[list[float]]:
    return [stream.play_row(1.0)[0] for _ in range(steps)]


def test_stream_starts_only_with_full_lead() -> None:
    rows = build_moving_rows(LEAD)
    assert create_stream(format_lines(rows[:-1])).start_mm is None
    stream = create_stream(format_lines(rows))
    assert stream.start_mm == [0.0, 0.0]
    assert np.allclose(play_rows(stream, LEAD), rows)
    assert (stream.rows, stream.starved) == (LEAD, 0)


def test_gap_in_motion_is_counted_and_lead_is_rebuilt() -> None:
    stream = create_stream(format_lines(build_moving_rows(LEAD)))
    last = play_rows(stream, LEAD)[-1]
    assert stream.runs_dry
    assert play_rows(stream, 20) == [last] * 20
    later = format_lines(build_moving_rows(LEAD, first=LEAD), first=LEAD)
    for line in later[:-1]:
        stream.receive_line(line)
    assert play_rows(stream, 1) == [last]
    stream.receive_line(later[-1])
    assert play_rows(stream, 1)[0][0] > last[0]
    assert (stream.rows, stream.starved) == (LEAD + 1, 21)


def test_gap_at_rest_is_not_counted() -> None:
    stream = create_stream(format_lines(np.zeros((LEAD, 2))))
    play_rows(stream, LEAD + 500)
    assert stream.starved == 0


def test_late_machine_catches_up_in_long_rests_only() -> None:
    rest = round(LONG_REST_S / PERIOD_S)
    ways = np.vstack(
        [build_moving_rows(10), np.repeat(build_moving_rows(10)[-1:], 4 * rest, axis=0), build_moving_rows(10)]
    )
    stream = create_stream(format_lines(ways))
    stream.close_stream()
    way_mm = np.array(play_rows(stream, len(ways)))[:, 0]
    moves = (np.flatnonzero(np.diff(way_mm)) + 1).tolist()
    again = moves[9]
    assert moves == [*range(1, 10), *range(again, again + 10)]
    assert again - 9 == pytest.approx(rest + LEAD, abs=LEAD / 10)


def test_end_of_stream_plays_buffered_rows() -> None:
    stream = create_stream(format_lines(build_moving_rows(3)))
    stream.close_stream()
    assert np.allclose(play_rows(stream, 3), build_moving_rows(3))
    assert stream.has_ended


def test_rest_before_first_motion_is_limited_to_lead() -> None:
    stream = create_stream(format_lines(np.zeros((20 * LEAD, 2))))
    assert not stream.is_behind
    assert play_rows(stream, LEAD + 1)[-1] == [0.0, 0.0]
    assert stream.rows == LEAD


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        (["time_s,X_mm"], "column Y_mm is missing; a demand starts with time_s,X_mm,Y_mm"),
        ([HEAD, "0,1,two"], "'0,1,two' is not a list of 3 finite numbers"),
        ([HEAD, "0,1,nan"], "not a list of 3 finite numbers"),
        ([HEAD, "0,1"], "not a list of 3 finite numbers"),
        ([HEAD, "0.000,0,0", "0.002,0,0"], "the row of 0.002 s follows that of 0 s; rows are one SYNC"),
    ],
)
def test_invalid_row_ends_stream_with_reason(lines: Sequence[str], what: str) -> None:
    stream = DemandStream("XY", PERIOD_S)
    for line in lines[:-1]:
        stream.receive_line(line)
    with pytest.raises(StreamError, match=what):
        stream.receive_line(lines[-1])
    stream.receive_line(HEAD)
    stream.receive_line("9,9,9")
    play_rows(stream, 5)
    assert stream.has_ended


def test_nc_plays_stream_like_file() -> None:
    rows = build_corner_rows() + 3.0
    tables = []
    for source in ("file", "stream"):
        twin = SteppedSimulator(build_simulator_config())
        twin.switch_on()
        stream = create_stream(format_lines(rows))
        stream.close_stream()
        twin.machine.nc.play_demand(source, build_trajectory(rows) if source == "file" else stream)
        finished = twin.run_until("finished")
        assert (finished["rows"], finished["stopped"]) == (len(rows), False)
        tables.append(twin.table)
    assert np.array_equal(tables[0], tables[1])


def test_sync_continues_and_axes_hold_while_no_row_comes() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    stream = create_stream([])
    twin.machine.nc.play_demand("stream", stream)
    twin.run_cycles(200)
    assert not any(event["event"] in ("playing", "finished") for event in twin.events)
    for line in format_lines(
        np.vstack([build_moving_rows(LEAD), np.repeat(build_moving_rows(LEAD)[-1:], 100, axis=0)])
    ):
        stream.receive_line(line)
    assert twin.run_until("playing")["rows"] is None
    twin.run_cycles(LEAD + 600)
    syncs = sum(can_id == 0x80 for can_id, _ in twin.wire[-5000:])
    assert syncs > 300
    assert twin.table[-1][0] == pytest.approx(build_moving_rows(LEAD)[-1, 0], abs=2e-3)
    stream.close_stream()
    assert twin.run_until("finished")["starved"] == 0


def test_empty_and_stopped_streams_end() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    stream = create_stream([])
    twin.machine.nc.play_demand("stream", stream)
    twin.run_cycles(5)
    stream.close_stream()
    assert twin.run_until("finished", 10)["rows"] == 0
    twin.machine.nc.play_demand("stream", create_stream([]))
    twin.run_cycles(5)
    twin.machine.nc.stop_path()
    assert twin.run_until("finished", 10)["stopped"]


@pytest.mark.usefixtures("processes")
def test_rows_and_commands_are_read_from_standard_input(tmp_path: Path) -> None:
    path = write_config(tmp_path, 'pace = "lockstep"')
    rows = build_corner_rows() + 2.0
    with SimulatorProcess(path, "--demand", "-") as twin:
        twin.send_line(HEAD)
        twin.send_command("trace", file=str(tmp_path / "trace.csv"))
        twin.send_line("\n".join(format_lines(rows)))  # all at once: a hole would not be waited for long
        twin.send_line("0,0,0")
        assert "follows that of" in twin.wait_for_event("error")["text"]
        twin.close_panel()
        finished = twin.wait_for_event("finished")
    assert (finished["rows"], finished["starved"]) == (len(rows), 0)
    table = np.genfromtxt(tmp_path / "trace.csv", delimiter=",", names=True)
    assert table["X_reference_mm"][: len(rows)] == pytest.approx(rows[:, 0], abs=1e-8)
