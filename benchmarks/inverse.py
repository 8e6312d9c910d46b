"""The inverse correction: how soon the first block is there, how fast it runs, what it leaves on scattered plants.

Run as ``python -m benchmarks.inverse``.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fdhil.correction import mirror, plan_correction
from fdhil.correction.block_streaming import stream_blocks
from fdhil.model import closed_loop, closed_loop_kernels
from fdhil.prediction import compute_contour_error_um, predict_corrected_path, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float, Parameters
from tests.bench import bench_config
from tests.correction.test_correction_planner import change_config
from tests.paths import build_bench_demand, build_jerky_demand, build_rounded_demand, build_trajectory, compute_rms

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
SCATTER = {"R": 0.001, "L": 0.003, "K": 0.0005, "Jt": 0.001, "ft": 0.02, "Cd": 0.03}
PLANTS = 40
REPEATS = 15
HOUR_S = 3600.0
FAST, SHARP = (0.060, 0.030), (0.030, 0.015)


@dataclass(frozen=True, slots=True)
class Case:
    """A demand and what is wanted of it: the least gain over uncorrected and over the mirror."""

    name: str
    demand: Float
    gain: float
    over_mirror: float


CASES = (
    Case("bench, 10 m/min, 60 + 30 ms", build_bench_demand(10, FAST), 60, 8),
    Case("bench, 20 m/min, 60 + 30 ms", build_bench_demand(20, FAST), 60, 8),
    Case("bench, 10 m/min, 30 + 15 ms", build_bench_demand(10, SHARP), 60, 8),
    Case("rounded, 10 m/min, 60 + 30 ms", build_rounded_demand(10, FAST), 0, 0),
    Case("rounded, 20 m/min, 60 + 30 ms", build_rounded_demand(20, FAST), 0, 0),
    Case("jerky, 10 m/min, 2 m/s2", build_jerky_demand(10), 14, 2),
    Case("jerky, 20 m/min, 2 m/s2", build_jerky_demand(20), 14, 2),
)
# (Kff, feed in m/min): what a lagging drive can still have, and where it is refused
LAGS = ((0.5, 2.0), (0.5, 4.0), (0.5, 10.0), (0.0, 1.0), (0.0, 2.0), (0.0, 10.0))


def scatter_plants(random: np.random.Generator) -> dict[str, Parameters]:
    """Plants that differ from the model by the scatter of a model from one rapid."""
    return {
        axis: replace(model, **{k: getattr(model, k) * (1 + s * random.standard_normal()) for k, s in SCATTER.items()})
        for axis, model in MODELS.items()
    }


def _pieces(demand: Float, size: int = 50) -> Iterator[Mapping[str, Float]]:
    for first in range(0, len(demand), size):
        yield {axis: demand[first : first + size, a] for a, axis in enumerate("XY")}


def _repeat_path(seconds: float) -> Iterator[Mapping[str, Float]]:
    """The bench path there and back, again and again, made while it is used."""
    there = build_bench_demand(10)
    loop = np.concatenate([there, there[::-1]])
    for _ in range(round(seconds / (len(loop) * 0.001))):
        yield from _pieces(loop)


def measure_first_block() -> tuple[float, float]:
    """Return the shortest wall and processor time from the last row of the first 2.5 s of path to the first block."""
    demand = build_bench_demand(10)[:2550]
    begun = [0.0, 0.0]

    def arriving() -> Iterator[Mapping[str, Float]]:
        for piece in _pieces(demand):
            begun[:] = time.perf_counter(), time.process_time()
            yield piece

    wall, cpu = [], []
    for _ in range(REPEATS):
        next(stream_blocks(arriving(), MODELS, CONFIG))
        wall.append(time.perf_counter() - begun[0])
        cpu.append(time.process_time() - begun[1])
    return min(wall), min(cpu)


def measure_throughput(seconds: float) -> tuple[float, float, float]:
    """Return real-time factor per processor second of two axes, growth of memory in MB, largest error in um."""
    largest, marks, rows = 0.0, [], 0
    busy = time.process_time()
    for block in stream_blocks(_repeat_path(seconds), MODELS, CONFIG):
        largest = max(largest, float(block.after_um.max()))
        rows += block.after_um.size
        marks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    factor = rows * 0.001 / (time.process_time() - busy)
    return factor, marks[-1] - marks[len(marks) // 20], largest


def measure_seam_error() -> float:
    """Return by how much (um) the error is larger within 0.1 s of a seam than it is there with seams elsewhere."""
    there = build_bench_demand(10)
    path = np.concatenate([there, there[::-1], there])
    shift = 731  # rows of rest ahead move every seam to another place of the path
    later = np.concatenate([np.repeat(path[:1], shift, axis=0), path])
    errors = [np.concatenate([b.after_um for b in stream_blocks(_pieces(p), MODELS, CONFIG)]) for p in (path, later)]
    near = np.zeros(len(path), dtype=np.bool_)
    for seam in range(2000, len(path) - 500, 2000):
        near[seam - 100 : seam + 100] = True
    return float(errors[0][near].max() - max(errors[1][shift:][near].max(), errors[0][~near].max()))


def measure_gains(demand: Float) -> tuple[Float, tuple[float, float]]:
    """Return (PLANTS, 4): gain over uncorrected, over mirror, largest rise of a point and of a zone's maximum (um).

    Also the RMS (um) before and after on the plant that is the model.
    """
    reference = build_trajectory(demand)
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    assert not correction.refused, correction.refused
    mirrored = mirror.plan_mirror_offsets(
        reference, MODELS, CONFIG, correction.before
    ).offset_um  # ungated: also where it harms
    random = np.random.default_rng(1)
    rows = []
    for _ in range(PLANTS):
        plants = scatter_plants(random)
        before = predict_path(reference, plants, CONFIG)
        after, other = (
            predict_corrected_path(reference, plants, CONFIG, offset).contour_um
            for offset in (correction.offset_um, mirrored)
        )
        zones = [
            after[(reference.time_s >= z.start_s) & (reference.time_s < z.end_s)].max() - z.max_um for z in before.zones
        ]
        worse = float((after - before.contour_um).max())
        rows.append(
            (
                compute_rms(before.contour_um) / compute_rms(after),
                compute_rms(other) / compute_rms(after),
                worse,
                max(zones, default=-np.inf),
            )
        )
    return np.array(rows), (compute_rms(correction.before.contour_um), compute_rms(correction.after.contour_um))


def measure_start_error(share: float) -> tuple[float, float]:
    """Return RMS and largest error (um) when each axis rests at the start with that share of its dry friction in use.

    The plan takes the regulators as empty there: what the last move before the program left in them it cannot know.
    """
    demand = build_bench_demand(10)
    offsets = plan_correction(build_trajectory(demand), MODELS, CONFIG, "inverse").offset_um
    places = []
    for a, name in enumerate("XY"):
        model, state = MODELS[name], closed_loop.create_zero_state(float(demand[0, a]))
        state[[closed_loop_kernels.CURRENT, closed_loop_kernels.SPEED_INTEGRAL, closed_loop_kernels.CURRENT_DEMAND]] = (
            share * model.Cd / model.K
        )
        state[closed_loop_kernels.CURRENT_INTEGRAL] = model.R * state[closed_loop_kernels.CURRENT]
        commanded = demand[:, a] + offsets[name] * 1e-3
        places.append(closed_loop.simulate_axis(model, CONFIG.axis[name], 0.001, commanded, state=state).position_mm)
    errors = compute_contour_error_um(demand, np.column_stack(places), 0.001)
    return compute_rms(errors), float(errors.max())


def _print_cases() -> None:
    print(f"\n{PLANTS} plants that scatter as identified models do; least gain, most harm (wanted: <= 2 um, <= 1 um)")
    print(f"{'path':32}{'RMS um':>8}{'left':>7}{'gain >=':>9}{'wanted':>8}{'/mirror':>9}{'wanted':>8}", end="")
    print(f"{'point':>8}{'zone':>8}")
    for case in CASES:
        g, (before, after) = measure_gains(case.demand)
        print(f"{case.name:32}{before:8.1f}{after:7.2f}{g[:, 0].min():9.0f}{case.gain:8.0f}", end="")
        print(f"{g[:, 1].min():9.1f}{case.over_mirror:8.0f}{g[:, 2].max():8.2f}{g[:, 3].max():8.2f}")


def _print_lags() -> None:
    print("\na drive without its speed feed-forward, bench path")
    for feedforward, feed in LAGS:
        correction = plan_correction(
            build_trajectory(build_bench_demand(feed)), MODELS, change_config(speed_feedforward=feedforward), "inverse"
        )
        message = "; ".join(f"{r.code}: {r.text}; {r.advice}" for r in correction.refused[:1])
        left = (
            f"{compute_rms(correction.before.contour_um):.1f} -> {compute_rms(correction.after.contour_um):.2f} um RMS"
        )
        print(f"Kff {feedforward:.1f}, {feed:4.1f} m/min: {message or left}")


def main() -> None:
    """Print the figures."""
    measure_first_block()
    wall, cpu = measure_first_block()
    print(f"first block after 2.5 s of path: {wall * 1e3:.0f} ms, {cpu * 1e3:.0f} ms of processor (wanted: 50)")
    factor, growth, largest = measure_throughput(HOUR_S)
    print(f"an hour of path, two axes on one core: {factor:.0f} x real time (wanted: 20); ", end="")
    print(f"memory grows by {growth:.1f} MB; largest error {largest:.2f} um")
    print(f"a seam adds {max(0.0, measure_seam_error()):.3f} um (wanted: < 0.05)")
    for share in (0.0, 0.5, 0.9, -0.9):
        print(f"at the start the regulators hold {share:.0%} of the dry friction:", end=" ")
        print("{:.2f} um RMS is left, {:.1f} um at most".format(*measure_start_error(share)))
    _print_cases()
    _print_lags()


if __name__ == "__main__":
    main()
