"""While off, the guard shows what it would send, and sends nothing."""

from __future__ import annotations

import pytest

from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.shadow_correction import ShadowCorrection
from tests.guard import simulated_bus
from tests.guard.simulated_bus import DIGEST


def followed(made: simulated_bus.Bench, shadow: ShadowCorrection, cycles: int) -> list[tuple[int, ...] | None]:
    output = []
    for _ in range(cycles):
        made.run_sync()
        shadow.follow_table(made.state, made.path)
        output.append(shadow.get_offsets())
    return output


def test_shadow_shows_what_an_armed_guard_sends() -> None:
    watched, armed, shadow = simulated_bus.bench(), simulated_bus.bench(), ShadowCorrection()
    assert set(followed(watched, shadow, 130)) == {None}
    armed.settle()
    assert armed.arm() == ()
    watched.play()
    armed.play()
    log = followed(watched, shadow, 500)
    active = 0
    for shown in log:
        was, output = armed.mode, armed.run_sync()
        if was is armed.mode is Mode.ACTIVE:
            active += 1
            assert shown == output.offsets
    assert active > 300
    assert watched.frames == []
    assert all(output.offsets is None and output.feed is None for output in watched.outputs)
    assert log[-1] is None or armed.mode is Mode.ACTIVE


def test_shadow_is_empty_on_another_path_and_finds_the_next_start() -> None:
    made, shadow = simulated_bus.bench(), ShadowCorrection()
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
def test_shadow_keeps_its_position_in_a_feed_hold(hold: int) -> None:
    made, shadow = simulated_bus.bench(), ShadowCorrection()
    followed(made, shadow, 50)
    made.play()
    followed(made, shadow, 200)
    row = made.row - 1
    made.rest = [column[row] for column in made.demand]
    stood = followed(made, shadow, hold)[-1]
    assert made.path is not None
    assert stood in [made.path.get_row_offsets(row + k) for k in (-1, 0, 1, 2)]


def test_no_shadow_while_armed_or_without_a_table() -> None:
    made, shadow = simulated_bus.bench(), ShadowCorrection()
    followed(made, shadow, 130)
    made.play()
    assert followed(made, shadow, 100)[-1] is not None
    shadow.follow_table(made.state._replace(mode=Mode.ACTIVE), made.path)
    assert shadow.get_offsets() is None
    made.path = None
    assert followed(made, shadow, 3) == [None] * 3
    shadow.follow_table(made.state, CorrectedPath(0, ([0], [0]), ([0], [0]), True, DIGEST))
    assert shadow.get_offsets() is None
