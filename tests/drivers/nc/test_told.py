"""The kind of a move comes from the NC, its edges from the demand on the bus: exact with every source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.moves.told import ToldG0
from fdhil.records import AxisSamples, Float, MoveEvent, MoveKind, NcState, TickTimes, freeze_array, freeze_integers
from tests.drivers.wire import machine

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
class Course:
    """The NC's command in each of its cycles, and the first cycle of each part with its kind."""

    demand_mm: Float
    kind: Sequence[MoveKind]
    line: Sequence[int]
    edges: Sequence[tuple[int, MoveKind]]


def course(parts: Sequence[Part]) -> Course:
    demand, kind, line, edges, place = [np.zeros(0)], list[MoveKind](), list[int](), [], 0.0
    for part in parts:
        edges.append((len(kind), part.kind))
        demand.append(place + part.demand)
        place += float(part.demand[-1])
        kind += [part.kind] * part.demand.size
        line += [part.line] * part.demand.size
    return Course(np.concatenate(demand), kind, line, edges)


def exact(told: Course, zero_ns: int, first_cycle: int = 5000) -> list[NcState]:
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


def polled(told: Course, zero_ns: int, period: int = 100) -> list[NcState]:
    """Behave as a polled source: an answer may be a whole period old."""
    return [
        NcState(zero_ns + k * MS, period * MS, told.kind[k], told.line[k] or None, rapid_override=1.0)
        for k in range(0, len(told.kind), period)
    ]


def hear(
    told: Course, states: Sequence[NcState], lag: int, source: ToldG0 | None = None, *, block: int = 50, first: int = 0
) -> list[MoveEvent]:
    """Run the bus: the NC's cycle k is at tick ``first`` + k + lag, from its own zero; SYNC k comes at k ms."""
    source = source or ToldG0("X", machine(g0={"source": "linuxcnc"}))
    bus = np.concatenate([np.zeros(lag), told.demand_mm, np.full(500, told.demand_mm[-1])])
    bus = np.round(bus / INCREMENT_MM) * INCREMENT_MM + 17.0
    waiting, events = list(states), []
    zeros = np.zeros(bus.size)
    for begin in range(0, bus.size, block):
        ticks = first + np.arange(begin, min(begin + block, bus.size))
        events += source.feed(TickTimes(freeze_integers(ticks), freeze_integers(ticks * MS)))
        while waiting and waiting[0].stamp_ns <= ticks[-1] * MS:
            events += source.feed(waiting.pop(0))
        part = freeze_array(zeros[: ticks.size])
        rows = freeze_array(bus[ticks - first])
        events += source.feed(
            AxisSamples("X", freeze_integers(ticks), rows, part, part, part, None, part, freeze_integers(part))
        )
    return events


def edges(events: Sequence[MoveEvent]) -> list[tuple[MoveKind, int]]:
    return [(event.kind, event.tick) for event in events]


def truth(told: Course, lag: int) -> list[tuple[MoveKind, int]]:
    """Return the moves of the program: a part begins with the previous one's last tick; none follows itself."""
    return [(kind, lag + cycle - 1) for cycle, kind in told.edges[1:]]


@pytest.mark.parametrize("lag", [0, 3, 40, 700])
def test_an_nc_that_tells_its_set_points_is_exact_however_late_the_bus_is(lag: int) -> None:
    told = course(PROGRAM)
    found = [e for e in edges(hear(told, exact(told, 0), lag)) if e[0] is not REST]
    true = [e for e in truth(told, lag) if e[0] is not REST]
    assert [kind for kind, _ in found] == [kind for kind, _ in true]
    np.testing.assert_allclose([tick for _, tick in found], [tick for _, tick in true], atol=1)


def test_line_program_and_override_come_with_the_move() -> None:
    told = course(PROGRAM)
    rapids = [e for e in hear(told, exact(told, 0), 3) if e.kind is RAPID]
    assert [e.nc and (e.nc.line, e.nc.program, e.nc.override, e.nc.held) for e in rapids] == [
        (1, "part.ngc", (1.0, 1.0), False), (3, "part.ngc", (1.0, 1.0), False),
    ]  # fmt: skip


@pytest.mark.parametrize("period", [20, 50, 100])
@pytest.mark.parametrize("late", [0, 7])
def test_a_source_that_is_asked_now_and_then_gives_the_edges_of_the_demand(period: int, late: int) -> None:
    told = course([rest(500), rapid(300), rest(300), feed(60), rest(300), rapid(-360, 3), rest(500)])
    found = edges(hear(told, polled(told, late * MS, period), 0))
    assert [kind for kind, _ in found] == [RAPID, REST, FEED, REST, RAPID, REST]
    np.testing.assert_allclose([tick for _, tick in found], [tick for _, tick in truth(told, 0)], atol=2)


