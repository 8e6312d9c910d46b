"""Rapids in a job: found among feed moves, and refused with the figure if not executed as ordered."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_moving_range, find_windows
from fdhil.pipeline import analyse
from fdhil.records import NcMove, WindowOutcome
from fdhil.validation.interruptions import interruptions
from fdhil.validation.window_signals import WindowSignals
from studies import drives, faults
from studies.drives import Array, Drive, Move
from studies.judging import judge
from studies.scenes import Rows, Scene, demand_of, draw_scene, measured, recorded

# what refuses only where it does harm at the table
WEIGHED = {"cutting load", "stiff travel", "collision", "gain step", "gain drift", "offset", "offset drift"}
WEIGHED |= {"Stribeck friction", "lagging sensor"}
DRIVE = Drive(
    R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0, pitch_m=0.02, position_gain=50.0, feedforward=1.0,
    speed_hz=40.0, current_hz=400.0, current_limit=200.0, voltage_limit=300.0,
)  # fmt: skip
MOVE = Move(distance=0.35, speed=0.5, acceleration=4.0, smoothing=0.02, direction=1)
SCENE = Scene(DRIVE, MOVE, 1e-3, "interval_mean", 0.002, (1e-4, 1e-4, 1e-4), 1e-6, 0.15)


def _rows(*rates: Array, drive: Drive = DRIVE, load: Array | None = None) -> Rows:
    demand = demand_of(SCENE, *rates)
    return measured(np.random.default_rng(7), SCENE, drives.run(drive, demand, SCENE.dt_s, load))


def _judged(rows: Rows) -> list[WindowOutcome]:
    return [analyse(window, Identification()) for window in find_windows(recorded(SCENE, rows))]


def _reasons(rows: Rows) -> list[str]:
    return [str(reason) for outcome in _judged(rows) for reason in outcome.verdict.reasons]


@pytest.mark.usefixtures("long_computation")
def test_rapids_are_found_among_feed_moves_under_load() -> None:
    rapid = drives.rates(MOVE)
    feed = drives.rates(Move(distance=0.06, speed=0.1, acceleration=2.0, smoothing=0.02, direction=1))
    demand = demand_of(SCENE, rapid, -feed, -rapid)
    load = np.zeros(demand.size)
    load[150 + rapid.size + 250 : 150 + rapid.size + 250 + feed.size] = -12.0  # against the feed move alone
    outcomes = _judged(_rows(rapid, -feed, -rapid, load=load))
    assert [o.window.direction for o in outcomes] == [1, -1]
    for outcome in outcomes:
        assert outcome.verdict.accepted, outcome.verdict.reasons
        a, b = find_moving_range(outcome.window)
        assert (b - a) * SCENE.dt_s == pytest.approx(rapid.size * 1e-3, abs=0.06)


def test_a_slower_rapid_at_a_constant_override_is_as_good_as_any() -> None:
    (outcome,) = _judged(_rows(drives.rates(Move(0.35, 0.35, 4.0, 0.02, 1))))
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert _judged(_rows(drives.rates(Move(0.35, 0.25, 4.0, 0.02, 1)))) == []  # 50 %: not listed


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (lambda t: 1 - 0.4 * np.clip((t - 0.3) / 0.05, 0, 1), "held at 300 mm/s"),
        (lambda t: 1 - 0.7 * np.clip(np.minimum((t - 0.3) / 0.1, (0.7 - t) / 0.1), 0, 1), "and rises again"),
    ],
)
@pytest.mark.fault("C7")
def test_an_override_that_changes_on_the_way_is_refused_with_the_speed(rate: object, words: str) -> None:
    assert callable(rate)
    (reason,) = _reasons(_rows(drives.rates(MOVE, rate)))
    assert reason.startswith("EpisodeAborted: ")
    assert words in reason


@pytest.mark.parametrize(
    ("nc", "words"),
    [
        (NcMove(12, "part.ngc", (0.5, 0.5), False), "the NC reports an override of 50 % in line 12"),
        (NcMove(12, "part.ngc", (0.5, 1.0), False), "the NC reports an override of 50 to 100 % in line 12"),
        (NcMove(None, None, None, True), "the NC reports a feed hold"),
    ],
)
def test_what_the_nc_says_was_no_rapid_as_planned_is_refused(nc: NcMove, words: str) -> None:
    (outcome,) = _judged(_rows(drives.rates(MOVE)))
    signals = WindowSignals(replace(outcome.window, nc=nc), Identification())
    assert [str(reason) for reason in interruptions(signals)] == [f"EpisodeAborted: {words}"]
    good = WindowSignals(replace(outcome.window, nc=NcMove(12, "part.ngc", (1.0, 1.0), False)), Identification())
    assert list(interruptions(good)) == []


@pytest.mark.fault("C7")
def test_a_quick_stop_is_refused_with_both_ramps() -> None:
    rates = drives.rates(MOVE)[:450]
    stop = np.maximum(rates[-1] - 16.0 * 1e-3 * np.arange(1, 60), 0.0)
    (reason,) = _reasons(_rows(np.concatenate([rates, stop])))
    assert reason.startswith("EpisodeAborted: the demand brakes with 1")


def test_a_drive_that_stops_while_the_demand_goes_on_is_refused_with_the_distance() -> None:
    short = _rows(drives.rates(Move(0.25, 0.5, 4.0, 0.02, 1)))
    n = short.signals["demand"].size
    whole = np.concatenate([demand_of(SCENE), np.full(n, 0.35)])[:n]
    (reason,) = _reasons(short.with_signals(demand=whole))
    assert reason.startswith("EpisodeAborted: the axis comes to rest ")
    assert reason.endswith(" mm from its demand")


def test_a_drive_that_swings_through_rest_while_its_demand_goes_on_has_not_arrived() -> None:
    held = faults.KINDS["feed hold"].make(np.random.default_rng([7, 2, 2049]))  # falls to 14 %, and swings through 0
    texts = [[str(r) for r in analyse(w, Identification()).verdict.reasons] for w in find_windows(held.recording)]
    assert [len(reasons) > 0 for reasons in texts] == [True, True]
    assert texts[0] == ["EpisodeAborted: the demand continues at 42 mm/s while the drive passes through rest"]
    assert texts[1][0].startswith("EpisodeAborted: the demand continues at ")  # nor does the rest of it begin there


def _falls(drop: float, time_s: Array) -> Array:
    return 1 - drop * np.clip((time_s - 0.25) / 0.01, 0, 1)


def test_a_drive_that_creeps_towards_a_demanded_speed_is_not_held_there() -> None:
    slow = replace(DRIVE, position_gain=23.0, feedforward=0.45)
    scene = replace(SCENE, drive=slow, move=Move(0.12, 0.22, 7.4, 0.02, 1))
    for drop, said in ((0.0, []), (0.2, ["EpisodeAborted"])):
        rates = drives.rates(scene.move, partial(_falls, drop))
        rows = measured(np.random.default_rng(7), scene, drives.run(slow, demand_of(scene, rates), scene.dt_s))
        (window,) = find_windows(recorded(scene, rows))
        assert [reason.code for reason in interruptions(WindowSignals(window, Identification()))] == said


def test_a_slow_plateau_is_seen_through_a_coarse_scale() -> None:
    fallen = faults.KINDS["override changed"].make(np.random.default_rng([61, 2, 2888]))  # rows of 0.25 ms, slow ramps
    (window,) = find_windows(fallen.recording)
    (reason,) = interruptions(WindowSignals(window, Identification()))
    assert "held at 96." in reason.text


def test_a_feed_hold_to_rest_leaves_two_whole_moves() -> None:
    half = drives.rates(Move(0.2, 0.5, 4.0, 0.02, 1))
    outcomes = _judged(_rows(half, half))
    assert [o.verdict.accepted for o in outcomes] == [True, True]


def test_a_short_rapid_is_listed_above_60_percent_only() -> None:
    (outcome,) = _judged(_rows(drives.rates(Move(0.04, 0.5, 4.0, 0.02, 1))))
    assert [r.code for r in outcome.verdict.reasons][:1] == ["MissingStage(cruise)"]
    assert _judged(_rows(drives.rates(Move(0.015, 0.5, 4.0, 0.02, 1)))) == []


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("kind", faults.KINDS)
def test_no_kind_of_fault_is_accepted_and_does_harm(kind: str) -> None:
    for seed in range(2):
        made = faults.KINDS[kind].make(np.random.default_rng([5, seed]))
        judged = judge(kind, seed, made, draw_scene(np.random.default_rng([5, seed])))
        assert not judged.accepted or (kind in WEIGHED and judged.warned and not judged.harm), (seed, judged)
