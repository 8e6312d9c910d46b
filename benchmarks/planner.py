"""The planner: how fast it is, how near to LinuxCNC's own demand, and what the correction makes of jerky demands.

Run as ``python -m benchmarks.planner``; without LinuxCNC (Debian's linuxcnc-uspace) its parts are left out.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterator
from itertools import product

import numpy as np

from benchmarks.inverse import measure_gains
from fdhil import config as configuration
from fdhil.program import Arc, Feed, Motion, interpret, plan
from fdhil.program.motions import Corner
from fdhil.program.planner import stream_trajectory
from fdhil.records import Float
from tests.bench import bench_config, bench_document
from tests.linuxcnc.linuxcnc_process import DemandRecorder
from tests.program.test_linuxcnc_demand import (
    ACCELERATION_MM_S2,
    EXACT_SHARE,
    build_program,
    measure_distance_mm,
    plan_demand,
)

BENCH = "G21 G90 G17 {mode}\nF{feed:g}\nG1 Y55\nX100\nG3 X200 I50\nG1 X250\nY0\nM2\n"
BESIDE = ("contour", "zigzag", "helix", "wave")
MODES = ("G61", "G64 P0.05", "G64")
PROFILES = {"fir": 100_000, "trapezoidal": 100_000, "jerk_limited": 100_000, "linuxcnc": 10_000}  # motions of each


def make_machine(profile: str, acceleration_mm_s2: float = ACCELERATION_MM_S2) -> configuration.MachineConfig:
    """The bench with another profile and acceleration of the NC."""
    document = bench_document()
    for axis in document["axis"].values():
        axis["max_acceleration_mm_s2"] = acceleration_mm_s2
    document["nc"] = {"profile": profile}
    return configuration.parse_config(document)


def make_chords(count: int) -> Iterator[Motion]:
    """A wavy line in chords of 0.2 mm and an arc now and then."""
    for number in range(1, count + 1):
        end = (0.2 * number, 5.0 * math.sin(0.02 * number), 0.0)
        if number % 50:
            yield Feed(number, end, 6000.0, Corner("blend", 0.01))
        else:
            before = (0.2 * (number - 1), 5.0 * math.sin(0.02 * (number - 1)))
            centre = ((before[0] + end[0]) / 2.0, (before[1] + end[1]) / 2.0, None)
            yield Arc(number, end, centre, 1, "XY", 6000.0, Corner("blend", 0.01))


def measure_speeds() -> None:
    """Motions and seconds of path per second."""
    for profile, moves in PROFILES.items():
        begun, rows = time.process_time(), 0
        for block in stream_trajectory(make_chords(moves), make_machine(profile), 1000):
            rows += block.time_s.size
        took = time.process_time() - begun
        print(f"{profile}: {moves / took:.0f} motions/s, {rows * 0.001 / took:.0f} x real time on one core")


def compare_with_linuxcnc(nc: DemandRecorder) -> None:
    """Difference of time, and the largest distance at the same millisecond, of two profiles beside LinuxCNC."""
    print("path, mode, feed: rows of LinuxCNC; difference of time, largest distance at the same millisecond")
    for path in BESIDE:
        for mode, feed in product(("G61", "G64 P0.05", "G64 P0.2 Q0.02"), (6000.0, 20000.0)):
            text = build_program(path, mode, feed)
            b = nc.record_demand(text)
            reported = []
            for profile in ("linuxcnc", "trapezoidal"):
                share = EXACT_SHARE if mode == "G61" and profile == "trapezoidal" else 1.0
                a = plan_demand(text, ACCELERATION_MM_S2 * share, profile)
                reported.append(f"{profile} {100 * (len(a) / len(b) - 1):+.2f} %, {measure_distance_mm(a, b):.3f} mm")
            print(f"{path}, {mode}, {feed / 1000:g} m/min: {len(b)}; {'; '.join(reported)}")


def make_jerky_demands(nc: DemandRecorder | None) -> Iterator[tuple[str, Float]]:
    """Demands of the bench path with steps of acceleration of 2 m/s2, by name."""
    for feed in (10_000.0, 20_000.0):
        for mode in MODES:
            text = BENCH.format(mode=mode, feed=feed)
            reference = plan(interpret(text.splitlines()), make_machine("trapezoidal"))
            name = f"{mode}, {feed / 1000:g} m/min"
            yield f"trapezoidal, {name}", np.column_stack(list(reference.position_mm.values()))
            if nc is not None:
                rows = nc.record_demand(text)[:, :2]
                yield f"LinuxCNC, {name}", np.concatenate([rows, np.repeat(rows[-1:], 500, axis=0)])


def print_gains(nc: DemandRecorder | None) -> None:
    """Gains of the inverse correction on jerky demands as the drives get them, rounded to increments."""
    print("least gain over uncorrected (wanted: 14) and over mirror (2) on 40 scattered plants; RMS on the nominal one")
    per_mm = next(iter(bench_config().axis.values())).scaling.increments_per_mm
    for name, rows in make_jerky_demands(nc):
        rounded = np.round(rows * per_mm) / per_mm
        found, (before, after) = measure_gains(rounded)
        least = found.min(axis=0)
        print(
            f"{name}: {least[0]:.0f}, over mirror {least[1]:.1f}, point worse by {found[:, 2].max():.2f} um; "
            f"{before:.1f} to {after:.2f} um"
        )


def main() -> None:
    """Print the figures."""
    measure_speeds()
    if shutil.which("linuxcnc") is None:
        print("LinuxCNC is not installed: apt-get install linuxcnc-uspace")
        print_gains(None)
        return
    with DemandRecorder(acceleration_mm_s2=ACCELERATION_MM_S2) as nc:
        compare_with_linuxcnc(nc)
        print_gains(nc)


if __name__ == "__main__":
    main()