def test_a_move_back_at_once_is_a_move_of_its_own_line() -> None:
    told = course([rest(300), rapid(200, 7), rapid(-200, 8), rest(400)])
    events = hear(told, exact(told, 0), 3)
    assert [(e.kind, e.nc and e.nc.line) for e in events] == [(RAPID, 7), (REST, None), (RAPID, 8), (REST, None)]


def test_a_hold_and_an_override_within_the_move_are_told() -> None:
    told = course([rest(300), rapid(400), rest(400)])
    states = exact(told, 0)
    slow = [replace(s, rapid_override=0.5) if 500 < s.stamp_ns / MS < 520 else s for s in states]
    held = [replace(s, feed_hold=True) if 500 < s.stamp_ns / MS < 520 else s for s in states]
    for said, override, hold in ((slow, (0.5, 1.0), False), (held, (1.0, 1.0), True)):
        (move, _) = hear(told, said, 3)
        assert move.nc is not None
        assert (move.nc.override, move.nc.held) == (override, hold)


def test_what_goes_on_after_a_hold_is_no_whole_rapid() -> None:
    told = course(
        [rest(300), rapid(200), Part(HOLD, 1, np.zeros(30)), rapid(200), rest(300), rapid(-400, 2), rest(400)]
    )
    rapids = [e.nc and e.nc.held for e in hear(told, exact(told, 0), 3) if e.kind is RAPID]
    assert rapids == [False, True, False]


def test_an_override_that_was_set_before_the_move_counts() -> None:
    told = course([rest(1000), rapid(400), rest(400)])
    states = [
        NcState(100 * MS, MS, REST, rapid_override=0.8),
        NcState(1200 * MS, MS, RAPID),
        NcState(2300 * MS, MS, REST),
    ]
    (move, _) = hear(told, states, 0)
    assert move.kind is RAPID
    assert move.nc is not None
    assert move.nc.override == (0.8, 0.8)


def test_an_nc_that_is_silent_tells_no_rapid() -> None:
    told = course([rest(300), rapid(400), rest(4000)])
    assert edges(hear(told, [], 0)) == [(UNKNOWN, 299), (REST, pytest.approx(1224, abs=2))]
    lost = [s if s.stamp_ns < 500 * MS else replace(s, motion=UNKNOWN, demand_mm=None) for s in exact(told, 0)]
    assert UNKNOWN in [kind for kind, _ in edges(hear(told, lost, 0))]


def test_set_points_that_are_not_those_of_the_bus_tell_nothing() -> None:
    """A bridge of another machine or axis: its clocks would fit, but its messages are not about this axis."""
    told, other = course([rest(300), rapid(400), rest(4000)]), course([rest(300), rapid(350), rest(4050)])
    assert RAPID not in [kind for kind, _ in edges(hear(told, exact(other, 0), 0))]


def test_an_nc_that_was_started_anew_is_aligned_anew() -> None:
    told = course([rest(300), rapid(400), rest(800)])
    source = ToldG0("X", machine(g0={"source": "linuxcnc"}))
    once = hear(told, exact(told, 0), 3, source)
    length = len(told.kind) + 3 + 500
    again = hear(told, exact(told, length * MS, first_cycle=10), 5, source, first=length)
    rapids = [e.tick for e in once + again if e.kind is RAPID]  # the bus has jumped meanwhile: that is none
    assert rapids == pytest.approx([302, length + 304], abs=1)


def test_a_sync_count_that_began_anew_forgets_what_was() -> None:
    told = course([rest(300), rapid(400), rest(800)])
    source = ToldG0("X", machine(g0={"source": "linuxcnc"}))
    hear(told, exact(told, 0), 3, source)
    assert [e.kind for e in hear(told, exact(told, 0, first_cycle=90_000), 3, source)] == [RAPID, REST]


@settings(deadline=None, max_examples=8)
@given(block=st.integers(7, 400), lag=st.integers(0, 30))
def test_blocks_do_not_matter(block: int, lag: int) -> None:
    told = course(PROGRAM)
    states = exact(told, 0)
    assert edges(hear(told, states, lag, block=block)) == edges(hear(told, states, lag))


def test_one_state_from_the_future_silences_no_other() -> None:
    told = course(PROGRAM)
    states = exact(told, 20 * MS)
    source = ToldG0("X", machine(g0={"source": "linuxcnc"}))
    source.feed(replace(states[0], stamp_ns=4 * 10**17))
    assert edges(hear(told, states, 20, source)) == edges(hear(told, states, 20))
