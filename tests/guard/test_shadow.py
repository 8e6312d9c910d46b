"""While off, the guard shows what it would send, and sends nothing."""

from __future__ import annotations

import pytest

from fdhil.guard.path import CorrectedPath
from fdhil.guard.protocol import Mode
from fdhil.guard.shadow import Shadow
from tests.guard import machine
from tests.guard.machine import DIGEST


def followed(made: machine.Bench, shadow: Shadow, cycles: int) -> list[tuple[int, ...] | None]:
    output = []
    for _ in range(cycles):
        made.sync()
        shadow.follow(made.state, made.path)
        output.append(shadow.offsets())
    return output


def test_it_says_what_an_armed_guard_sends() -> None:
    watched, armed, shadow = machine.bench(), machine.bench(), Shadow()
    assert set(followed(watched, shadow, 130)) == {None}
    armed.settle()
    assert armed.arm() == ()
    watched.play()
    armed.play()
    log = followed(watched, shadow, 500)
    active = 0
    for shown in log:
        was, output = armed.mode, armed.sync()
        if was is armed.mode is Mode.ACTIVE:
            active += 1
            assert shown == output.offsets
    assert active > 300
    assert watched.frames == []
    assert all(output.offsets is None and output.feed is None for output in watched.outputs)
    assert log[-1] is None or armed.mode is Mode.ACTIVE


def test_another_path_shows_nothing_and_the_next_start_is_found_again() -> None:
    made, shadow = machine.bench(), Shadow()
    followed(made, shadow, 50)
    made.play()
    assert followed(made, shadow, 200)[-1] is not None
    made.rest = [10**6, 10**6]
    assert followed(made, shadow, 3)[-1] is None
    made.rest, made.playing, made.row = None, False, 0
    assert set(followed(made, shadow, 50)) == {None}
    made.play()
    assert followed(made, shadow, 200)[-1] is not None


@pytest.mark.parametrize("hold", [5, 400])
def test_a_feed_hold_keeps_its_place(hold: int) -> None:
    made, shadow = machine.bench(), Shadow()
    followed(made, shadow, 50)
    made.play()
    followed(made, shadow, 200)
    row = made.row - 1
    made.rest = [column[row] for column in made.demand]
    stood = followed(made, shadow, hold)[-1]
    assert made.path is not None
    assert stood in [made.path.offsets_at(row + k) for k in (-1, 0, 1, 2)]


def test_armed_or_without_a_table_there_is_no_shadow() -> None:
    made, shadow = machine.bench(), Shadow()
    followed(made, shadow, 130)
    made.play()
    assert followed(made, shadow, 100)[-1] is not None
    shadow.follow(made.state._replace(mode=Mode.ACTIVE), made.path)
    assert shadow.offsets() is None
    made.path = None
    assert followed(made, shadow, 3) == [None] * 3
    shadow.follow(made.state, CorrectedPath(0, ([0], [0]), ([0], [0]), True, DIGEST))
    assert shadow.offsets() is None
