"""The cause of the largest error at each place of many paths: any NC, feed, tolerance and radius."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import MachineConfig
from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import Budget, interpret
from fdhil.program import plan as plan_program
from fdhil.records import Trajectory, Zone
from tests.bench import bench_config
from tests.paths import build_bench_trajectory, build_rounded_demand, build_trajectory

CONFIG = bench_config()
LINUXCNC = CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"profile": "linuxcnc"})})
BENCH = "G21 G90 {mode}\nG1 X0 Y55 F{feed}\nG1 X100\nG3 X200 I50 J0\nG1 X250\nG1 Y0\nM2\n"
CORNERS = ((0, 55), (100, 55), (200, 55), (250, 55))
NC = {"fir": CONFIG, "linuxcnc": LINUXCNC}


def plan_test_program(text: str, config: MachineConfig) -> Trajectory:
    return plan_program(list(interpret(text.splitlines(), Budget.create_from_config(config.nc))), config)


def find_program_zones(reference: Trajectory, config: MachineConfig = CONFIG) -> tuple[Zone, ...]:
    return predict_path(reference, build_nominal_models(config), config).zones


def find_nearest_zone(zone: Zone, places: tuple[tuple[float, float], ...]) -> float:
    at = np.array([float(word) for word in zone.where.split()[1::2]])[:2]
    return min(float(np.linalg.norm(at - place)) for place in places)


def sum_duration_s(zones: tuple[Zone, ...], cause: str) -> float:
    return sum(zone.end_s - zone.start_s for zone in zones if zone.cause == cause)


@pytest.mark.parametrize(
    ("feed", "mode", "widest_mm"),
    [
        *((feed, mode, 6.0) for feed in (10, 20) for mode in ("fir", "G61", "G64 P0.01", "G64 P0.1", "G64 P1")),
        (10, "G64", 12.0),
        (10, "G64 P5", 12.0),
        (20, "G64", 25.0),
        (20, "G64 P5", 18.0),
    ],
)
def test_bench_path_has_four_corners_at_any_blending(feed: int, mode: str, widest_mm: float) -> None:
    """Blends of 2 to 200 ms: large errors are corners, each near its position; the half circle is not."""
    if mode == "fir":
        zones = find_program_zones(build_bench_trajectory(feed))
    else:
        zones = find_program_zones(plan_test_program(BENCH.format(mode=mode, feed=1000 * feed), LINUXCNC), LINUXCNC)
    large = [zone for zone in zones if zone.max_um > 46.0 and zone.cause != "stop"]
    assert {zone.cause for zone in large} == {"corner"}
    for zone in large:
        assert find_nearest_zone(zone, CORNERS) < widest_mm
    for corner in CORNERS:
        assert any(find_nearest_zone(zone, (corner,)) < widest_mm for zone in large)
    bottom = [zone for zone in zones if find_nearest_zone(zone, ((150, 5),)) < 10.0]
    assert {zone.cause for zone in bottom} <= {"reversal", "circular lag"}


def test_reversal_stick_is_cause_until_lag_dominates() -> None:
    """At 10 m/min dry friction leaves 10 um there and the lag 5; at 20 the lag leaves 13."""
    for feed, cause in ((10, "reversal"), (20, "circular lag")):
        bottom = [
            zone
            for zone in find_program_zones(build_bench_trajectory(feed))
            if find_nearest_zone(zone, ((150, 5),)) < 2.0
        ]
        assert {zone.cause for zone in bottom} == {cause}


@pytest.mark.parametrize("feed", [10, 20])
def test_rounded_path_has_errors_at_arc_ends(feed: int) -> None:
    zones = find_program_zones(build_trajectory(build_rounded_demand(feed)))
    assert {zone.cause for zone in sorted(zones, key=lambda z: -z.max_um)[:2]} == {"corner"}
    lag = [zone for zone in zones if zone.cause == "circular lag"]
    assert all(zone.max_um < 0.3 * max(z.max_um for z in zones) for zone in lag)


@pytest.mark.parametrize("nc", NC)
@pytest.mark.parametrize(
    ("radius_mm", "feed_mm_min", "cause"),
    [
        (50, 3000, "reversal"),
        (20, 3000, "reversal"),
        (10, 3000, "reversal"),
        (5, 3000, "reversal"),
        (2, 3000, "circular lag"),
        (1, 3000, "circular lag"),
        (50, 10000, "reversal"),
        (20, 10000, "circular lag"),
    ],
)
def test_circle_zone_causes(nc: str, radius_mm: float, feed_mm_min: float, cause: str) -> None:
    config = NC[nc]
    program = f"G21 G90 G64\nG3 X0 Y0 I{radius_mm} P4 F{feed_mm_min}\nM2\n"
    reference = plan_test_program(program, config)
    zones = find_program_zones(reference, config)
    assert "corner" not in {zone.cause for zone in zones}
    # once the loops have settled from the start, and before the stop
    inside = [zone for zone in zones if zone.end_s > 0.35 and zone.start_s < reference.time_s[-1] - 1.0]
    assert max(inside, key=lambda zone: zone.max_um if zone.cause not in ("start", "stop") else 0.0).cause == cause
    quadrants = ((0, 0), (radius_mm, radius_mm), (2 * radius_mm, 0), (radius_mm, -radius_mm))
    for zone in zones:
        assert zone.cause != "reversal" or find_nearest_zone(zone, quadrants) < 1.0


def test_infeasible_circle_is_saturation() -> None:
    """20 m/min on 10 mm."""
    zones = find_program_zones(plan_test_program("G21 G90 G64\nG3 X0 Y0 I10 P3 F20000\nM2\n", CONFIG))
    assert {zone.cause for zone in zones} == {"saturation"}


@pytest.mark.parametrize("nc", NC)
def test_circle_of_chords_is_classified_as_circle(nc: str) -> None:
    """Each chord turns by 5 degrees within 18 ms, below the loops' time."""
    angle = np.linspace(0.0, 4 * np.pi, 145)[1:]
    chords = [f"G1 X{20 - 20 * np.cos(a):.4f} Y{20 * np.sin(a):.4f} F6000" for a in angle]
    zones = find_program_zones(plan_test_program("\n".join(["G21 G90 G64 P0.01", *chords, "M2"]), NC[nc]), NC[nc])
    inside = [zone for zone in zones if zone.start_s > 0.25 and zone.cause != "stop"]
    assert {zone.cause for zone in inside} == {"circular lag", "reversal"}


