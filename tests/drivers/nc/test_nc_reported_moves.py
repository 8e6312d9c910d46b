"""The kind of a move comes from the NC, its edges from the demand on the bus: exact with every source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.moves.nc_reported_moves import NcReportedMoves
from fdhil.records import AxisSamples, Float, MoveEvent, MoveKind, NcState, TickTimes, freeze_array, freeze_integers
from tests.drivers.frame_builder import build_machine_config

MS = 1_000_000
RAPID, FEED, ARC, REST, HOLD, UNKNOWN = MoveKind
INCREMENT_MM = 20 / 65536


@dataclass(frozen=True)
class Part:
    """A piece of a program: its kind, its line, and its set-points relative to its start, 1 ms apart."""

    kind: MoveKind
    line: int
    demand: Float


def ramp(distance_mm: float, speed_mm_s: float, acceleration: float = 4000.0) -> Float:
    ramp_s = speed_mm_s / acceleration
    t = np.arange(1, round(1e3 * (abs(distance_mm) / speed_mm_s + ramp_s)) + 1) * 1e-3
    speed = np.clip(np.minimum(t, t[-1] - t + 1e-3) * acceleration, 0, speed_mm_s)
    return np.asarray(np.cumsum(speed) / np.sum(speed) * distance_mm)


def rest(ms: int) -> Part:
    return Part(REST, 0, np.zeros(ms))


def rapid(mm: float, line: int = 1, speed: float = 500.0) -> Part:
    return Part(RAPID, line, ramp(mm, speed))


def feed(mm: float, line: int = 2, speed: float = 100.0) -> Part:
    return Part(FEED, line, ramp(mm, speed))


PROGRAM = (rest(300), rapid(200), rest(50), feed(30), rapid(-230, 3), rest(40), Part(ARC, 4, ramp(20, 50)), rest(400))


@dataclass(frozen=True)
class MoveSequence:
    """The NC's command in each of its cycles, and the first cycle of each part with its kind."""

    demand_mm: Float
    kind: Sequence[MoveKind]
    line: Sequence[int]
    edges: Sequence[tuple[int, MoveKind]]


def build_sequence(parts: Sequence[Part]) -> MoveSequence:
    demand, kind, line, edges, place = [np.zeros(0)], list[MoveKind](), list[int](), [], 0.0
    for part in parts:
        edges.append((len(kind), part.kind))
        demand.append(place + part.demand)
        place += float(part.demand[-1])
        kind += [part.kind] * part.demand.size
        line += [part.line] * part.demand.size
    return MoveSequence(np.concatenate(demand), kind, line, edges)


def report_every_cycle(told: MoveSequence, zero_ns: int, first_cycle: int = 5000) -> list[NcState]:
    """Behave as the bridge: each change with the cycle before it, and every tenth cycle."""
    n = len(told.kind)
    change = [k for k in range(1, n) if (told.kind[k], told.line[k]) != (told.kind[k - 1], told.line[k - 1])]
    tell = sorted({*range(0, n, 10), *change, *(k - 1 for k in change)})
    return [
        NcState(
            zero_ns + k * MS, 2 * MS, told.kind[k], told.line[k] or None, rapid_override=1.0, feed_override=1.0,
            feed_hold=False, program="part.ngc", demand_mm={"X": float(told.demand_mm[k])}, nc_tick=first_cycle + k,
            nc_period_s=0.001,
        )
        for k in tell
    ]  # fmt: skip


def report_polled(told: MoveSequence, zero_ns: int, period: int = 100) -> list[NcState]:
    """Behave as a polled source: an answer may be a whole period old."""
    return [
        NcState(zero_ns + k * MS, period * MS, told.kind[k], told.line[k] or None, rapid_override=1.0)
        for k in range(0, len(told.kind), period)
    ]


