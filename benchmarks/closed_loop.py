"""The closed-loop kernel against the same kernel in C -O3, and against real time: one axis, one core.

Compiles closed_loop.c with the system's ``cc``; run as ``python -m benchmarks.closed_loop``.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fdhil.config import parse_config
from fdhil.model import closed_loop
from fdhil.model.closed_loop_drive import DriveModel
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float
from tests.bench import bench_config, bench_document
from tests.paths import build_bench_demand

REPEATS = 40
# what an ordinary machine has
TERMS = {
    "load": {"load": 2.0, "coulomb_positive": 5.2},
    "low speed": {"stribeck": 1.0, "stribeck_speed": 10.0},
    "ripples": {"ripple_screw_1": 0.3, "ripple_motor_24": 0.3},
    "all": {
        "load": 2.0,
        "stribeck": 1.0,
        "stribeck_speed": 10.0,
        "ripple_screw_1": 0.3,
        "ripple_motor_24": 0.3,
        "dead_time": 2.0,
    },
}
OPTIONS = {
    "torque_feedforward": 0.5,
    "setpoint_filter_s": 0.001,
    "setpoint_filter_order": 2,
    "current_delay_cycles": 1,
}


def compiled(folder: Path) -> ctypes.CDLL:
    """Compile the C kernel; RuntimeError when there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise RuntimeError("there is no C compiler: install gcc to compare with it")
    library = folder / "closed_loop.so"
    source = Path(__file__).with_suffix(".c")
    # as the Python kernel: no fused multiply-add beyond what the baseline processor has, no reordering
    flags = ["-O3", "-shared", "-fPIC", "-lm"]
    subprocess.run([compiler, str(source), "-o", str(library), *flags], check=True)
    return ctypes.CDLL(str(library))


def best(run: Callable[[], object]) -> float:
    """Return the shortest of many runs, in seconds of this thread's processor time."""
    times = []
    for _ in range(REPEATS):
        start = time.thread_time()
        run()
        times.append(time.thread_time() - start)
    return min(times)


def measure(terms: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return seconds per run in numba (leaping, and step by step) and in C, for the bench's X with ``terms``.

    Also the ratio of the last two, the real-time factor, and the largest difference in um.
    """
    config = bench_config()
    axis, model = config.axis["X"], build_nominal_models(config)["X"].replace_values(**terms or {})
    reference = np.ascontiguousarray(build_bench_demand(10.0)[:, 0])
    drive = closed_loop.prepare_drive(model, axis, 0.001)
    assert isinstance(drive, DriveModel)
    stepping, commands = replace(drive, leap=drive.leap[:0]), closed_loop.Commands(reference)
    start, n = closed_loop.create_standstill_state(model, axis, float(reference[0])), reference.size
    with tempfile.TemporaryDirectory() as folder:
        library = compiled(Path(folder))
        out, state = np.empty((7, n)), np.zeros(12)
        joined = np.empty(0) if drive.terms is None else drive.terms
        arrays = (reference, drive.plant, drive.gains, joined, state, out)
        r, p, g, t, s, o = (ctypes.c_void_p(array.ctypes.data) for array in arrays)
        long, size = ctypes.c_long, joined.size

        def c() -> Float:
            state[:] = start[:12]
            library.p_pi_pi(r, long(n), long(0), long(n), p, g, t, long(size), long(4), long(8), s, o)
            return out

        difference = float(np.abs(drive.run(commands, start).position_mm - c()[3]).max()) * 1e3
        numba, steps = (partial(one.run, commands, start) for one in (drive, stepping))
        seconds = {"numba_s": best(numba), "steps_s": best(steps), "c_s": best(c)}
    ratio = seconds["steps_s"] / seconds["c_s"]
    return seconds | {"ratio": ratio, "real_time": n * 0.001 / seconds["numba_s"], "difference_um": difference}


def structures() -> dict[str, float]:
    """Return how many times faster than real time each regulator structure runs with all its options on."""
    reference = np.ascontiguousarray(build_bench_demand(10.0)[:, 0])
    found = {}
    for name, own in (("p_pi_pi", {}), ("double_pi", {"position_ki_per_s2": 300.0}), ("pid", {"speed_ki": 0.0})):
        document = bench_document("X")
        document["axis"]["X"]["regulators"] |= OPTIONS | own | {"structure": name}
        config = parse_config(document)
        axis, model = config.axis["X"], build_nominal_models(config)["X"]
        seconds = best(partial(closed_loop.simulate_axis, model, axis, 0.001, reference))
        found[name] = reference.size * 0.001 / seconds
    return found


def main() -> None:
    """Print the figures."""
    figures = measure()
    print(f"closed loop, one axis, one core: {figures['real_time']:.0f} x real time (wanted: 1000)")
    print(f"bench path: {figures['numba_s'] * 1e3:.2f} ms; step by step {figures['steps_s'] * 1e3:.2f} ms,", end=" ")
    print(f"C -O3 step by step {figures['c_s'] * 1e3:.2f} ms: {figures['ratio']:.2f} x (wanted: <= 1.2);", end=" ")
    print(f"largest difference {figures['difference_um']:.1e} um")
    for name, terms in TERMS.items():
        figures = measure(terms)
        print(f"with {name}: {figures['real_time']:.0f} x real time,", end=" ")
        print(f"{figures['ratio']:.2f} x C, difference {figures['difference_um']:.1e} um")
    for name, real_time in structures().items():
        print(f"{name} with torque feed-forward, filter and delay: {real_time:.0f} x real time")


if __name__ == "__main__":
    main()
