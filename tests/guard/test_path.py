"""Positions on the path at their exact limits: matching rows, searched rows, rates."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import partial

import pytest

from fdhil.guard.interlocks import Alarm
from fdhil.guard.path import EPS, SEARCH, CorrectedPath, Place, advance, around, rate_between
from fdhil.guard.protocol import Mode
from fdhil.guard.state import State, initial
from fdhil.guard.tracking import await_start, rest, track
from tests.guard import machine

FIRST = 100
X = [0, 0, 0, *range(50, 50 * 61, 50)]
Y = [0, 0, 0, *range(-30, -30 * 61, -30)]
PATH = CorrectedPath(FIRST, (X, Y), ([0] * len(X), [0] * len(X)), True, "p")
END = FIRST + len(X)


def at(row: int, dx: int = 0, dy: int = 0) -> tuple[int, int]:
    return X[row - FIRST] + dx, Y[row - FIRST] + dy


def test_rows_have_their_number_to_the_last() -> None:
    assert (PATH.end, END) == (163, 163)
    assert [PATH.has(row) for row in (FIRST - 1, FIRST, END - 1, END)] == [False, True, True, False]
    assert PATH.standing_rows() == FIRST + 2
    assert [PATH.mismatch(row, (0, 0)) for row in (FIRST - 1, END)] == [None, None]


@pytest.mark.parametrize("standing", [1, 2, 3, 4])
def test_a_row_stands_to_the_next_one_and_not_from_the_one_before(standing: int) -> None:
    path = CorrectedPath(FIRST, ([7] * standing + [9, 7, 7],), ([0] * (standing + 3),), True, "p")
    assert [path.stands(FIRST + k) for k in range(-1, standing + 3)] == [
        *(False, *[True] * (standing - 1)),
        *(False, False, True, False),
    ]


@pytest.mark.parametrize("kind", [list, partial(array, "i")])
def test_a_dwell_of_any_length_is_counted_to_its_last_row(kind: Callable[[list[int]], Sequence[int]]) -> None:
    for standing in (*range(1, 70), 14_000):
        for after in ([], [9], [9, 7, 7, 7]):
            x, y = kind([7] * standing + after), kind([0] * (standing + len(after)))
            path = CorrectedPath(FIRST, (y, x), (y, y), True, "p")
            assert path.standing_rows() == FIRST + standing - 1


@pytest.mark.parametrize(("dx", "dy"), [(EPS, 0), (-EPS, 0), (0, EPS), (EPS, -EPS)])
def test_a_target_within_eps_is_its_row(dx: int, dy: int) -> None:
    assert PATH.mismatch(130, at(130, dx, dy)) == EPS
    assert [place.row for place in advance(PATH, (Place(129),), at(130, dx, dy))] == [130]
    assert [place.row for place in around(PATH, 125, at(130, dx, dy))] == [130]


@pytest.mark.parametrize(("dx", "dy"), [(EPS + 1, 0), (-EPS - 1, 0), (0, EPS + 1), (0, -EPS - 1)])
def test_a_target_beyond_eps_on_any_axis_is_none(dx: int, dy: int) -> None:
    assert advance(PATH, (Place(129),), at(130, dx, dy)) == ()
    assert around(PATH, 130, at(130, dx, dy)) == ()


def test_a_place_is_looked_for_eight_rows_to_either_side() -> None:
    for row in (140 - SEARCH, 140 + SEARCH):
        assert [place.row for place in around(PATH, 140, at(row))] == [row]
    for row in (140 - SEARCH - 1, 140 + SEARCH + 1):
        assert around(PATH, 140, at(row)) == ()


def test_costs_add_up_and_the_cheapest_is_first() -> None:
    flat = CorrectedPath(0, ([0, 1, 2, 3, 4, 5, 6],), ([0] * 7,), True, "p")
    places = around(flat, 3, (3,))
    assert [(place.row, place.cost) for place in places] == [(3, 0), (2, 1), (4, 1), (1, 2), (5, 2)]
    assert [(place.row, place.cost) for place in advance(flat, places, (4,))] == [
        (4, 0),
        (3, 2),
        (5, 2),
        (2, 4),
        (6, 4),
    ]
    assert advance(flat, places, None) == tuple(Place(place.row + 1, place.cost) for place in places)
    assert advance(flat, (Place(6),), (6,)) == ()
    assert advance(flat, (Place(3), Place(5)), (6,)) == (Place(6, 0), Place(4, 2))


def test_of_equal_places_the_nearest_is_first() -> None:
    level = CorrectedPath(0, ([5] * 40,), ([0] * 40,), True, "p")
    assert [place.row for place in around(level, 20, (5,))[:5]] == [20, 19, 21, 18, 22]


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.5, 1.0, 1.5])
def test_the_rate_is_read_off_the_way_along_the_path(rate: float) -> None:
    last, now = 130.2, 130.2 + rate
    assert rate_between(PATH, 130, _between(last), _between(now)) == pytest.approx(rate, abs=0.05)


def test_off_the_path_there_is_no_rate() -> None:
    here = _between(130.5)
    for dx, dy, known in ((0, 2 * EPS, True), (0, 2 * EPS + 1, False), (0, -2 * EPS - 1, False)):
        found = rate_between(PATH, 130, here, (here[0] + dx, here[1] + dy))
        assert (found is not None) is known, (dx, dy)
    assert rate_between(PATH, 130, _between(130.5), (10**6, 0)) is None
    assert rate_between(PATH, 130, (10**6, 0), _between(130.5)) is None


@pytest.mark.parametrize(("row", "known"), [(138, True), (139, False), (115, True), (114, False)])
def test_a_rate_is_looked_for_near_the_place_alone(row: int, known: bool) -> None:
    """Fifteen rows before and eight after; farther away it is another position."""
    assert (rate_between(PATH, 130, _between(row + 0.5), _between(row + 0.5)) is not None) is known


def test_a_rate_is_found_from_the_first_straight_to_the_last() -> None:
    assert rate_between(PATH, END - 3, _between(END - 2.0), _between(END - 1.5)) == pytest.approx(0.5)
    assert rate_between(PATH, FIRST + 3, _between(FIRST + 2.0), _between(FIRST + 2.5)) == pytest.approx(0.5)
    assert rate_between(PATH, 130, _between(138.5), at(139)) is None
    beside = X[-1] // 2, Y[-1] // 2  # far along the path, and no place between its end and its begin
    assert rate_between(PATH, FIRST + 3, beside, beside) is None


def test_the_rate_is_that_of_the_axis_that_moves_most_wherever_the_others_stand() -> None:
    moving = [*range(0, 500, 50)]
    for still in (10_000, -10_000):
        for axes in ((moving, [still] * 10), ([still] * 10, moving)):
            path = CorrectedPath(0, axes, ([0] * 10,) * 2, True, "p")
            last, now = ([axis[4] + (25 if axis is moving and half else 0) for axis in axes] for half in (False, True))
            assert rate_between(path, 4, last, now) == 0.5


def _between(place: float) -> tuple[int, int]:
    row, part = int(place), place - int(place)
    (x0, y0), (x1, y1) = at(row), at(row + 1)
    return round(x0 + part * (x1 - x0)), round(y0 + part * (y1 - y0))


# --- tracking ---


def state_at(row: int, *targets: tuple[int, int] | None, **changes: object) -> State:
    made = initial(machine.settings())
    made = made._replace(mode=Mode.ACTIVE, places=(Place(row),), anchor=row, targets=targets)
    return made._replace(**changes)  # type: ignore[arg-type] # fields of State


def test_the_start_is_the_first_target_that_leaves_ten_cycles_of_rest() -> None:
    waiting = initial(machine.settings())._replace(mode=Mode.ARMED, start_row=FIRST + 2, cause=Alarm("FeedbackGap"))
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


def test_the_first_move_is_looked_for_eight_rows_around_the_one_that_follows_the_rest() -> None:
    waiting = initial(machine.settings())._replace(mode=Mode.ARMED, start_row=FIRST + 2, rested_for=50)
    for row, started in ((FIRST + 3 + SEARCH, True), (FIRST + 4 + SEARCH, False)):
        state, alarm = await_start(waiting._replace(rest=(0, 0), targets=(at(row),)), PATH)
        assert (state.mode is Mode.RAMPING, alarm is None) == (started, started)
    for stood, now in (((0, 0), None), (None, at(FIRST + 3))):  # who does not know where it was or is waits
        unknown = waiting._replace(rest=stood, targets=(now,))
        assert await_start(unknown, PATH) == (unknown, None)


def test_rest_is_counted_from_the_target_that_stands() -> None:
    state = initial(machine.settings())
    counts = []
    for target in ((5, 5), (5, 5), (5, 5), None, (5, 5), (5, 6), (5, 6)):
        state = rest(state._replace(targets=(target,)))
        counts.append(state.rested_for)
    assert counts == [0, 1, 2, 2, 3, 0, 1]


@pytest.mark.parametrize(
    ("rate", "code"),
    [(0.5, "OverrideChanged"), (1.5, "OverrideChanged"), (1.64, "Misaligned"), (0.9, "OverrideChanged")],
)
def test_another_rate_is_told_from_another_path(rate: float, code: str) -> None:
    last, now = _between(130.0), _between(130.0 + rate)
    _, alarm = track(state_at(130, now, last), PATH)
    assert alarm is not None
    assert alarm.code == code


def test_another_rate_is_told_in_percent_of_the_planned_from_none_to_the_highest() -> None:
    path = CorrectedPath(0, tuple([axis[2:] for axis in (X, Y)]), ([0] * 61,) * 2, True, "p")
    for targets, result in (
        (((80, -48), (0, 0)), Alarm("OverrideChanged", detail="160 % of the planned rate")),
        (((85, -51), (0, 0)), Alarm("Misaligned")),
        (((25, -15), (25, -15)), Alarm("OverrideChanged", detail="0 % of the planned rate")),
        (((20, -12), (25, -15)), Alarm("Misaligned")),
        (((80, -48), None), Alarm("Misaligned")),
        (((75, -45), (25, -15)), Alarm("Misaligned")),  # at the planned rate, half a row beside
    ):
        assert track(state_at(0, *targets), path)[1] == result, targets


def test_targets_that_stand_at_the_last_row_are_a_feed_hold() -> None:
    state, alarm = track(state_at(130, at(130, EPS), at(130, EPS)), PATH)
    assert alarm is not None
    assert (alarm.code, state.places, state.resuming) == ("FeedHold", (Place(130),), True)
    led_on = state_at(133, at(130), at(130), anchor=130)  # by time alone, while targets were missing
    assert track(led_on, PATH)[0].places == (Place(130),)
    _, alarm = track(state_at(130, at(130, EPS + 1), at(130, EPS + 1)), PATH)
    assert alarm is not None
    assert alarm.code != "FeedHold"
    _, alarm = track(state_at(130, at(130), at(129)), PATH)
    assert alarm is not None
    assert alarm.code != "FeedHold"


def test_after_a_feed_hold_the_place_is_looked_for_anew() -> None:
    held = state_at(130, at(133), at(130), resuming=True)
    state, alarm = track(held, PATH)
    assert alarm is None
    assert (state.places[0].row, state.anchor, state.resuming) == (133, 133, False)
    state, alarm = track(held._replace(resuming=False), PATH)
    assert alarm is not None
    assert state.places[0].row == 131  # time alone moves it, for as long as a hold lasts
    for targets in (at(131), at(130, 0, 20)):  # found at once, or lost: from there it is a move like any other
        assert track(state_at(130, targets, at(130), resuming=True), PATH)[0].resuming is False


DWELL = CorrectedPath(
    FIRST, tuple([*axis[:20], *[axis[19]] * 30, *axis[20:]] for axis in (X, Y)), ([0] * 93, [0] * 93), True, "p"
)


@pytest.mark.parametrize("early", [1, SEARCH, SEARCH + 1])
def test_a_dwell_may_end_before_the_tables(early: int) -> None:
    rests = FIRST + 49 - early  # the last row in which the NC still stood
    left = state_at(rests, at(FIRST + 20), at(FIRST + 19))
    state, alarm = track(left, DWELL)
    assert (alarm is None) is (early <= SEARCH)
    assert (state.anchor == FIRST + 50) is (early <= SEARCH)


def test_only_a_rest_may_end_early() -> None:
    _, alarm = track(state_at(130, at(133), at(130)), PATH)
    assert alarm is not None
    _, alarm = track(state_at(FIRST + 40, (at(FIRST + 20)[0], 0), at(FIRST + 19)), DWELL)
    assert alarm is not None
    assert alarm.code == "Misaligned"


def test_without_targets_time_alone_moves_the_place_and_the_anchor_stays() -> None:
    state, alarm = track(state_at(130, None, at(130)), PATH)
    assert alarm is None
    assert (state.places, state.anchor) == ((Place(131),), 130)
    state, alarm = track(state_at(131, at(132), None, anchor=130), PATH)
    assert alarm is None
    assert (state.places[0].row, state.anchor) == (132, 132)
