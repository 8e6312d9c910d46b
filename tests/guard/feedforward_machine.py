"""Test machine of the feed-forward: a law, its limits, and drives with speed and torque offsets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fdhil.guard.feedforward_law import SHIFT, FeedforwardLimits, Law
from fdhil.guard.guard_settings import FeedforwardPdo, GuardSettings, Pdo
from fdhil.guard.guard_state import GuardRequest
from fdhil.guard.interlocks import FEEDFORWARD_FACTS
from tests.guard import simulated_bus
from tests.guard.simulated_bus import Bench

ONE = 1 << SHIFT
LAW = Law(speed=(-200 * ONE,), torque=(2 * ONE, -ONE), pace=(-2 * ONE,), dry=30)
LIMITS = FeedforwardLimits(speed=40_000, speed_rate=3_000, torque=900, torque_rate=120)
FACTS = dict.fromkeys(FEEDFORWARD_FACTS, True)


def fed_settings(shown: bool = False) -> GuardSettings:
    made = simulated_bus.settings()
    layout = ((0x60B1, 0, 32, True), (0x60B2, 0, 16, True))
    axes = [
        replace(
            axis,
            feedforward=FeedforwardPdo(Pdo(0x400 + axis.node_id, layout), LIMITS),
            tpdos=(*axis.tpdos, Pdo(0x1A0 + axis.node_id, layout)) if shown else axis.tpdos,
        )
        for axis in made.axes
    ]
    return replace(made, axes=tuple(axes))


def fed_bench(shown: bool = False) -> Bench:
    bench = simulated_bus.bench()
    for drive in bench.drives:
        drive.shows_fed = shown
    return Bench(fed_settings(shown), None, bench.demand, bench.drives)


def request(**changes: Any) -> GuardRequest:
    return replace(GuardRequest("feedforward", True, "", FACTS, (LAW, LAW)), **changes)


def switched_on(shown: bool = False) -> Bench:
    bench = fed_bench(shown)
    bench.settle()
    assert bench.run_sync(request()).refused == ()
    bench.run(120)
    bench.play()
    bench.run(150)
    return bench
