"""The closed-loop kernel against the same kernel in C -O3, and against real time: one axis, one core.

Compiles closed_loop.c with the system's ``cc``; run as ``python -m benchmarks.closed_loop``.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from fdhil.config import parse
from fdhil.model import closed_loop, kernels
from fdhil.model.leap import leap
from fdhil.model.loops import gains as loop_gains
from fdhil.model.loops import plant_step
from fdhil.prediction.models import nominal_models
from fdhil.records import Float
from tests.bench import bench_config, bench_document
from tests.paths import bench_demand

REPEATS = 40
N_SPEED, N_CURRENT = 4, 8
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


def measure() -> dict[str, float]:
    """Return seconds per run in numba (leaping, and step by step) and in C.

    Also the ratio of the last two, the real-time factor, and the largest difference in um.
    """
    config = bench_config()
    axis, model = config.axis["X"], nominal_models(config)["X"]
    reference = np.ascontiguousarray(bench_demand(10.0)[:, 0])
    plant = plant_step(model, axis.screw_pitch_mm, axis.regulators.current_period_s)
    gains, n = loop_gains(axis, 0.001), reference.size
    whole = leap(plant, gains[kernels.CURRENT_KP], gains[kernels.CURRENT_KI], N_CURRENT)
    empty, one_mass = np.empty(0), np.empty((0, 5, 8))
    shape = (kernels.CASCADE, kernels.POSITION_INTEGRAL, N_SPEED, N_CURRENT, 0, 0)

    def numba(leaps: Float = whole) -> Float:
        state = np.zeros(kernels.STATES)
        return kernels.run(reference, empty, empty, 0, n, plant, leaps, one_mass, gains, empty, shape, state)

    with tempfile.TemporaryDirectory() as folder:
        library = compiled(Path(folder))
        out, state = np.empty((7, n)), np.zeros(12)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (reference, plant, gains, state, out)]

        def c() -> Float:
            state[:] = 0.0
            r, p, g, s, o = pointers
            long = ctypes.c_long
            library.p_pi_pi(r, long(n), long(0), long(n), p, g, long(N_SPEED), long(N_CURRENT), s, o)
            return out

        difference = float(np.abs(numba()[3] - c()[3]).max()) * 1e3
        steps = partial(numba, np.empty((0, kernels.LEAP_COLUMNS)))
        seconds = {"numba_s": best(numba), "steps_s": best(steps), "c_s": best(c)}
    ratio = seconds["steps_s"] / seconds["c_s"]
    return seconds | {"ratio": ratio, "real_time": n * 0.001 / seconds["numba_s"], "difference_um": difference}


def structures() -> dict[str, float]:
    """Return how many times faster than real time each regulator structure runs with all its options on."""
    reference = np.ascontiguousarray(bench_demand(10.0)[:, 0])
    found = {}
    for name, own in (("p_pi_pi", {}), ("double_pi", {"position_ki_per_s2": 300.0}), ("pid", {"speed_ki": 0.0})):
        document = bench_document("X")
        document["axis"]["X"]["regulators"] |= OPTIONS | own | {"structure": name}
        config = parse(document)
        axis, model = config.axis["X"], nominal_models(config)["X"]
        seconds = best(partial(closed_loop.simulate, model, axis, 0.001, reference))
        found[name] = reference.size * 0.001 / seconds
    return found


def main() -> None:
    """Print the figures."""
    figures = measure()
    print(f"closed loop, one axis, one core: {figures['real_time']:.0f} x real time (wanted: 1000)")
    print(f"bench path: {figures['numba_s'] * 1e3:.2f} ms; step by step {figures['steps_s'] * 1e3:.2f} ms,", end=" ")
    print(f"C -O3 step by step {figures['c_s'] * 1e3:.2f} ms: {figures['ratio']:.2f} x (wanted: <= 1.2);", end=" ")
    print(f"largest difference {figures['difference_um']:.1e} um")
    for name, real_time in structures().items():
        print(f"{name} with torque feed-forward, filter and delay: {real_time:.0f} x real time")


if __name__ == "__main__":
    main()
