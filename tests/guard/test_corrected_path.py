"""Positions on the path at their exact limits: matching rows, searched rows, rates."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import partial

import pytest

from fdhil.guard.corrected_path import (
    EPS,
    SEARCH,
    CorrectedPath,
    PathPosition,
    advance_matching,
    compute_path_rate,
    search_near_row,
)
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardState, make_initial_state
from fdhil.guard.interlocks import Alarm
from fdhil.guard.path_tracking import await_start, count_standstill, track_path
from tests.guard import simulated_bus

FIRST = 100
X = [0, 0, 0, *range(50, 50 * 61, 50)]
Y = [0, 0, 0, *range(-30, -30 * 61, -30)]
PATH = CorrectedPath(FIRST, (X, Y), ([0] * len(X), [0] * len(X)), True, "p")
END = FIRST + len(X)


def at(row: int, dx: int = 0, dy: int = 0) -> tuple[int, int]:
    return X[row - FIRST] + dx, Y[row - FIRST] + dy


def test_rows_keep_their_numbers() -> None:
    assert (PATH.end, END) == (163, 163)
    assert [PATH.has_row(row) for row in (FIRST - 1, FIRST, END - 1, END)] == [False, True, True, False]
    assert PATH.count_standing_rows() == FIRST + 2
    assert [PATH.measure_row_distance(row, (0, 0)) for row in (FIRST - 1, END)] == [None, None]


@pytest.mark.parametrize("standing", [1, 2, 3, 4])
def test_row_stands_still_toward_the_next_row(standing: int) -> None:
    path = CorrectedPath(FIRST, ([7] * standing + [9, 7, 7],), ([0] * (standing + 3),), True, "p")
    assert [path.is_demand_standing(FIRST + k) for k in range(-1, standing + 3)] == [
        *(False, *[True] * (standing - 1)),
        *(False, False, True, False),
    ]


@pytest.mark.parametrize("kind", [list, partial(array, "i")])
def test_dwell_of_any_length_is_counted_to_its_last_row(kind: Callable[[list[int]], Sequence[int]]) -> None:
    for standing in (*range(1, 70), 14_000):
        for after in ([], [9], [9, 7, 7, 7]):
            x, y = kind([7] * standing + after), kind([0] * (standing + len(after)))
            path = CorrectedPath(FIRST, (y, x), (y, y), True, "p")
            assert path.count_standing_rows() == FIRST + standing - 1


@pytest.mark.parametrize(("dx", "dy"), [(EPS, 0), (-EPS, 0), (0, EPS), (EPS, -EPS)])
def test_target_within_tolerance_matches_its_row(dx: int, dy: int) -> None:
    assert PATH.measure_row_distance(130, at(130, dx, dy)) == EPS
    assert [place.row for place in advance_matching(PATH, (PathPosition(129),), at(130, dx, dy))] == [130]
    assert [place.row for place in search_near_row(PATH, 125, at(130, dx, dy))] == [130]


@pytest.mark.parametrize(("dx", "dy"), [(EPS + 1, 0), (-EPS - 1, 0), (0, EPS + 1), (0, -EPS - 1)])
def test_target_beyond_tolerance_on_any_axis_does_not_match(dx: int, dy: int) -> None:
    assert advance_matching(PATH, (PathPosition(129),), at(130, dx, dy)) == ()
    assert search_near_row(PATH, 130, at(130, dx, dy)) == ()


def test_search_covers_eight_rows_on_either_side() -> None:
    for row in (140 - SEARCH, 140 + SEARCH):
        assert [place.row for place in search_near_row(PATH, 140, at(row))] == [row]
    for row in (140 - SEARCH - 1, 140 + SEARCH + 1):
        assert search_near_row(PATH, 140, at(row)) == ()


def test_costs_add_up_and_the_cheapest_is_first() -> None:
    flat = CorrectedPath(0, ([0, 1, 2, 3, 4, 5, 6],), ([0] * 7,), True, "p")
    places = search_near_row(flat, 3, (3,))
    assert [(place.row, place.cost) for place in places] == [(3, 0), (2, 1), (4, 1), (1, 2), (5, 2)]
    assert [(place.row, place.cost) for place in advance_matching(flat, places, (4,))] == [
        (4, 0),
        (3, 2),
        (5, 2),
        (2, 4),
        (6, 4),
    ]
    assert advance_matching(flat, places, None) == tuple(PathPosition(place.row + 1, place.cost) for place in places)
    assert advance_matching(flat, (PathPosition(6),), (6,)) == ()
    assert advance_matching(flat, (PathPosition(3), PathPosition(5)), (6,)) == (PathPosition(6, 0), PathPosition(4, 2))


def test_nearest_of_equal_positions_is_first() -> None:
    level = CorrectedPath(0, ([5] * 40,), ([0] * 40,), True, "p")
    assert [place.row for place in search_near_row(level, 20, (5,))[:5]] == [20, 19, 21, 18, 22]


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.5, 1.0, 1.5])
def test_rate_is_the_travel_along_the_path(rate: float) -> None:
    last, now = 130.2, 130.2 + rate
    assert compute_path_rate(PATH, 130, _between(last), _between(now)) == pytest.approx(rate, abs=0.05)


def test_no_rate_off_the_path() -> None:
    here = _between(130.5)
    for dx, dy, known in ((0, 2 * EPS, True), (0, 2 * EPS + 1, False), (0, -2 * EPS - 1, False)):
        found = compute_path_rate(PATH, 130, here, (here[0] + dx, here[1] + dy))
        assert (found is not None) is known, (dx, dy)
    assert compute_path_rate(PATH, 130, _between(130.5), (10**6, 0)) is None
    assert compute_path_rate(PATH, 130, (10**6, 0), _between(130.5)) is None


@pytest.mark.parametrize(("row", "known"), [(138, True), (139, False), (115, True), (114, False)])
def test_rate_is_searched_only_near_the_position(row: int, known: bool) -> None:
    """Fifteen rows before and eight after; farther away it is another position."""
    assert (compute_path_rate(PATH, 130, _between(row + 0.5), _between(row + 0.5)) is not None) is known


def test_rate_is_found_from_the_first_to_the_last_segment() -> None:
    assert compute_path_rate(PATH, END - 3, _between(END - 2.0), _between(END - 1.5)) == pytest.approx(0.5)
    assert compute_path_rate(PATH, FIRST + 3, _between(FIRST + 2.0), _between(FIRST + 2.5)) == pytest.approx(0.5)
    assert compute_path_rate(PATH, 130, _between(138.5), at(139)) is None
    adjacent = X[-1] // 2, Y[-1] // 2  # far along the path, and no place between its end and its begin
    assert compute_path_rate(PATH, FIRST + 3, adjacent, adjacent) is None


def test_rate_comes_from_the_axis_that_moves_most() -> None:
    moving = [*range(0, 500, 50)]
    for still in (10_000, -10_000):
        for axes in ((moving, [still] * 10), ([still] * 10, moving)):
            path = CorrectedPath(0, axes, ([0] * 10,) * 2, True, "p")
            last, now = ([axis[4] + (25 if axis is moving and half else 0) for axis in axes] for half in (False, True))
            assert compute_path_rate(path, 4, last, now) == 0.5


def _between(place: float) -> tuple[int, int]:
    row, part = int(place), place - int(place)
    (x0, y0), (x1, y1) = at(row), at(row + 1)
    return round(x0 + part * (x1 - x0)), round(y0 + part * (y1 - y0))


# --- tracking ---


def state_at(row: int, *targets: tuple[int, int] | None, **changes: object) -> GuardState:
    made = make_initial_state(simulated_bus.settings())
    made = made._replace(mode=Mode.ACTIVE, places=(PathPosition(row),), anchor=row, targets=targets)
    return made._replace(**changes)  # type: ignore[arg-type] # fields of State


def test_start_is_the_first_move_after_ten_cycles_of_standstill() -> None:
    waiting = make_initial_state(simulated_bus.settings())._replace(
        mode=Mode.ARMED, start_row=FIRST + 2, cause=Alarm("FeedbackGap")
    )
    for rested, started in ((9, False), (10, True)):
        state = waiting._replace(rest=(0, 0), rested_for=rested, targets=(at(FIRST + 3),))
        state, alarm = await_start(state, PATH)
        assert alarm is None
        assert (state.mode is Mode.RAMPING) is started
        assert [place.row for place in state.places] == ([FIRST + 3] if started else [])
        assert state.anchor == (FIRST + 3 if started else 0)
        assert state.cause == (None if started else Alarm("FeedbackGap"))
    for stood, started in (((EPS, 0), True), ((EPS + 1, 0), False), ((0, -EPS - 1), False)):
        state = waiting._replace(rest=stood, rested_for=50, targets=(at(FIRST + 3),))
        assert (await_start(state, PATH)[0].mode is Mode.RAMPING) is started, stood
    state = waiting._replace(rest=(0, 0), rested_for=50, targets=((7, 7),))
    state, alarm = await_start(state, PATH)
    assert (state.mode, alarm) == (Mode.ARMED, Alarm("Misaligned", detail="the first move leaves the path"))


def test_first_move_is_searched_within_eight_rows() -> None:
    waiting = make_initial_state(simulated_bus.settings())._replace(mode=Mode.ARMED, start_row=FIRST + 2, rested_for=50)
    for row, started in ((FIRST + 3 + SEARCH, True), (FIRST + 4 + SEARCH, False)):
        state, alarm = await_start(waiting._replace(rest=(0, 0), targets=(at(row),)), PATH)
        assert (state.mode is Mode.RAMPING, alarm is None) == (started, started)
    for stood, now in (((0, 0), None), (None, at(FIRST + 3))):  # who does not know where it was or is waits
        unknown = waiting._replace(rest=stood, targets=(now,))
        assert await_start(unknown, PATH) == (unknown, None)


def test_standstill_is_counted_from_its_target() -> None:
    state = make_initial_state(simulated_bus.settings())
    counts = []
    for target in ((5, 5), (5, 5), (5, 5), None, (5, 5), (5, 6), (5, 6)):
        state = count_standstill(state._replace(targets=(target,)))
        counts.append(state.rested_for)
    assert counts == [0, 1, 2, 2, 3, 0, 1]


@pytest.mark.parametrize(
    ("rate", "code"),
    [(0.5, "OverrideChanged"), (1.5, "OverrideChanged"), (1.64, "Misaligned"), (0.9, "OverrideChanged")],
)
def test_other_rate_is_distinguished_from_another_path(rate: float, code: str) -> None:
    last, now = _between(130.0), _between(130.0 + rate)
    _, alarm = track_path(state_at(130, now, last), PATH)
    assert alarm is not None
    assert alarm.code == code


def test_other_rate_is_reported_in_percent_up_to_the_highest() -> None:
    path = CorrectedPath(0, tuple([axis[2:] for axis in (X, Y)]), ([0] * 61,) * 2, True, "p")
    for targets, result in (
        (((80, -48), (0, 0)), Alarm("OverrideChanged", detail="160 % of the planned rate")),
        (((85, -51), (0, 0)), Alarm("Misaligned")),
        (((25, -15), (25, -15)), Alarm("OverrideChanged", detail="0 % of the planned rate")),
        (((20, -12), (25, -15)), Alarm("Misaligned")),
        (((80, -48), None), Alarm("Misaligned")),
        (((75, -45), (25, -15)), Alarm("Misaligned")),  # at the planned rate, half a row beside
    ):
        assert track_path(state_at(0, *targets), path)[1] == result, targets


def test_targets_standing_at_the_last_row_are_a_feed_hold() -> None:
    state, alarm = track_path(state_at(130, at(130, EPS), at(130, EPS)), PATH)
    assert alarm is not None
    assert (alarm.code, state.places, state.resuming) == ("FeedHold", (PathPosition(130),), True)
    led_on = state_at(133, at(130), at(130), anchor=130)  # by time alone, while targets were missing
    assert track_path(led_on, PATH)[0].places == (PathPosition(130),)
    _, alarm = track_path(state_at(130, at(130, EPS + 1), at(130, EPS + 1)), PATH)
    assert alarm is not None
    assert alarm.code != "FeedHold"
    _, alarm = track_path(state_at(130, at(130), at(129)), PATH)
    assert alarm is not None
    assert alarm.code != "FeedHold"


def test_position_is_searched_again_after_a_feed_hold() -> None:
    held = state_at(130, at(133), at(130), resuming=True)
    state, alarm = track_path(held, PATH)
    assert alarm is None
    assert (state.places[0].row, state.anchor, state.resuming) == (133, 133, False)
    state, alarm = track_path(held._replace(resuming=False), PATH)
    assert alarm is not None
    assert state.places[0].row == 131  # time alone moves it, for as long as a hold lasts
    for targets in (at(131), at(130, 0, 20)):  # found at once, or lost: from there it is a move like any other
        assert track_path(state_at(130, targets, at(130), resuming=True), PATH)[0].resuming is False


DWELL = CorrectedPath(
    FIRST, tuple([*axis[:20], *[axis[19]] * 30, *axis[20:]] for axis in (X, Y)), ([0] * 93, [0] * 93), True, "p"
)


@pytest.mark.parametrize("early", [1, SEARCH, SEARCH + 1])
def test_dwell_may_end_earlier_than_in_the_table(early: int) -> None:
    rests = FIRST + 49 - early  # the last row in which the NC still stood
    left = state_at(rests, at(FIRST + 20), at(FIRST + 19))
    state, alarm = track_path(left, DWELL)
    assert (alarm is None) is (early <= SEARCH)
    assert (state.anchor == FIRST + 50) is (early <= SEARCH)


def test_only_a_dwell_may_end_early() -> None:
    _, alarm = track_path(state_at(130, at(133), at(130)), PATH)
    assert alarm is not None
    _, alarm = track_path(state_at(FIRST + 40, (at(FIRST + 20)[0], 0), at(FIRST + 19)), DWELL)
    assert alarm is not None
    assert alarm.code == "Misaligned"


def test_position_advances_by_time_without_targets() -> None:
    state, alarm = track_path(state_at(130, None, at(130)), PATH)
    assert alarm is None
    assert (state.places, state.anchor) == ((PathPosition(131),), 130)
    state, alarm = track_path(state_at(131, at(132), None, anchor=130), PATH)
    assert alarm is None
    assert (state.places[0].row, state.anchor) == (132, 132)