def detect_moves(
    told: MoveSequence,
    states: Sequence[NcState],
    lag: int,
    source: NcReportedMoves | None = None,
    *,
    block: int = 50,
    first: int = 0,
) -> list[MoveEvent]:
    """Run the bus: the NC's cycle k is at tick ``first`` + k + lag, from its own zero; SYNC k comes at k ms."""
    source = source or NcReportedMoves("X", build_machine_config(g0={"source": "linuxcnc"}))
    bus = np.concatenate([np.zeros(lag), told.demand_mm, np.full(500, told.demand_mm[-1])])
    bus = np.round(bus / INCREMENT_MM) * INCREMENT_MM + 17.0
    waiting, events = list(states), []
    zeros = np.zeros(bus.size)
    for begin in range(0, bus.size, block):
        ticks = first + np.arange(begin, min(begin + block, bus.size))
        events += source.detect_moves(TickTimes(freeze_integers(ticks), freeze_integers(ticks * MS)))
        while waiting and waiting[0].stamp_ns <= ticks[-1] * MS:
            events += source.detect_moves(waiting.pop(0))
        part = freeze_array(zeros[: ticks.size])
        rows = freeze_array(bus[ticks - first])
        events += source.detect_moves(
            AxisSamples("X", freeze_integers(ticks), rows, part, part, part, None, part, freeze_integers(part))
        )
    return events


def list_edges(events: Sequence[MoveEvent]) -> list[tuple[MoveKind, int]]:
    return [(event.kind, event.tick) for event in events]


def list_true_edges(told: MoveSequence, lag: int) -> list[tuple[MoveKind, int]]:
    """Return the moves of the program: a part begins with the previous one's last tick; none follows itself."""
    return [(kind, lag + cycle - 1) for cycle, kind in told.edges[1:]]


@pytest.mark.parametrize("lag", [0, 3, 40, 700])
def test_reported_set_points_align_exactly_despite_bus_delay(lag: int) -> None:
    reported = build_sequence(PROGRAM)
    found = [e for e in list_edges(detect_moves(reported, report_every_cycle(reported, 0), lag)) if e[0] is not REST]
    true = [e for e in list_true_edges(reported, lag) if e[0] is not REST]
    assert [kind for kind, _ in found] == [kind for kind, _ in true]
    np.testing.assert_allclose([tick for _, tick in found], [tick for _, tick in true], atol=1)


def test_line_program_and_override_come_with_the_move() -> None:
    reported = build_sequence(PROGRAM)
    rapids = [e for e in detect_moves(reported, report_every_cycle(reported, 0), 3) if e.kind is RAPID]
    assert [e.nc and (e.nc.line, e.nc.program, e.nc.override, e.nc.held) for e in rapids] == [
        (1, "part.ngc", (1.0, 1.0), False), (3, "part.ngc", (1.0, 1.0), False),
    ]  # fmt: skip


@pytest.mark.parametrize("period", [20, 50, 100])
@pytest.mark.parametrize("late", [0, 7])
def test_rarely_polled_source_gives_the_edges_of_the_demand(period: int, late: int) -> None:
    reported = build_sequence([rest(500), rapid(300), rest(300), feed(60), rest(300), rapid(-360, 3), rest(500)])
    found = list_edges(detect_moves(reported, report_polled(reported, late * MS, period), 0))
    assert [kind for kind, _ in found] == [RAPID, REST, FEED, REST, RAPID, REST]
    np.testing.assert_allclose([tick for _, tick in found], [tick for _, tick in list_true_edges(reported, 0)], atol=2)


def test_immediate_return_move_has_its_own_line() -> None:
    reported = build_sequence([rest(300), rapid(200, 7), rapid(-200, 8), rest(400)])
    events = detect_moves(reported, report_every_cycle(reported, 0), 3)
    assert [(e.kind, e.nc and e.nc.line) for e in events] == [(RAPID, 7), (REST, None), (RAPID, 8), (REST, None)]


def test_hold_and_override_within_a_move_are_reported() -> None:
    reported = build_sequence([rest(300), rapid(400), rest(400)])
    states = report_every_cycle(reported, 0)
    slow = [replace(s, rapid_override=0.5) if 500 < s.stamp_ns / MS < 520 else s for s in states]
    held = [replace(s, feed_hold=True) if 500 < s.stamp_ns / MS < 520 else s for s in states]
    for message, override, hold in ((slow, (0.5, 1.0), False), (held, (1.0, 1.0), True)):
        (move, _) = detect_moves(reported, message, 3)
        assert move.nc is not None
        assert (move.nc.override, move.nc.held) == (override, hold)


