"""From the last sample of a rapid to validated parameters: the daemon's own pipeline on recorded windows, warm.

And one ``fdhil identify`` from the start of its process, its kernels compiled before.

python -m benchmarks.identification
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fdhil import tables
from fdhil.config import Identification
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import AxisPipeline, analyse_window
from fdhil.pipeline.identified_loops import analyse_windows
from fdhil.records import Window
from fdhil.store.recording_csv import parse_recording
from studies import bench, real_plant
from tests.bench import bench_config

WINDOWS = 40
MACHINES = 8
SYNC_S = 0.001
ROWS = 1200
WANTED_MS, WANTED_CONFIGURED_MS, WANTED_COLD_S = 10, 40, 1.0
COLD = 5
NOISE = 0.005
DISTANCE_M = 0.453  # at 0.5 m/s: with its margins, the window has some rows more than ``ROWS``


def main() -> None:
    """Print the time of a window through each estimator with its validation, and through the pipeline."""
    windows = recorded(WINDOWS + 2)
    accepted = sum(analyse_window(window, Identification()).verdict.accepted for window in windows)
    print(f"{windows[0].n} samples a window, {WINDOWS} windows ({accepted} of {len(windows)} accepted)")
    wanted = f"{WANTED_MS}, with configuration and loops {WANTED_CONFIGURED_MS}"
    print(f"processor time in ms: median, least and largest (wanted: {wanted})")
    for method in tables.ESTIMATORS:
        settings = Identification(method=method)
        took = [_timed(partial(analyse_window, window, settings)) for window in windows][2:]
        print(f"{method:<22} estimate and validate {_figures(took)}")
    config = bench_config("X")
    pipeline = AxisPipeline("X", config)
    rapids = [simulate_nominal_rapid("X", config.axis["X"], 0.001, 1 - 2 * (k % 2), seed=k) for k in range(WINDOWS + 2)]
    took = [_timed(partial(pipeline.process_record, window)) for window in rapids][2:]
    print(f"{'pipeline':<22} {rapids[0].n} samples, with pool, history, skill {_figures(took)}")
    drawn_machines()
    cold_command()


def cold_command() -> None:
    """Print the processor time of ``fdhil identify`` of one rapid, a process of its own each time."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rapid.csv"
        path.write_text(
            bench.format_as_csv(
                bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=DISTANCE_M)), NOISE, 0
            )
        )
        command = [sys.executable, "-m", "fdhil.cli.main", "identify", "--json", str(path)]
        took = []
        for _ in range(COLD + 1):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            took.append(1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime))
    print(f"fdhil identify of one rapid, from its start (wanted: {1e3 * WANTED_COLD_S:.0f}) {_figures(took[1:])}")


def drawn_machines() -> None:
    """Print the time of a window of machines as they are, without and with configuration, and with other loops."""
    axis, settings = bench_config("X").axis["X"], Identification()
    machines = [
        real_plant.draw_machine(np.random.default_rng(seed), real_plant.Mechanics()) for seed in range(MACHINES)
    ]
    for label, known, filter_s in (("no", None, 0.0), ("with", axis, 0.0), ("with a filter more", axis, 2e-3)):
        took = []
        for seed, (mechanics, loops, sensors) in enumerate(machines):
            run = real_plant.simulate_axis(
                mechanics, bench.make_shuttle_demand(moves=4), replace(loops, speed_filter_s=filter_s)
            )
            windows = find_windows(real_plant.make_recording(run, mechanics, sensors, 0.5, seed))
            call = partial(analyse_windows, windows, settings, known, None if known is None else SYNC_S)
            if not seed:
                call()  # compiles what is not compiled yet
            took.append(_timed(call) / len(windows))
        print(f"{f'drawn machines, {label}':<38} configuration {_figures(took)}")


def recorded(count: int) -> list[Window]:
    """Return ``count`` windows of ``ROWS`` samples of the bench's rapid, each with its own noise."""
    signals = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=DISTANCE_M))
    texts = (bench.format_as_csv(signals, NOISE, seed) for seed in range(count))
    return [_cut(find_windows(parse_recording(text))[0]) for text in texts]


def _cut(window: Window) -> Window:
    """Return the window with ``ROWS`` rows: a few of standstill are left out at its end."""
    names = ("demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v")
    return replace(window, **{name: getattr(window, name)[:ROWS] for name in names})


def _timed(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return (time.process_time() - start) * 1e3


def _figures(took_ms: list[float]) -> str:
    return f"{statistics.median(took_ms):7.1f} {min(took_ms):7.1f} {max(took_ms):7.1f}"


if __name__ == "__main__":
    main()
