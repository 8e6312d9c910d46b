"""Proves for all limits and all integers that the motion of an offset keeps its limits and reaches zero.

The proven code is ``fdhil.guard.offset_limits``, unchanged. ``stopping`` and ``approach`` multiply unknowns; their
contracts are proven first and replace them in later proofs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from fdhil.guard import offset_limits
from fdhil.guard.offset_limits import OffsetLimits
from tests.proof.contracts import Contracts
from tests.proof.symbolic import Claim, Integer, assume, choose, for_every_path, integers, lemma, prove

STOPPING, APPROACH, CLAMP = (
    each.__name__
    for each in (
        offset_limits.compute_stopping_distance,
        offset_limits.compute_approach_rate,
        offset_limits.limit_value,
    )
)

pytestmark = pytest.mark.usefixtures("long_computation")

Stopping = Callable[[Integer, Integer], Integer]


# --- what the arithmetic promises ---


def stopping_goes_on_from_the_next_cycle() -> None:
    rate, acceleration = integers("rate acceleration")
    assume(rate >= 0, acceleration >= 1)
    way = offset_limits.compute_stopping_distance(rate, acceleration)
    if rate <= acceleration:
        prove(way == 0)
    else:
        prove(way == (rate - acceleration) + offset_limits.compute_stopping_distance(rate - acceleration, acceleration))


def stopping_is_longer_when_faster_or_braked_less() -> None:
    """The way is the largest of all ``n r - a n (n + 1) / 2``, that of ``n = r // a``."""
    rate, acceleration, faster, weaker = integers("rate acceleration faster weaker")
    assume(rate >= 0, faster >= rate, weaker >= 1, weaker <= acceleration)
    way, longer = (
        offset_limits.compute_stopping_distance(rate, acceleration),
        offset_limits.compute_stopping_distance(faster, weaker),
    )
    steps, most = rate // acceleration, faster // weaker
    lemma((steps * acceleration <= rate) & (rate < steps * acceleration + acceleration))
    lemma((most * weaker <= faster) & (faster < most * weaker + weaker))
    lemma((steps >= 0) & (most >= 0))
    half, half_most = half_of_product("half", steps), half_of_product("half_most", most)
    lemma(acceleration * steps * (steps + 1) == 2 * (acceleration * half))
    lemma(weaker * most * (most + 1) == 2 * (weaker * half_most))
    lemma(way == steps * rate - acceleration * half)
    lemma(longer == most * faster - weaker * half_most)
    lemma(acceleration * half >= weaker * half)
    lemma(steps * rate <= steps * faster)
    more = most - steps
    lemma(2 * (half_most - half) == more * (most + steps + 1))
    if more >= 1:
        lemma(weaker * (more * (most + steps + 1)) <= weaker * (more * (2 * most)))
        lemma(more * (weaker * most) <= more * faster)
    else:
        lemma(more * (most + steps + 1) <= more * (2 * most + 2))
        lemma(weaker * (more * (most + steps + 1)) <= weaker * (more * (2 * most + 2)))
        lemma(more * (weaker * most + weaker) <= more * faster)
    prove(way <= longer)


def half_of_product(name: str, number: Integer) -> Integer:
    """Return ``number (number + 1) / 2``, which is whole since one of the two is even."""
    half, quotient = integers(f"{name} quotient_of_{name}")
    assume((number == 2 * quotient) | (number == 2 * quotient + 1))
    assume((number * (number + 1) == 2 * half) | (number * (number + 1) == 2 * half + 1))
    lemma(number * (number + 1) == 2 * half)
    return half


def square_root(value: Integer) -> Integer:
    """Promise what ``math.isqrt`` does."""
    prove(value >= 0)
    (root,) = integers("root")
    assume(root >= 0, root * root <= value, value < (root + 1) * (root + 1))
    return root


