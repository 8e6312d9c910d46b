"""A learned offset is useful only if LinuxCNC repeats the same demand: does it?"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fdhil.records import Float
from tests.linuxcnc.linuxcnc_process import LinuxCnc
from tests.sim.simulator_process import SimulatorProcess, write_config

pytestmark = pytest.mark.debian
RUNS, LEAST_SAME = 6, 3

PART = """G21 G90 G17 G64 P0.02
F9000
G1 X30 Y20
G3 X10 Y40 I-20
G1 X0 Y0
G4 P0.3
G0 X40 Y10
G1 X60 Y30
G0 X0 Y0
M2
"""


def split_motions(reference_mm: Float) -> list[Float]:
    """The demand (n, axes) of each stretch between two rests."""
    moves = np.abs(np.diff(reference_mm, axis=0)).max(axis=1) > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moves.astype(int), [0]])))
    return [reference_mm[a : b + 1] for a, b in zip(edges[::2], edges[1::2], strict=True)]


def test_repeated_runs_are_identical_between_rests(tmp_path: Path) -> None:
    """A rest may differ by a cycle: LinuxCNC's dwell ends when its task checks the clock.

    A host without time for LinuxCNC's task starves its planner, which then slows down between two blocks: such a run is
    unique. Therefore the identical runs are counted.
    """
    config = write_config(tmp_path, 'pace = "lockstep"\nmodbus = false')
    with SimulatorProcess(config, "--demand", "-", "--trace", tmp_path / "trace.csv") as twin:
        with LinuxCnc() as nc, nc.drive_simulator(twin):
            for _ in range(RUNS):
                nc.run(PART)
        assert twin.wait_for_event("finished")["starved"] == 0
    table = np.genfromtxt(tmp_path / "trace.csv", delimiter=",", names=True)
    runs = split_motions(np.column_stack([table["X_reference_mm"], table["Y_reference_mm"]]))
    ordered = Counter(run.tobytes() for run in runs)
    same = [times for _, times in ordered.most_common(2)]
    assert min(same) >= LEAST_SAME, ordered.values()
