"""A source that is read every 100 ms, of an NC that updates as often: kinds are right, edges exact."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.nc.value_timing import bound_value_time
from fdhil.records import MoveKind, NcState
from tests.drivers.nc.test_nc_reported_moves import (
    MS,
    PROGRAM,
    MoveSequence,
    build_sequence,
    detect_moves,
    feed,
    rapid,
    rest,
)

RENEWED_S = 0.1


def poll_states(
    told: MoveSequence, phase_ms: int, age_ms: int, answer_ms: int, period_ms: int = 100
) -> Iterator[NcState]:
    """Behave as a polled source: values were valid ``age_ms`` before the request; no SYNC precedes cycle 0."""
    for at in range(phase_ms + age_ms, len(told.kind), period_ms):
        stamp_ns, error_ns = bound_value_time(at * MS, (at + answer_ms) * MS, RENEWED_S)
        yield NcState(stamp_ns, error_ns, told.kind[at - age_ms], told.line[at - age_ms] or None)


@settings(max_examples=12)
@given(st.integers(0, 99), st.integers(0, 99), st.integers(1, 20), st.integers(0, 4))
def test_slow_polling_keeps_kinds_right_and_edges_exact(phase: int, age: int, answer: int, lag: int) -> None:
    """Rapids of 0.3 s: longer than the period, the update and the answer together."""
    reported = build_sequence((rest(300), rapid(90), rest(50), feed(30), rest(50), rapid(-90, 3), rest(400)))
    events = detect_moves(reported, list(poll_states(reported, phase, age, answer)), lag)
    moves = [(event.kind, event.tick) for event in events]
    wanted = [(kind, cycle + lag) for cycle, kind in reported.edges if cycle]
    assert [kind for kind, _ in moves] == [kind for kind, _ in wanted]
    assert [tick for _, tick in moves] == pytest.approx([tick for _, tick in wanted], abs=2)


@settings(max_examples=12)
@given(st.integers(0, 99), st.integers(0, 99), st.integers(1, 60))
def test_slow_polling_never_reports_a_feed_as_rapid(phase: int, age: int, answer: int) -> None:
    """The program has moves without a rest between them, and shorter ones than the source can resolve."""
    reported = build_sequence(PROGRAM)
    events = detect_moves(reported, list(poll_states(reported, phase, age, answer)), 0)
    rapids = [False] * len(reported.kind)
    for event, after in zip(events, [*events[1:], None], strict=True):
        if event.kind is MoveKind.RAPID:
            end = after.tick if after else len(reported.kind)
            rapids[event.tick + 10 : end - 10] = [True] * max(0, end - event.tick - 20)
    wrong = [k for k, kind in enumerate(reported.kind) if rapids[k] and kind in (MoveKind.FEED, MoveKind.ARC)]
    assert not wrong
