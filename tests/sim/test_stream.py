"""A demand that arrives row by row: lead, gaps, invalid rows, and the NC that plays it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from fdhil.records import Float
from fdhil.sim.nc.stream import LEAD_S, LONG_REST_S, DemandStream, StreamError
from tests.sim.bench_twin import PERIOD_S, TwinInHand, corner, trajectory, twin_config
from tests.sim.twin_process import TwinProcess, write_config

LEAD = round(LEAD_S / PERIOD_S)
HEAD = "time_s,X_mm,Y_mm"


def lines_of(rows: Float, first: int = 0) -> list[str]:
    return [f"{(first + k) * PERIOD_S:.6f},{x:.9f},{y:.9f}" for k, (x, y) in enumerate(rows)]


def stream_with(lines: Iterable[str]) -> DemandStream:
    stream = DemandStream("XY", PERIOD_S)
    for line in (HEAD, *lines):
        stream.take(line)
    return stream


def moving(rows: int, first: int = 0) -> Float:
    return np.column_stack([np.arange(first, first + rows) * 0.01, np.zeros(rows)])


def played(stream: DemandStream, steps: int) -> list[list[float]]:
    return [stream.step(1.0)[0] for _ in range(steps)]


def test_nothing_is_begun_before_the_lead_is_there() -> None:
    rows = moving(LEAD)
    assert stream_with(lines_of(rows[:-1])).start_mm is None
    stream = stream_with(lines_of(rows))
    assert stream.start_mm == [0.0, 0.0]
    assert np.allclose(played(stream, LEAD), rows)
    assert (stream.rows, stream.starved) == (LEAD, 0)


def test_a_hole_in_a_motion_is_counted_and_the_lead_is_taken_anew() -> None:
    stream = stream_with(lines_of(moving(LEAD)))
    last = played(stream, LEAD)[-1]
    assert stream.runs_dry
    assert played(stream, 20) == [last] * 20
    later = lines_of(moving(LEAD, first=LEAD), first=LEAD)
    for line in later[:-1]:
        stream.take(line)
    assert played(stream, 1) == [last]
    stream.take(later[-1])
    assert played(stream, 1)[0][0] > last[0]
    assert (stream.rows, stream.starved) == (LEAD + 1, 21)


def test_a_hole_in_a_rest_is_none() -> None:
    stream = stream_with(lines_of(np.zeros((LEAD, 2))))
    played(stream, LEAD + 500)
    assert stream.starved == 0


def test_a_machine_that_is_behind_makes_up_for_it_in_long_rests_alone() -> None:
    rest = round(LONG_REST_S / PERIOD_S)
    ways = np.vstack([moving(10), np.repeat(moving(10)[-1:], 4 * rest, axis=0), moving(10)])
    stream = stream_with(lines_of(ways))
    stream.close()
    way_mm = np.array(played(stream, len(ways)))[:, 0]
    moves = (np.flatnonzero(np.diff(way_mm)) + 1).tolist()
    again = moves[9]
    assert moves == [*range(1, 10), *range(again, again + 10)]
    assert again - 9 == pytest.approx(rest + LEAD, abs=LEAD / 10)


def test_the_end_plays_what_is_left() -> None:
    stream = stream_with(lines_of(moving(3)))
    stream.close()
    assert np.allclose(played(stream, 3), moving(3))
    assert stream.ended


def test_a_rest_before_the_first_motion_is_no_longer_than_the_lead() -> None:
    stream = stream_with(lines_of(np.zeros((20 * LEAD, 2))))
    assert not stream.late
    assert played(stream, LEAD + 1)[-1] == [0.0, 0.0]
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
def test_a_wrong_row_ends_the_stream_with_its_reason(lines: Sequence[str], what: str) -> None:
    stream = DemandStream("XY", PERIOD_S)
    for line in lines[:-1]:
        stream.take(line)
    with pytest.raises(StreamError, match=what):
        stream.take(lines[-1])
    stream.take(HEAD)
    stream.take("9,9,9")
    played(stream, 5)
    assert stream.ended


def test_the_nc_plays_a_stream_as_it_plays_a_file() -> None:
    rows = corner() + 3.0
    tables = []
    for source in ("file", "stream"):
        twin = TwinInHand(twin_config())
        twin.switch_on()
        stream = stream_with(lines_of(rows))
        stream.close()
        twin.machine.nc.play(source, trajectory(rows) if source == "file" else stream)
        finished = twin.run_until("finished")
        assert (finished["rows"], finished["stopped"]) == (len(rows), False)
        tables.append(twin.table)
    assert np.array_equal(tables[0], tables[1])


def test_sync_goes_on_and_the_axes_stand_while_no_row_comes() -> None:
    twin = TwinInHand(twin_config())
    twin.switch_on()
    stream = stream_with([])
    twin.machine.nc.play("stream", stream)
    twin.run(200)
    assert not any(event["event"] in ("playing", "finished") for event in twin.events)
    for line in lines_of(np.vstack([moving(LEAD), np.repeat(moving(LEAD)[-1:], 100, axis=0)])):
        stream.take(line)
    assert twin.run_until("playing")["rows"] is None
    twin.run(LEAD + 600)
    syncs = sum(can_id == 0x80 for can_id, _ in twin.wire[-5000:])
    assert syncs > 300
    assert twin.table[-1][0] == pytest.approx(moving(LEAD)[-1, 0], abs=2e-3)
    stream.close()
    assert twin.run_until("finished")["starved"] == 0


def test_a_stream_without_rows_and_one_that_is_stopped_end() -> None:
    twin = TwinInHand(twin_config())
    twin.switch_on()
    stream = stream_with([])
    twin.machine.nc.play("stream", stream)
    twin.run(5)
    stream.close()
    assert twin.run_until("finished", 10)["rows"] == 0
    twin.machine.nc.play("stream", stream_with([]))
    twin.run(5)
    twin.machine.nc.stop()
    assert twin.run_until("finished", 10)["stopped"]


@pytest.mark.usefixtures("processes")
def test_rows_and_commands_come_by_standard_input(tmp_path: Path) -> None:
    path = write_config(tmp_path, 'pace = "lockstep"')
    rows = corner() + 2.0
    with TwinProcess(path, "--demand", "-") as twin:
        twin.send_line(HEAD)
        twin.command("trace", file=str(tmp_path / "trace.csv"))
        twin.send_line("\n".join(lines_of(rows)))  # all at once: a hole would not be waited for long
        twin.send_line("0,0,0")
        assert "follows that of" in twin.event("error")["text"]
        twin.close_panel()
        finished = twin.event("finished")
    assert (finished["rows"], finished["starved"]) == (len(rows), 0)
    table = np.genfromtxt(tmp_path / "trace.csv", delimiter=",", names=True)
    assert table["X_reference_mm"][: len(rows)] == pytest.approx(rows[:, 0], abs=1e-8)
