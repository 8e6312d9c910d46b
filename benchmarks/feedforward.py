"""The on-line feed-forward: what the targets alone, as the guard hears them, take off the tracking error.

Run as ``python -m benchmarks.feedforward``. The law is the guard's own, in whole numbers, on plants that scatter as
identified models do; the same on the simulated machine's bus: ``pytest tests/integration/test_feedforward.py``.
"""

from __future__ import annotations

import math
import timeit

import numpy as np

from benchmarks.inverse import scatter_plants
from fdhil.config import MachineConfig
from fdhil.correction.flatness_feedforward import derive_feedforward_law
from fdhil.guard.feedforward_law import Law
from fdhil.guard.request_parsing import parse_law
from fdhil.model import closed_loop
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float
from tests.correction.test_correction_planner import change_config
from tests.paths import build_bench_demand, build_jerky_demand

PLANTS = 10
CASES = (
    ("bench, 10 m/min", build_bench_demand(10), 1.0, 3),
    ("bench, 20 m/min", build_bench_demand(20), 1.0, 3),
    ("lag (Kff 0.5), 10 m/min", build_bench_demand(10), 0.5, 50),
    ("lag (Kff 0.5), 20 m/min", build_bench_demand(20), 0.5, 50),
    ("jerky, 10 m/min", build_jerky_demand(10), 1.0, 0),
)


def guard_law(config: MachineConfig, axis: str) -> Law:
    """Return the law as it reaches the guard."""
    found = parse_law(
        dict(
            derive_feedforward_law(build_nominal_models(config)[axis], config.axis[axis], config.machine.sync_period_s)
        )
    )
    assert found is not None
    return found


def extract_offsets(config: MachineConfig, axis: str, path: Float) -> tuple[Float, Float]:
    """Return speed (rad/s) and torque offset (N.m), (n,): each row's from the targets before it, as on the bus."""
    own, drive = guard_law(config, axis), config.axis[axis].drive
    targets = np.rint(path * config.axis[axis].scaling.increments_per_mm).astype(np.int64).tolist()
    targets = [targets[0]] * (own.depth + 1) + targets
    pairs = np.array(
        [own.compute_offsets(targets[k : k - own.depth : -1]) for k in range(own.depth, own.depth + path.size)]
    )
    torque = 1e-3 * config.axis[axis].nominal.K * drive.rated_current_a
    return pairs[:, 0] * 2 * math.pi / drive.increments_per_rev, pairs[:, 1] * torque


def compute_errors_um(demand: Float, config: MachineConfig) -> tuple[float, list[float]]:
    """Return the largest tracking error without the feed-forward, and with it on each plant."""
    period = config.machine.sync_period_s
    paths = {axis: np.ascontiguousarray(demand[:, k]) for k, axis in enumerate("XY")}
    offsets = {axis: extract_offsets(config, axis, path) for axis, path in paths.items()}
    speed, torque = ({axis: pair[which] for axis, pair in offsets.items()} for which in (0, 1))

    def largest(responses: dict[str, closed_loop.Response]) -> float:
        return max(1e3 * float(np.abs(responses[axis].position_mm - path).max()) for axis, path in paths.items())

    before = largest(closed_loop.simulate_axes(build_nominal_models(config), config.axis, period, paths))
    random = np.random.default_rng(1)
    after = [
        largest(
            closed_loop.simulate_axes(
                scatter_plants(random), config.axis, period, paths, speed_offset_rad_s=speed, torque_offset_nm=torque
            )
        )
        for _ in range(PLANTS)
    ]
    return before, after


def main() -> None:
    """Print the figures."""
    print(f"largest tracking error of {PLANTS} plants that scatter as identified models do")
    print(f"{'path':28}{'before um':>11}{'after um':>10}{'times':>8}{'wanted':>8}")
    for name, demand, feedforward, wanted in CASES:
        before, after = compute_errors_um(demand, change_config(speed_feedforward=feedforward))
        print(f"{name:28}{before:11.1f}{max(after):10.1f}{before / max(after):8.1f}{wanted:8}")
    own = guard_law(change_config(), "X")
    targets = list(range(0, 10 * own.depth, 10))
    turns = 20_000
    print(
        f"one axis' law in the guard: "
        f"{timeit.timeit(lambda: own.compute_offsets(targets), number=turns) / turns * 1e6:.0f} us"
    )


if __name__ == "__main__":
    main()
