"""``python -m studies.kernels``: compile the kernels of the independent plants once (``make setup`` runs it)."""

from __future__ import annotations

import numpy as np

from studies import bench, drives, real_plant


def compile_all() -> None:
    """Move each plant by one rapid."""
    demand_m = bench.make_shuttle_demand()
    bench.simulate_bench(bench.Plant(), demand_m)
    drives.simulate_loop(drives.draw_drive(np.random.default_rng(1), 0.5, 4.0), demand_m, drives.CYCLE_S)
    real_plant.simulate_axis(real_plant.Mechanics(), demand_m)


if __name__ == "__main__":
    compile_all()
