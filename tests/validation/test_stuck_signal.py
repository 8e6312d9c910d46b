"""A stuck sensor is distinguished from a steady coarse signal by the probability of its repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import Window, freeze_array
from fdhil.validation.stuck_signal import estimate_noise_steps, find_stuck_sensors
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import WindowSignals
from studies import drives, faults, signal_faults
from studies.scenes import Sensor, demand_of, make_recording, measure_run
from tests.identification.bench_recordings import find_noisy_windows
from tests.validation.test_interruptions import SCENE

SETTINGS = Identification()
FIELDS = {"voltage": "voltage_v", "current": "current_a", "speed": "speed_rad_s"}


def _quantise_window(seed: int, **steps: float) -> Window:
    sizes = tuple(steps.get(name, 1e-4) for name in FIELDS)
    scene = replace(SCENE, noise=0.001, steps=(sizes[0], sizes[1], sizes[2]))
    rows = measure_run(
        np.random.default_rng(seed), scene, drives.simulate_loop(scene.drive, demand_of(scene), scene.dt_s)
    )
    return find_windows(make_recording(scene, rows))[0]


def _hold_reading(window: Window, name: str, start: int, length: int) -> Window:
    values = np.array(getattr(window, FIELDS[name]))
    values[start : start + length] = values[start]
    changed: Window = replace(window, **{FIELDS[name]: freeze_array(values)})  # type: ignore[arg-type]  # one of its arrays
    return changed


def _list_codes(window: Window) -> list[str]:
    return [reason.code for reason in analyse_window(window, SETTINGS).verdict.reasons]


@pytest.mark.parametrize("noise", [0.7, 3.0, 40.0])
def test_noise_in_steps_is_estimated_next_to_corner(noise: float) -> None:
    course = np.maximum(0.0, np.arange(2000.0) - 1000.0) * 3
    readings = np.round(course + noise * np.random.default_rng(1).standard_normal(course.size))
    assert estimate_noise_steps(readings) == pytest.approx(noise, rel=0.15)


@pytest.mark.parametrize("name", ["voltage", "current"])
def test_steady_coarse_signal_is_accepted(name: str) -> None:
    longest = 0
    for seed in range(3):
        window = _quantise_window(seed, **{name: 0.002})
        same = np.diff(np.flatnonzero(np.diff(getattr(window, FIELDS[name])[150:450]) != 0.0))
        longest = max(longest, int(same.max()))
        assert "StuckValue" not in _list_codes(window)
    assert longest > 15  # as long as a sensor may stick


@pytest.mark.parametrize("name", list(FIELDS))
def test_stuck_sensor_on_plateau_is_detected_by_missing_noise(name: str) -> None:
    window = find_noisy_windows(0.002)[0]
    begin, end = window.stages.cruise or (0, 0)
    assert _list_codes(window) == []
    assert "StuckValue" in _list_codes(_hold_reading(window, name, (begin + end) // 2, 20))


def test_stuck_coarse_sensor_is_detected_by_neighbours() -> None:
    refused = 0
    for seed in range(4):
        window = _quantise_window(seed, current=0.002)
        values = window.current_a
        # a level near the edge of its step changes its reading often
        rows = range(220, 380)
        changes = [np.count_nonzero(np.diff(values[k : k + 60])) for k in rows]
        start = rows[int(np.argmax(changes))]
        assert max(changes) > 10
        signals = WindowSignals(_hold_reading(window, "current", start, 60), SETTINGS)
        found = list(find_stuck_sensors(WindowFit(signals)))
        refused += any("current repeats" in reason.text for reason in found)
    assert refused == 4


def test_stuck_coarse_sensor_is_detected_by_other_signals() -> None:
    window = _quantise_window(3, current=0.002)
    begin, _ = window.stages.cruise or (0, 0)  # the current falls from accelerating to steady
    assert "StuckValue" in _list_codes(_hold_reading(window, "current", begin - 25, 30))


def test_study_fault_changes_sensor_reading() -> None:
    scene = replace(SCENE, noise=0.001, steps=(0.02, 0.02, 0.02))  # the plateau reads alike throughout
    for seed in range(12):
        rng = np.random.default_rng(seed)
        before = measure_run(rng, scene, drives.simulate_loop(scene.drive, demand_of(scene), scene.dt_s))
        after, _ = signal_faults.stuck(rng, before)
        assert any((after.signals[name] != before.signals[name]).any() for name in FIELDS)


def test_sensor_moves_only_beyond_noise_and_step() -> None:
    ramp = Sensor(np.linspace(0.0, 20.0, 21), 0.6, 0.8)
    assert ramp.is_moving_beyond(0, 8)
    assert not ramp.is_moving_beyond(0, 7)


@pytest.mark.parametrize(
    ("study", "seed", "rows"),
    [(41, 360, 3), (81, 1680, 8), (101, 3540, 10)],  # the others: cut off again beside that run, in noise of many steps
)
def test_clipped_peak_is_refused(study: int, seed: int, rows: int) -> None:
    clipped = faults.KINDS["sensor clipped"].make(np.random.default_rng([study, 2, seed]))
    (window,) = find_windows(clipped.recording)
    (reason,) = (r for r in analyse_window(window, SETTINGS).verdict.reasons if r.code == "Saturated")
    assert f"for {rows} samples" in reason.text


def test_unclipped_peak_is_accepted() -> None:
    for seed in range(4):
        assert "Saturated" not in _list_codes(_quantise_window(seed, voltage=0.002))
