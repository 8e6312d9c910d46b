"""From the last sample of a rapid to validated parameters: the daemon's own pipeline on recorded windows, warm.

python -m benchmarks.identification
"""

from __future__ import annotations

import statistics
import time

from fdhil import tables
from fdhil.config import Identification
from fdhil.daemon.warm import nominal_rapid
from fdhil.pipeline import AxisPipeline
from fdhil.validation import analyse
from tests.bench import bench_config

WINDOWS = 40


def main() -> None:
    """Print the median time of a window through each estimator with its validation, and through the pipeline."""
    config = bench_config("X")
    axis = config.axis["X"]
    windows = [nominal_rapid("X", axis, 0.001, 1 - 2 * (k % 2), seed=k) for k in range(WINDOWS + 2)]
    print(f"{windows[0].n} samples a window, {WINDOWS} windows, median and largest in ms")
    for method in tables.ESTIMATORS:
        settings = Identification(method=method)
        took = [_timed(lambda w=window, s=settings: analyse(w, s)) for window in windows][2:]
        print(f"{method:<22} estimate and validate {_figures(took)}")
    pipeline = AxisPipeline("X", config)
    took = [_timed(lambda w=window: pipeline.feed(w)) for window in windows][2:]
    print(f"{'pipeline':<22} with pool, history, skill {_figures(took)}")


def _timed(call: object) -> float:
    assert callable(call)
    start = time.perf_counter()
    call()
    return (time.perf_counter() - start) * 1e3


def _figures(took_ms: list[float]) -> str:
    return f"{statistics.median(took_ms):7.1f} {max(took_ms):7.1f}"


if __name__ == "__main__":
    main()
