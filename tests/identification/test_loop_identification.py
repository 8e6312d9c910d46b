"""A drive's loops, identified from its rapids on plants and drives that share no code with the model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil.config import Axis, Identification
from fdhil.identification.drive_loops.loop_identification import (
    DIFFER,
    apply_loops,
    compare_with_configuration,
    identify_loops,
    is_better_than_configured,
)
from fdhil.identification.rapid_windows import find_windows
from fdhil.model import closed_loop
from fdhil.records import Float, LoopEstimate, Parameters, Reason, Recording, Verdict, Window, freeze_array
from studies import real_plant as real
from tests.bench import bench_document
from tests.model.reference_drive import ReferenceDrive
from tests.paths import build_bench_demand, compute_rms

PERIOD = 0.001
SETTINGS = Identification()
NOMINAL = Parameters.from_mapping(real.Mechanics().truth())
GAINS = ("position_gain_per_s", "speed_feedforward", "speed_kp", "speed_ki")


def build_bench_axis(**regulators: Any) -> Axis:
    """Return the bench's X axis with other regulators."""
    document = bench_document()
    document["axis"]["X"]["regulators"] |= regulators
    return configuration.parse_config(document).axis["X"]


def build_shuttle_demand(moves: int, way: float, speed: float, rest_s: float = 0.25, step_s: float = PERIOD) -> Float:
    """Return a back-and-forth demand as an NC smooths it, m."""
    ramp = speed / 4.0
    t = np.arange(0.0, way / speed + ramp, PERIOD)
    move = np.minimum(np.minimum(4.0 * t, speed), np.maximum(0.0, 4.0 * (way / speed + ramp - t)))
    still = np.zeros(round(rest_s / PERIOD))
    course = np.concatenate([still, *(part for k in range(moves) for part in (move * (-1) ** k, still))])
    for width in (60, 30):
        course = np.convolve(course, np.ones(width) / width)[: course.size]
    place = np.cumsum(course) * PERIOD
    return np.asarray(
        np.interp(np.arange(0.0, (place.size - 1) * PERIOD, step_s), np.arange(place.size) * PERIOD, place)
    )


def simulate_rapids(loops: real.Loops, mechanics: real.Mechanics | None = None) -> list[Window]:
    """Return rapids of an independent plant, as a drive reports them."""
    mechanics = mechanics or real.Mechanics()
    run = real.simulate_axis(mechanics, build_shuttle_demand(4, 0.25, 0.5), loops)
    return find_windows(real.make_recording(run, mechanics, real.Sensors(), 0.5))


class RecordingDrive(ReferenceDrive):
    """The independent drive, with voltage, current and speed recorded at every step of its current loop."""

    noted: list[tuple[float, float, float]]

    def _integrate_step(self, u: float, h: float) -> None:
        self.noted.append((u, self.i, self.w))
        super()._integrate_step(u, h)


def record_drive_rapids(axis: Axis, demand_m: Float, row_s: float = PERIOD) -> list[Window]:
    drive = RecordingDrive(NOMINAL, axis, row_s, increments=2**24)
    drive.noted = []
    place = np.array(drive.follow_demand((demand_m * 1e3).tolist()))
    noted = np.array(drive.noted).reshape(place.size, -1, 3)
    rng = np.random.default_rng(1)
    recording = Recording(
        axis="X",
        dt_s=row_s,
        time_s=freeze_array(np.arange(place.size) * row_s),
        voltage_v=freeze_array(noted[:, :, 0].mean(axis=1)),
        current_a=freeze_array(noted[:, 0, 1] + 0.15 * rng.standard_normal(place.size)),
        speed_rad_s=freeze_array(noted[:, 0, 2]),
        position_mm=freeze_array(place),
        demand_mm=freeze_array(demand_m * 1e3),
        voltage_sampling="interval_mean",
        pitch_mm=20.0,
        rapid_speed_rad_s=float(np.abs(np.diff(demand_m)).max() / row_s / 0.02 * 2 * np.pi),
    )
    return find_windows(recording)


def identify_loops_of(windows: list[Window], axis: Axis | None, mechanics: Parameters = NOMINAL) -> LoopEstimate:
    loops = identify_loops(windows, [mechanics] * len(windows), axis, SETTINGS)
    assert loops is not None
    return loops


def map_gains(loops: LoopEstimate) -> dict[str, float]:
    return dict(zip(loops.names, loops.values.tolist(), strict=True))


