"""Rapids found in recordings: edges, stages, and moves that are not rapids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification.rapid_windows import find_moving_range, find_windows
from fdhil.records import Recording
from fdhil.store.recording_csv import parse_recording
from studies import bench
from tests.identification.bench_recordings import record_noisy_shuttle


def _list_moves(recording: Recording) -> list[tuple[float, float]]:
    found = []
    for window in find_windows(recording):
        a, b = find_moving_range(window)
        found.append((window.start_s + a * window.dt_s, window.start_s + b * window.dt_s))
    return found


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
def test_shuttle_yields_a_window_per_move(noise: float) -> None:
    shuttle = record_noisy_shuttle(noise, moves=2)
    windows = find_windows(shuttle)
    assert [w.direction for w in windows] == [1, -1]
    (start, end), _ = _list_moves(shuttle)
    assert start == pytest.approx(0.055, abs=0.02)
    assert end == pytest.approx(0.055 + 0.925 + 0.02 + 0.02, abs=0.04)
    for window in windows:
        stages = window.stages
        assert stages.accelerate is not None
        assert stages.cruise is not None
        assert stages.brake is not None
        assert stages.accelerate[1] - stages.accelerate[0] == pytest.approx(135, abs=15)


def test_stages_are_found_in_a_quarter_millisecond_recording() -> None:
    windows = find_windows(record_noisy_shuttle(0.005, dt_s=2.5e-4))
    assert len(windows) == 1
    assert windows[0].stages.cruise is not None
    assert windows[0].stages.cruise[1] - windows[0].stages.cruise[0] > 2500


def test_feed_moves_are_excluded_and_short_rapids_lack_a_cruise() -> None:
    feed = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=0.05, speed=0.08))
    assert find_windows(parse_recording(bench.format_as_csv(feed))) == []
    short = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=0.05))
    windows = find_windows(parse_recording(bench.format_as_csv(short)))
    assert len(windows) == 1
    assert windows[0].stages.cruise is None


def test_rapid_speed_is_taken_from_header_then_machine_then_file() -> None:
    whole = record_noisy_shuttle(0.001)
    bare = replace(whole, rapid_speed_rad_s=None)
    assert find_windows(whole, 999.0)[0].rapid_speed_rad_s == whole.rapid_speed_rad_s
    assert find_windows(bare, 160.0)[0].rapid_speed_rad_s == 160.0
    assert find_windows(bare)[0].rapid_speed_rad_s == pytest.approx(157, rel=0.02)
    assert find_windows(bare, 400.0) == []


def test_recording_cut_within_a_move_lacks_that_stage() -> None:
    text = bench.format_as_csv(bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand()), 0.001).splitlines(
        keepends=True
    )
    head = next(k for k, line in enumerate(text) if line.startswith("time_s")) + 1
    late = find_windows(parse_recording("".join(text[:head] + text[head + 300 :])))
    assert late[0].stages.accelerate is None
    early = find_windows(parse_recording("".join(text[: head + 700])))
    assert early[0].stages.brake is None


def test_gaps_are_converted_to_window_samples() -> None:
    text = bench.format_as_csv(bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand()), 0.001).splitlines(
        keepends=True
    )
    head = next(k for k, line in enumerate(text) if line.startswith("time_s")) + 1
    window = find_windows(parse_recording("".join(text[: head + 500] + text[head + 503 :])))[0]
    ((a, b),) = window.gaps
    assert b - a == 3
    assert np.isnan(window.speed_rad_s[a:b]).all()
    assert window.start_s + a * window.dt_s == pytest.approx(0.5)


def test_standstill_yields_no_windows() -> None:
    still = bench.simulate_bench(bench.Plant(), np.zeros(400))
    assert find_windows(parse_recording(bench.format_as_csv(still))) == []
    silent = replace(parse_recording(bench.format_as_csv(still, 0.0)), rapid_speed_rad_s=None)
    assert find_windows(silent) == []


def test_nan_readings_do_not_disturb_the_window_search() -> None:
    whole = record_noisy_shuttle(0.002)
    speed = np.array(whole.speed_rad_s)
    speed[[400, 401, 403, 404]] = np.inf  # their differences are not numbers either
    assert len(find_windows(replace(whole, speed_rad_s=speed))) == 1