def approach_is_the_fastest_that_stops() -> None:
    distance, acceleration = integers("distance acceleration")
    assume(distance >= 0, acceleration >= 1)
    eighth = 8 * distance // acceleration
    lemma((eighth * acceleration <= 8 * distance) & (8 * distance < eighth * acceleration + acceleration))
    lemma(eighth >= 0)
    rate = offset_limits.compute_approach_rate(distance, acceleration)
    (root,) = integers("root")
    steps = (root + 1) // 2
    lemma((steps >= 1) & (2 * steps - 1 <= root) & (root <= 2 * steps))
    lemma((2 * steps - 1) * (2 * steps - 1) <= root * root)
    lemma((root + 1) * (root + 1) <= (2 * steps + 1) * (2 * steps + 1))
    lemma((4 * steps * (steps - 1) <= eighth) & (eighth < 4 * steps * (steps + 1)))
    lemma(acceleration * (4 * steps * (steps - 1)) <= acceleration * eighth)
    lemma(acceleration * (eighth + 1) <= acceleration * (4 * steps * (steps + 1)))
    half = half_of_product("half", steps - 1)
    lemma(acceleration * steps * (steps - 1) == 2 * (acceleration * half))
    lemma(acceleration * steps * (steps - 1) // 2 == acceleration * half)
    lemma((acceleration * half <= distance) & (distance < acceleration * half + acceleration * steps))
    lemma((rate * steps <= distance + acceleration * half) & (distance + acceleration * half < rate * steps + steps))
    lemma(rate * steps >= acceleration * steps * (steps - 1) - steps + 1)
    lemma(rate >= acceleration * (steps - 1))
    lemma(rate * steps < acceleration * steps * steps)
    lemma(rate < acceleration * steps)
    lemma(rate // acceleration == steps - 1)
    way = offset_limits.compute_stopping_distance(rate, acceleration)
    lemma(way == (steps - 1) * rate - acceleration * half)
    prove(rate + way <= distance)
    way = offset_limits.compute_stopping_distance(rate + 1, acceleration)
    if rate + 1 < acceleration * steps:
        lemma((rate + 1) // acceleration == steps - 1)
        lemma(way == (steps - 1) * (rate + 1) - acceleration * half)
    else:
        lemma(rate + 1 == acceleration * steps)
        lemma((rate + 1) // acceleration == steps)
        lemma(acceleration * steps * (steps + 1) == 2 * (acceleration * half + acceleration * steps))
        lemma(way == steps * (rate + 1) - (acceleration * half + acceleration * steps))
    prove(rate + 1 + way > distance)  # so does every faster one, whose way is no shorter


def clamp_is_a_choice() -> None:
    value, low, high = integers("value low high")
    assume(low <= high)
    prove(offset_limits.limit_value(value, low, high) == clamp(value, low, high))


def clamp(value: Integer, low: Integer | int, high: Integer | int) -> Integer:
    """Limit without following three paths."""
    return choose(value < low, low, choose(value > high, high, value))


def larger(one: Integer | int, other: Integer | int) -> Integer | int:
    """Return the larger one without following two paths."""
    both_known = isinstance(one, int) and isinstance(other, int)
    return max(one, other) if both_known else choose(as_claim(one, other), one, other)


def as_claim(one: Integer | int, other: Integer | int) -> Claim:
    return one >= other if isinstance(one, Integer) else other <= one  # type: ignore[return-value] # one of the two is unknown


# --- what follows for every offset ---


class Axis:
    """Unknown limits, an unknown offset and its rate, of which no more is known than that they are safe."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.contracts = Contracts()
        monkeypatch.setattr(offset_limits, STOPPING, self.contracts.stopping)
        monkeypatch.setattr(offset_limits, APPROACH, self.contracts.approach)
        monkeypatch.setattr(offset_limits, CLAMP, clamp)
        monkeypatch.setattr(offset_limits, "max", larger, raising=False)
        self.offset, self.rate, most, rate, self.acceleration = integers("offset rate L S A")
        assume(most >= 1, rate >= 1, self.acceleration >= 1)
        self.limits = OffsetLimits(most, rate, self.acceleration, 1, 1)
        assume(self.is_safe(self.offset, self.rate))

    def is_safe(self, offset: Integer, rate: Integer) -> Claim:
        """Moving outward it can stop at the limit: the invariant. At rest or moving inward it may be beyond it."""
        hardest, most = self.limits.hard_acceleration, self.limits.offset
        upward = (rate > 0).implies(offset + self.contracts.one_step(rate, hardest) <= most)
        downward = (rate < 0).implies(-offset + self.contracts.one_step(-rate, hardest) <= most)
        return (abs(rate) <= self.limits.hard_rate) & upward & downward

    def keeps_limits(self, following: Integer, offset: Integer, rate: Integer) -> Claim:
        """Value, rate and acceleration of the frame after ``offset`` that came there at ``rate``."""
        move = following - offset
        value = abs(following) <= choose(abs(offset) > self.limits.offset, abs(offset), self.limits.offset)
        bent = abs(move - rate) <= self.limits.hard_acceleration
        return value & (abs(move) <= self.limits.hard_rate) & bent

    def is_good(self, following: Integer, offset: Integer, rate: Integer) -> Claim:
        """Whether the frame keeps the limits and leaves a state that is safe again."""
        return self.is_safe(following, following - offset) & self.keeps_limits(following, offset, rate)


def follow_keeps_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = Axis(monkeypatch)
    wanted, wanted_rate = integers("wanted wanted_rate")
    following = offset_limits.move_toward_goal(axis.limits, axis.offset, axis.rate, wanted, wanted_rate)
    prove(axis.is_good(following, axis.offset, axis.rate))


def brake_keeps_limits_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = Axis(monkeypatch)
    following = offset_limits.decelerate_offset(axis.limits, axis.offset, axis.rate)
    move = following - axis.offset
    prove(axis.is_good(following, axis.offset, axis.rate))
    prove((axis.rate == 0).implies(move == 0))
    prove((axis.rate != 0).implies(abs(move) < abs(axis.rate)))


def check_lets_pass_what_is_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = Axis(monkeypatch)
    (following,) = integers("following")
    assume(axis.is_good(following, axis.offset, axis.rate))
    prove(offset_limits.find_limit_violation(axis.limits, axis.offset, axis.rate, following) is None)


def check_lets_pass_only_what_keeps_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the state is, safe or not."""
    axis = Axis(monkeypatch)
    following, before, rate = integers("following before any_rate")
    if offset_limits.find_limit_violation(axis.limits, before, rate, following) is None:
        prove(axis.keeps_limits(following, before, rate))


def ramp_to_zero_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two quantities fall, one after the other, so that there is an end.

    As long as an offset moves outward, or faster inward than lets it stop at zero, its rate falls. From then on the
    offset itself falls in each cycle, without an overshoot, and at zero it rests.
    """
    axis = Axis(monkeypatch)
    offset, rate = axis.offset, axis.rate

    def closes_in(offset: Integer, rate: Integer) -> Claim:
        fastest = axis.contracts.approach(abs(offset), axis.acceleration)
        axis.contracts.one_step(fastest, axis.acceleration)
        axis.contracts.stopping(fastest, axis.limits.hard_acceleration)
        axis.contracts.one_step(abs(rate), axis.acceleration)
        inward = ((offset >= 0) & (rate <= 0)) | ((offset <= 0) & (rate >= 0))
        return inward & (abs(rate) <= fastest + axis.acceleration)

    closing = closes_in(offset, rate)
    following = offset_limits.move_toward_goal(axis.limits, offset, rate, 0, 0)
    move = following - offset
    closing_next = closes_in(following, move)
    prove((closing & (offset != 0)).implies(closing_next & (abs(following) < abs(offset))))
    prove((closing & (offset == 0)).implies((following == 0) & (move == 0)))
    prove((~closing).implies(closing_next | (abs(move) < abs(rate))))


ARITHMETIC = (
    stopping_goes_on_from_the_next_cycle,
    stopping_is_longer_when_faster_or_braked_less,
    approach_is_the_fastest_that_stops,
    clamp_is_a_choice,
)
MOTION = (
    follow_keeps_limits,
    brake_keeps_limits_and_ends,
    check_lets_pass_what_is_safe,
    check_lets_pass_only_what_keeps_limits,
    ramp_to_zero_ends,
)


@pytest.mark.parametrize("theorem", ARITHMETIC, ids=lambda theorem: theorem.__name__)
def test_theorem_of_arithmetic_is_proven(theorem: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offset_limits, "isqrt", square_root)
    for_every_path(theorem)


@pytest.mark.parametrize("theorem", MOTION, ids=lambda theorem: theorem.__name__)
def test_theorem_about_motion_is_proven(
    theorem: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    for_every_path(partial(theorem, monkeypatch))