def test_configured_loops_are_confirmed() -> None:
    axis = build_bench_axis()
    loops = identify_loops_of(simulate_rapids(real.Loops()), axis)
    assert (loops.structure, loops.names) == ("p_pi_pi", GAINS)
    for reported in compare_with_configuration(axis, loops):
        assert reported.found == pytest.approx(reported.configured, rel=0.01)
    assert loops.verdict.accepted
    assert loops.configured_um == pytest.approx(loops.verdict.unexplained_um, abs=0.1)
    assert not is_better_than_configured(loops)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("loops", "configured"),
    [
        pytest.param(real.Loops(speed_filter_s=0.001), True, id="filter"),
        pytest.param(real.Loops(speed_filter_s=0.002, speed_feedforward=0.8), True, id="filter and lag"),
        pytest.param(real.Loops(speed_filter_s=0.001), False, id="filter, from the demand alone"),
        pytest.param(real.Loops(speed_kp=0.9 * 23.562, speed_ki=0.81 * 1184.35), False, id="slower, from the demand"),
    ],
)
def test_unconfigured_loops_are_identified_within_five_percent(loops: real.Loops, configured: bool) -> None:
    reported = identify_loops_of(simulate_rapids(loops), build_bench_axis() if configured else None)
    assert reported.structure == "p_pi_pi"
    assert ("speed_filter_s" in reported.names) == (loops.speed_filter_s > 0)
    for name, value in map_gains(reported).items():
        assert value == pytest.approx(getattr(loops, name), rel=0.05), name
    assert reported.verdict.accepted
    assert reported.verdict.unexplained_um is not None
    assert reported.verdict.unexplained_um < 0.4  # the recording is rounded to 1 um
    assert is_better_than_configured(reported) == configured


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    "own",
    [
        {"setpoint_filter_s": 0.002},
        {"torque_feedforward": 0.6},
        {"setpoint_filter_s": 0.002, "speed_filter_s": 0.001, "speed_feedforward": 0.9},
        {
            "structure": "pid", "position_gain_per_s": 100.0, "position_ki_per_s2": 2500.0, "speed_ki": 0.0,
            "speed_feedforward": 0.8,
        },
        {"structure": "double_pi", "position_ki_per_s2": 300.0, "speed_feedforward": 0.8},
    ],
    ids=lambda own: "-".join(own),
)  # fmt: skip
def test_options_and_structures_are_distinguished(own: dict[str, Any]) -> None:
    axis = build_bench_axis(**own)
    windows = record_drive_rapids(axis, build_shuttle_demand(1, 0.12, 0.3, rest_s=0.5))
    loops = identify_loops_of(windows, build_bench_axis())
    assert loops.structure == axis.regulators.structure
    assert {name for name in own if name != "structure"} <= {*loops.names, "speed_ki"}
    for name, value in map_gains(loops).items():
        assert value == pytest.approx(getattr(axis.regulators, name), rel=0.06, abs=3e-4), name
    used = apply_loops(build_bench_axis(), loops).regulators
    assert used.structure == axis.regulators.structure
    assert used.speed_ki == pytest.approx(axis.regulators.speed_ki, rel=0.06)


@pytest.mark.usefixtures("long_computation")
def test_path_is_predicted_despite_unmodelled_effects() -> None:
    mechanics = replace(real.ORDINARY_MECHANICS, load_nm=0.0)
    loops = replace(real.ORDINARY_LOOPS, speed_filter_s=0.001, speed_feedforward=0.95)
    own = apply_loops(build_bench_axis(), identify_loops_of(simulate_rapids(loops, mechanics), build_bench_axis()))
    demand = build_bench_demand(10)[:, 0]
    truth = real.simulate_axis(mechanics, demand / 1e3, loops).motor_m * 1e3
    off = [
        compute_rms(closed_loop.simulate_axis(NOMINAL, a, PERIOD, demand).position_mm - truth)
        for a in (build_bench_axis(), own)
    ]
    assert off[0] > 0.1
    assert off[1] < 1e-3


@pytest.mark.usefixtures("long_computation")
def test_loops_that_do_not_explain_the_rapids_are_refused() -> None:
    windows = simulate_rapids(real.Loops())
    strict = SETTINGS.model_copy(update={"tolerance_um": 0.01})
    loops = identify_loops(windows, [NOMINAL] * len(windows), build_bench_axis(), strict)
    assert loops is not None
    assert [reason.code for reason in loops.verdict.reasons] == ["LoopsUnexplained"]
    assert not is_better_than_configured(loops)


def test_recording_without_demand_yields_no_loops() -> None:
    windows = [replace(window, demand_mm=window.position_mm) for window in simulate_rapids(real.Loops())]
    assert identify_loops(windows, [NOMINAL] * len(windows), build_bench_axis(), SETTINGS) is None


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("row_s", [0.004, 0.010])
def test_loops_are_identified_from_long_samples(row_s: float) -> None:
    axis = build_bench_axis()
    (window,) = record_drive_rapids(axis, build_shuttle_demand(1, 0.25, 0.5, step_s=row_s), row_s)
    for name, value in map_gains(identify_loops_of([window], None)).items():
        assert value == pytest.approx(getattr(axis.regulators, name), rel=0.02), name


@pytest.mark.parametrize(("gain", "used"), [(50.0, True), (0.0078, False)])
def test_loops_with_invalid_values_are_not_used(gain: float, used: bool) -> None:
    verdict = Verdict(True, None, (), 1.0, (Reason(DIFFER, "they differ"),))
    values, covariance = np.array([gain]), np.eye(1)
    assert (
        is_better_than_configured(LoopEstimate("X", "p_pi_pi", ("position_gain_per_s",), values, covariance, verdict))
        is used
    )
