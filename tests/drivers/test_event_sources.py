"""Every listed source of G0 events meets the contract and finds the rapids that it can detect."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil import tables
from fdhil.drivers.cia402.pdo_decoder import InputSamples
from fdhil.drivers.moves import load_event_source
from fdhil.drivers.moves.digital_input_moves import DigitalInputMoves
from fdhil.drivers.moves.inferred_moves import InferredMoves
from fdhil.records import AxisSamples, Float, MoveEvent, MoveKind, NcState, TickTimes, freeze_array, freeze_integers
from tests.drivers.frame_builder import build_machine_config


def build_samples(demand_mm: Float, first: int = 0, axis: str = "X") -> AxisSamples:
    n = demand_mm.size
    zeros = freeze_array(np.zeros(n))
    ticks = freeze_integers(np.arange(first, first + n))
    return AxisSamples(
        axis, ticks, freeze_array(demand_mm), zeros, zeros, zeros, None, zeros, freeze_integers(np.zeros(n))
    )


def build_move(distance_mm: float, speed_mm_s: float, acceleration: float = 4000.0) -> Float:
    """Trapezoid in 1 ms steps, with 200 ms of rest on both sides."""
    ramp_s = speed_mm_s / acceleration
    t = np.arange(0, distance_mm / speed_mm_s + ramp_s, 1e-3)
    speed = np.clip(np.minimum(t, t[-1] - t) * acceleration, 0, speed_mm_s)
    return np.concatenate([np.zeros(200), np.cumsum(speed) * 1e-3, np.full(200, np.sum(speed) * 1e-3)])


def detect_moves(demand: Float, block: int = 50) -> list[tuple[MoveKind, int]]:
    source = InferredMoves("X", build_machine_config())
    events: list[MoveEvent] = []
    for first in range(0, demand.size, block):
        events += source.detect_moves(build_samples(demand[first : first + block], first))
    assert {e.source for e in events} <= {"inferred"}
    return [(e.kind, e.tick) for e in events]


def test_rapid_is_reported_from_its_first_tick() -> None:
    demand = build_move(400, 500)
    (kind, start), (rest, end) = detect_moves(demand)
    assert (kind, rest) == (MoveKind.RAPID, MoveKind.REST)
    assert start == pytest.approx(200, abs=3)
    assert end == pytest.approx(demand.size - 200, abs=3)


def test_feed_move_is_classified_as_feed() -> None:
    assert [kind for kind, _ in detect_moves(build_move(50, 166))] == [MoveKind.FEED, MoveKind.REST]
    assert [kind for kind, _ in detect_moves(build_move(500, 166))] == [MoveKind.FEED, MoveKind.REST]


def test_rapid_in_negative_direction_is_recognised() -> None:
    assert [kind for kind, _ in detect_moves(-build_move(400, 500))] == [MoveKind.RAPID, MoveKind.REST]


def test_rest_and_jitter_give_no_event() -> None:
    rounding = 20 / 65536
    assert detect_moves(np.tile([0.0, rounding], 300)) == []


@settings(deadline=None, max_examples=25)
@given(block=st.integers(1, 300))
def test_events_are_independent_of_block_size(block: int) -> None:
    demand = np.concatenate([build_move(300, 500), 300 - build_move(20, 100), 280 + build_move(300, 500)])
    whole, cut = detect_moves(demand, demand.size), detect_moves(demand, block)
    assert [kind for kind, _ in cut] == [kind for kind, _ in whole]
    assert [tick for _, tick in cut] == [tick for _, tick in whole]


def test_digital_input_edges_become_events() -> None:
    source = DigitalInputMoves("X", build_machine_config())
    record = InputSamples(
        "X", freeze_integers(np.arange(0, 60, 10)), freeze_integers([0, 0, 1 << 16, 1 << 16 | 1, 1, 0])
    )
    assert [(e.kind, e.tick) for e in source.detect_moves(record)] == [(MoveKind.RAPID, 10), (MoveKind.REST, 40)]
    assert source.detect_moves(InputSamples("Y", record.tick, record.inputs)) == []


@pytest.mark.parametrize("name", tables.EVENT_SOURCES)
def test_event_source_fulfils_the_contract(name: str) -> None:
    source = load_event_source(name)("X", build_machine_config())
    for record in (
        build_samples(np.zeros(0)),
        build_samples(np.zeros(10)),
        build_samples(build_move(400, 500), axis="Y"),
        InputSamples("X", freeze_integers([]), freeze_integers([])),
        InputSamples("Y", freeze_integers([0, 10, 20, 30]), freeze_integers([0, *[1 << 16] * 3])),
    ):
        assert source.detect_moves(record) == []


@pytest.mark.parametrize("name", tables.EVENT_SOURCES)
def test_every_listed_source_reports_a_rapid_under_its_name(name: str) -> None:
    """Demand, signal and NC messages come in blocks: a rapid out and back, with the bit set and the messages sent."""
    config = build_machine_config(g0={"source": name})
    source = load_event_source(name)("X", config)
    there = build_move(400, 500)
    demand = np.concatenate([there, there[-1] - there])
    high = np.abs(np.diff(demand, prepend=0.0)) > 0
    events: list[MoveEvent] = []
    for first in range(0, demand.size, 50):
        ticks = np.arange(first, min(first + 50, demand.size))
        events += source.detect_moves(TickTimes(freeze_integers(ticks), freeze_integers(ticks * 1_000_000)))
        for tick in ticks[::10].tolist():
            message = MoveKind.RAPID if high[tick] else MoveKind.REST
            events += source.detect_moves(NcState(tick * 1_000_000, 5_000_000, message))
        events += source.detect_moves(build_samples(demand[ticks], first))
        inputs = np.where(high[ticks[::10]], 1 << config.g0.input_bit, 0)
        events += source.detect_moves(InputSamples("X", freeze_integers(ticks[::10]), freeze_integers(inputs)))
    assert [event.kind for event in events] == [MoveKind.RAPID, MoveKind.REST] * 2
    assert {(event.axis, event.source) for event in events} == {("X", name)}
    edges = np.flatnonzero(np.diff(high))
    np.testing.assert_allclose([event.tick for event in events], edges, atol=12)  # the input comes every 10 ticks


@pytest.mark.parametrize("name", tables.EVENT_SOURCES)
def test_every_listed_source_declares_its_requirements(name: str) -> None:
    source = load_event_source(name)
    assert source.needs_input in (True, False)
    assert 0.0 <= source.least_share < 1.0
