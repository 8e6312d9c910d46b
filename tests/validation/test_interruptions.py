"""Rapids in a job: found among feed moves, and refused with the figure if not executed as ordered."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_moving_range, find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import NcMove, WindowOutcome
from fdhil.validation.interrupted_moves import find_interruptions
from fdhil.validation.window_signals import WindowSignals
from studies import drives, faults
from studies.drives import Array, Drive, Move
from studies.judging import assess_recording
from studies.scenes import Rows, Scene, demand_of, draw_scene, make_recording, measure_run

# what refuses only where it does harm at the table
WEIGHED = {"cutting load", "stiff travel", "collision", "gain step", "gain drift", "offset", "offset drift"}
WEIGHED |= {"Stribeck friction", "lagging sensor"}
DRIVE = Drive(
    R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0, pitch_m=0.02, position_gain=50.0, feedforward=1.0,
    speed_hz=40.0, current_hz=400.0, current_limit=200.0, voltage_limit=300.0,
)  # fmt: skip
MOVE = Move(distance=0.35, speed=0.5, acceleration=4.0, smoothing=0.02, direction=1)
SCENE = Scene(DRIVE, MOVE, 1e-3, "interval_mean", 0.002, (1e-4, 1e-4, 1e-4), 1e-6, 0.15)


def _select_rows(*rates: Array, drive: Drive = DRIVE, load: Array | None = None) -> Rows:
    demand = demand_of(SCENE, *rates)
    return measure_run(np.random.default_rng(7), SCENE, drives.simulate_loop(drive, demand, SCENE.dt_s, load))


def _analyse_recording(rows: Rows) -> list[WindowOutcome]:
    return [analyse_window(window, Identification()) for window in find_windows(make_recording(SCENE, rows))]


def _list_reasons(rows: Rows) -> list[str]:
    return [str(reason) for outcome in _analyse_recording(rows) for reason in outcome.verdict.reasons]


@pytest.mark.usefixtures("long_computation")
def test_rapids_are_found_among_loaded_feed_moves() -> None:
    rapid = drives.compute_path_speeds(MOVE)
    feed = drives.compute_path_speeds(Move(distance=0.06, speed=0.1, acceleration=2.0, smoothing=0.02, direction=1))
    demand = demand_of(SCENE, rapid, -feed, -rapid)
    load = np.zeros(demand.size)
    load[150 + rapid.size + 250 : 150 + rapid.size + 250 + feed.size] = -12.0  # against the feed move alone
    outcomes = _analyse_recording(_select_rows(rapid, -feed, -rapid, load=load))
    assert [o.window.direction for o in outcomes] == [1, -1]
    for outcome in outcomes:
        assert outcome.verdict.accepted, outcome.verdict.reasons
        a, b = find_moving_range(outcome.window)
        assert (b - a) * SCENE.dt_s == pytest.approx(rapid.size * 1e-3, abs=0.06)


def test_rapid_at_constant_override_is_accepted() -> None:
    (outcome,) = _analyse_recording(_select_rows(drives.compute_path_speeds(Move(0.35, 0.35, 4.0, 0.02, 1))))
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert (
        _analyse_recording(_select_rows(drives.compute_path_speeds(Move(0.35, 0.25, 4.0, 0.02, 1)))) == []
    )  # 50 %: not listed


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (lambda t: 1 - 0.4 * np.clip((t - 0.3) / 0.05, 0, 1), "held at 300 mm/s"),
        (lambda t: 1 - 0.7 * np.clip(np.minimum((t - 0.3) / 0.1, (0.7 - t) / 0.1), 0, 1), "and rises again"),
    ],
)
@pytest.mark.fault("C7")
def test_changing_override_is_refused_with_speed(rate: object, words: str) -> None:
    assert callable(rate)
    (reason,) = _list_reasons(_select_rows(drives.compute_path_speeds(MOVE, rate)))
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
def test_override_or_hold_reported_by_nc_is_refused(nc: NcMove, words: str) -> None:
    (outcome,) = _analyse_recording(_select_rows(drives.compute_path_speeds(MOVE)))
    signals = WindowSignals(replace(outcome.window, nc=nc), Identification())
    assert [str(reason) for reason in find_interruptions(signals)] == [f"EpisodeAborted: {words}"]
    good = WindowSignals(replace(outcome.window, nc=NcMove(12, "part.ngc", (1.0, 1.0), False)), Identification())
    assert list(find_interruptions(good)) == []


@pytest.mark.fault("C7")
def test_quick_stop_is_refused_with_both_ramps() -> None:
    rates = drives.compute_path_speeds(MOVE)[:450]
    stop = np.maximum(rates[-1] - 16.0 * 1e-3 * np.arange(1, 60), 0.0)
    (reason,) = _list_reasons(_select_rows(np.concatenate([rates, stop])))
    assert reason.startswith("EpisodeAborted: the demand brakes with 1")


def test_drive_stopped_before_demand_is_refused_with_distance() -> None:
    short = _select_rows(drives.compute_path_speeds(Move(0.25, 0.5, 4.0, 0.02, 1)))
    n = short.signals["demand"].size
    whole = np.concatenate([demand_of(SCENE), np.full(n, 0.35)])[:n]
    (reason,) = _list_reasons(short.replace_signals(demand=whole))
    assert reason.startswith("EpisodeAborted: the axis comes to rest ")
    assert reason.endswith(" mm from its demand")


def test_drive_passing_through_rest_is_refused() -> None:
    held = faults.KINDS["feed hold"].make(np.random.default_rng([7, 2, 2049]))  # falls to 14 %, and swings through 0
    texts = [
        [str(r) for r in analyse_window(w, Identification()).verdict.reasons] for w in find_windows(held.recording)
    ]
    assert [len(reasons) > 0 for reasons in texts] == [True, True]
    assert texts[0] == ["EpisodeAborted: the demand continues at 42 mm/s while the drive passes through rest"]
    assert texts[1][0].startswith("EpisodeAborted: the demand continues at ")  # nor does the rest of it begin there


def _find_falling_rows(drop: float, time_s: Array) -> Array:
    return 1 - drop * np.clip((time_s - 0.25) / 0.01, 0, 1)


def test_drive_creeping_to_demanded_speed_is_not_held() -> None:
    slow = replace(DRIVE, position_gain=23.0, feedforward=0.45)
    scene = replace(SCENE, drive=slow, move=Move(0.12, 0.22, 7.4, 0.02, 1))
    for drop, message in ((0.0, []), (0.2, ["EpisodeAborted"])):
        rates = drives.compute_path_speeds(scene.move, partial(_find_falling_rows, drop))
        rows = measure_run(
            np.random.default_rng(7), scene, drives.simulate_loop(slow, demand_of(scene, rates), scene.dt_s)
        )
        (window,) = find_windows(make_recording(scene, rows))
        assert [reason.code for reason in find_interruptions(WindowSignals(window, Identification()))] == message


def test_slow_plateau_is_detected_with_coarse_scale() -> None:
    fallen = faults.KINDS["override changed"].make(np.random.default_rng([61, 2, 2888]))  # rows of 0.25 ms, slow ramps
    (window,) = find_windows(fallen.recording)
    (reason,) = find_interruptions(WindowSignals(window, Identification()))
    assert "held at 96." in reason.text


def test_feed_hold_to_rest_leaves_two_complete_moves() -> None:
    half = drives.compute_path_speeds(Move(0.2, 0.5, 4.0, 0.02, 1))
    outcomes = _analyse_recording(_select_rows(half, half))
    assert [o.verdict.accepted for o in outcomes] == [True, True]


def test_short_rapid_is_listed_only_above_60_percent() -> None:
    (outcome,) = _analyse_recording(_select_rows(drives.compute_path_speeds(Move(0.04, 0.5, 4.0, 0.02, 1))))
    assert [r.code for r in outcome.verdict.reasons][:1] == ["MissingStage(cruise)"]
    assert _analyse_recording(_select_rows(drives.compute_path_speeds(Move(0.015, 0.5, 4.0, 0.02, 1)))) == []


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("kind", faults.KINDS)
def test_no_accepted_fault_does_harm(kind: str) -> None:
    for seed in range(2):
        made = faults.KINDS[kind].make(np.random.default_rng([5, seed]))
        judged = assess_recording(kind, seed, made, draw_scene(np.random.default_rng([5, seed])))
        assert not judged.accepted or (kind in WEIGHED and judged.warned and not judged.harm), (seed, judged)