@pytest.mark.parametrize("nc", NC)
@pytest.mark.parametrize("radius_mm", [5, 20])
def test_helix_is_classified_as_circle(nc: str, radius_mm: float) -> None:
    space = bench_config("XYZ")
    config = space.model_copy(update={"nc": NC[nc].nc})
    zones = find_program_zones(
        plan_test_program(f"G21 G90 G64\nG3 X0 Y0 I{radius_mm} Z20 P3 F8000\nM2\n", config), config
    )
    assert {zone.cause for zone in zones} <= {"start", "circular lag", "reversal", "stop"}
    assert sum_duration_s(zones, "circular lag") > 0.5


@pytest.mark.parametrize(
    ("gain", "cause", "never"), [(20.0, "corner", "circular lag"), (100.0, "circular lag", "corner")]
)
def test_corner_detection_scales_with_loop_time(gain: float, cause: str, never: str) -> None:
    """The same arc of 90 degrees: slow loops have not settled at its end, fast ones always have."""
    axes = {
        name: axis.model_copy(update={"regulators": axis.regulators.model_copy(update={"position_gain_per_s": gain})})
        for name, axis in CONFIG.axis.items()
    }
    config = CONFIG.model_copy(update={"axis": axes})
    models = {axis: replace(model, Cd=0.0) for axis, model in build_nominal_models(config).items()}
    reference = plan_test_program("G21 G90 G64\nG1 X100 F6000\nG3 X120 Y20 J20\nG1 Y150\nM2\n", config)
    zones = predict_path(reference, models, config, zones_above_um=0.5).zones
    assert sum_duration_s(zones, cause) > 0.2
    assert sum_duration_s(zones, never) == 0.0
