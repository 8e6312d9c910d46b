"""Rapids of the simulated bench whose voltage comes from a sensor with a slower grid and clock of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.identification.windows import find_windows
from fdhil.records import SlowVoltage, VoltageSampling, Window, frozen
from fdhil.store.recording_csv import parse_recording
from studies import bench
from tests.identification.recorded import signals


def slow_windows(
    period_s: float = 0.005,
    sampling: VoltageSampling = "interval_mean",
    delay_s: float = 0.0,
    noise: float = 0.001,
    seed: int = 1,
    moves: int = 1,
    begin_s: float = 0.0017,
) -> list[Window]:
    """Return the rapids of a shuttle; sample j of the voltage truly covers ``begin_s`` + j ``period_s`` - ``delay_s``.

    The true voltage is taken from the bench every 31.25 us, so means and instants are the sensor's own.
    """
    clean = signals(moves=moves)
    fine = bench.run(bench.Plant(), bench.shuttle(moves=moves), dt_s=bench.STEP_S).voltage
    rng = np.random.default_rng(1000 + seed)
    found = find_windows(parse_recording(bench.as_csv(clean, noise, seed)))
    swept = np.concatenate([[0.0], np.cumsum(fine)]) * bench.STEP_S
    grid = np.arange(swept.size) * bench.STEP_S
    answer = []
    for window in found:
        count = int((window.n * window.dt_s - begin_s) / period_s)
        begin = window.start_s + begin_s - delay_s + np.arange(count) * period_s
        if sampling == "instant":
            told = fine[np.clip((begin / bench.STEP_S + 1e-6).astype(int), 0, fine.size - 1)]
        else:
            told = (np.interp(begin + period_s, grid, swept) - np.interp(begin, grid, swept)) / period_s
        told = told + noise * 60 * rng.standard_normal(count)
        slow = SlowVoltage(begin_s, period_s, 0.0002, frozen(told))
        answer.append(replace(window, voltage_v=None, voltage_sampling=sampling, slow_voltage=slow))
    return answer
