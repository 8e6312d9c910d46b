"""Windows of the simulated bench, ready to be identified."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from fdhil.identification.rapid_windows import find_windows
from fdhil.records import Recording, Window
from fdhil.store.recording_csv import parse_recording
from studies import bench

NOMINAL = bench.Plant()


@lru_cache(maxsize=8)
def simulate_bench_shuttle(
    moves: int = 1, first: int = 1, plant: bench.Plant = NOMINAL, dt_s: float = 1e-3
) -> bench.Signals:
    """Return a noise-free shuttle of the bench."""
    return bench.simulate_bench(plant, bench.make_shuttle_demand(moves=moves, first=first), dt_s=dt_s)


def record_noisy_shuttle(noise: float = 0.001, seed: int = 1, **options: Any) -> Recording:
    """Return a noisy recording of a shuttle."""
    return parse_recording(bench.format_as_csv(simulate_bench_shuttle(**options), noise, seed))


def find_noisy_windows(noise: float = 0.001, seed: int = 1, **options: Any) -> list[Window]:
    """Return the rapids of a noisy shuttle."""
    return find_windows(record_noisy_shuttle(noise, seed, **options))
