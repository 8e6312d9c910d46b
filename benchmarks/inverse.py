"""The inverse correction: how soon the first block is there, how fast it runs, what it leaves on scattered plants.

Run as ``python -m benchmarks.inverse``.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from fdhil.correction import plan
from fdhil.correction.streaming import stream
from fdhil.prediction import predict, predict_corrected
from fdhil.prediction.models import nominal_models
from fdhil.records import Float, Parameters
from tests.bench import bench_config
from tests.paths import bench_demand, bench_trajectory, rms

CONFIG = bench_config()
MODELS = nominal_models(CONFIG)
SCATTER = {"R": 0.001, "L": 0.003, "K": 0.0005, "Jt": 0.001, "ft": 0.02, "Cd": 0.03}
PLANTS = 40
REPEATS = 15


def scattered(random: np.random.Generator) -> dict[str, Parameters]:
    """Plants that differ from the model by the scatter of a model from one rapid."""
    return {
        axis: replace(model, **{k: getattr(model, k) * (1 + s * random.standard_normal()) for k, s in SCATTER.items()})
        for axis, model in MODELS.items()
    }


def _pieces(demand: Float, size: int = 50) -> Iterator[Mapping[str, Float]]:
    for first in range(0, len(demand), size):
        yield {axis: demand[first : first + size, a] for a, axis in enumerate("XY")}


def first_block() -> tuple[float, float]:
    """Return the shortest wall and processor time to the first block once 2.5 s of path exist."""
    demand = bench_demand(10)[:2502]
    wall, cpu = [], []
    for _ in range(REPEATS):
        start, busy = time.perf_counter(), time.process_time()
        next(stream(_pieces(demand, 2502), MODELS, CONFIG))
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - busy)
    return min(wall), min(cpu)


def throughput(repeats: int = 20) -> tuple[float, float, float]:
    """Return real-time factor per processor second of two axes, growth of memory in MB, largest error in um."""
    there = bench_demand(10)
    demand = np.tile(np.concatenate([there, there[::-1]]), (repeats, 1))
    largest, marks = 0.0, []
    busy = time.process_time()
    for block in stream(_pieces(demand), MODELS, CONFIG):
        largest = max(largest, float(block.after_um.max()))
        marks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    factor = len(demand) * 0.001 / (time.process_time() - busy)
    return factor, marks[-1] - marks[len(marks) // 4], largest


def gains(feed: float, smoothing: tuple[float, float]) -> Float:
    """Return (PLANTS, 4): gain over uncorrected, over mirror, largest rise of a point and of a zone's maximum (um)."""
    reference = bench_trajectory(feed, smoothing)
    corrections = [plan(reference, MODELS, CONFIG, method).offset_um for method in ("inverse", "mirror")]
    random = np.random.default_rng(1)
    rows = []
    for _ in range(PLANTS):
        plants = scattered(random)
        before = predict(reference, plants, CONFIG)
        after, mirrored = (predict_corrected(reference, plants, CONFIG, o).contour_um for o in corrections)
        zones = [
            after[(reference.time_s >= z.start_s) & (reference.time_s < z.end_s)].max() - z.max_um for z in before.zones
        ]
        worse = float((after - before.contour_um).max())
        rows.append((rms(before.contour_um) / rms(after), rms(mirrored) / rms(after), worse, max(zones)))
    return np.array(rows)


def main() -> None:
    """Print the figures."""
    first_block()
    wall, cpu = first_block()
    print(f"first block after 2.5 s of path: {wall * 1e3:.0f} ms, {cpu * 1e3:.0f} ms of processor (wanted: 50)")
    factor, growth, largest = throughput()
    print(
        f"stream of two axes on one core: {factor:.0f} x real time (wanted: 20); memory grows by {growth:.1f} MB;",
        end=" ",
    )
    print(f"largest error {largest:.2f} um")
    for feed, smoothing in ((10, (0.060, 0.030)), (20, (0.060, 0.030)), (10, (0.030, 0.015))):
        g = gains(feed, smoothing)
        text = f"least gain {g[:, 0].min():.0f} (wanted: 60), over mirror {g[:, 1].min():.0f} (wanted: 8)"
        print(
            f"{feed} m/min, {smoothing[0] * 1e3:.0f} + {smoothing[1] * 1e3:.0f} ms, {PLANTS} plants: {text},", end=" "
        )
        print(f"point worse by {g[:, 2].max():.2f} um (2), zone by {g[:, 3].max():.2f} um (1)")


if __name__ == "__main__":
    main()