def test_rapid_resumed_after_a_hold_is_not_used() -> None:
    reported = build_sequence(
        [rest(300), rapid(200), Part(HOLD, 1, np.zeros(30)), rapid(200), rest(300), rapid(-400, 2), rest(400)]
    )
    rapids = [e.nc and e.nc.held for e in detect_moves(reported, report_every_cycle(reported, 0), 3) if e.kind is RAPID]
    assert rapids == [False, True, False]


def test_override_set_before_the_move_applies() -> None:
    reported = build_sequence([rest(1000), rapid(400), rest(400)])
    states = [
        NcState(100 * MS, MS, REST, rapid_override=0.8),
        NcState(1200 * MS, MS, RAPID),
        NcState(2300 * MS, MS, REST),
    ]
    (move, _) = detect_moves(reported, states, 0)
    assert move.kind is RAPID
    assert move.nc is not None
    assert move.nc.override == (0.8, 0.8)


def test_silent_nc_reports_no_rapid() -> None:
    reported = build_sequence([rest(300), rapid(400), rest(4000)])
    assert list_edges(detect_moves(reported, [], 0)) == [(UNKNOWN, 299), (REST, pytest.approx(1224, abs=2))]
    lost = [
        s if s.stamp_ns < 500 * MS else replace(s, motion=UNKNOWN, demand_mm=None)
        for s in report_every_cycle(reported, 0)
    ]
    assert UNKNOWN in [kind for kind, _ in list_edges(detect_moves(reported, lost, 0))]


def test_set_points_that_differ_from_the_bus_are_not_aligned() -> None:
    """A bridge of another machine or axis: its clocks would fit, but its messages are not about this axis."""
    reported, other = (
        build_sequence([rest(300), rapid(400), rest(4000)]),
        build_sequence([rest(300), rapid(350), rest(4050)]),
    )
    assert RAPID not in [kind for kind, _ in list_edges(detect_moves(reported, report_every_cycle(other, 0), 0))]


def test_restarted_nc_is_aligned_again() -> None:
    reported = build_sequence([rest(300), rapid(400), rest(800)])
    source = NcReportedMoves("X", build_machine_config(g0={"source": "linuxcnc"}))
    once = detect_moves(reported, report_every_cycle(reported, 0), 3, source)
    length = len(reported.kind) + 3 + 500
    again = detect_moves(reported, report_every_cycle(reported, length * MS, first_cycle=10), 5, source, first=length)
    rapids = [e.tick for e in once + again if e.kind is RAPID]  # the bus has jumped meanwhile: that is none
    assert rapids == pytest.approx([302, length + 304], abs=1)


def test_restarted_sync_count_discards_former_states() -> None:
    reported = build_sequence([rest(300), rapid(400), rest(800)])
    source = NcReportedMoves("X", build_machine_config(g0={"source": "linuxcnc"}))
    detect_moves(reported, report_every_cycle(reported, 0), 3, source)
    assert [e.kind for e in detect_moves(reported, report_every_cycle(reported, 0, first_cycle=90_000), 3, source)] == [
        RAPID,
        REST,
    ]


@settings(deadline=None, max_examples=8)
@given(block=st.integers(7, 400), lag=st.integers(0, 30))
def test_moves_are_independent_of_block_size(block: int, lag: int) -> None:
    reported = build_sequence(PROGRAM)
    states = report_every_cycle(reported, 0)
    assert list_edges(detect_moves(reported, states, lag, block=block)) == list_edges(
        detect_moves(reported, states, lag)
    )


def test_state_with_future_time_stamp_does_not_block_others() -> None:
    reported = build_sequence(PROGRAM)
    states = report_every_cycle(reported, 20 * MS)
    source = NcReportedMoves("X", build_machine_config(g0={"source": "linuxcnc"}))
    source.detect_moves(replace(states[0], stamp_ns=4 * 10**17))
    assert list_edges(detect_moves(reported, states, 20, source)) == list_edges(detect_moves(reported, states, 20))
