"""The first rows are recomputed from the holding currents at standstill."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil import correction
from fdhil.arming.checked_program import TablePiece
from fdhil.arming.first_block import FirstBlock
from fdhil.arming.program_check import encode_rows
from fdhil.arming.standstill_monitor import WATCHED_S, StandstillMonitor, StandstillState
from fdhil.config import MachineConfig
from fdhil.correction import PlanLimits, check_offsets
from fdhil.prediction import compute_contour_error_um
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import load_trajectory
from fdhil.records import AxisSamples, Float, Parameters, freeze_array, freeze_integers
from studies import real_plant
from studies.real_plant import Mechanics
from tests.bench import bench_config
from tests.model.reference_drive import ReferenceDrive
from tests.paths import compute_rms

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
CUT_ROWS = 1000
LONG = "G21 G90 G94\nG1 Y55 F10000\nG1 X100\nG1 Y5\nG1 X0\nG4 P0.2\nM2\n"
SHORT = "G21 G90 G94\nG1 X20 F4000\nG1 Y20\nG4 P0.2\nM2\n"


def make_checked(
    folder: Path, text: str, models: dict[str, Parameters], config: MachineConfig
) -> tuple[Path, TablePiece]:
    program = folder / "part.ngc"
    program.write_text(text)
    reference = load_trajectory(program, config)
    planned = correction.plan_correction(reference, models, config, "inverse")
    assert not planned.refused
    rows = np.frombuffer(encode_rows(reference.position_mm, planned.offset_um, config), "<i4").reshape(-1, 4).T.tolist()
    return program, TablePiece(0, dict(zip("XY", rows[:2], strict=True)), dict(zip("XY", rows[2:], strict=True)), True)


def make_standstill(amperes: dict[str, float]) -> dict[str, StandstillState]:
    return {axis: StandstillState(0.0, 0.0, current) for axis, current in amperes.items()}


def simulate_cut(program: Path, piece: TablePiece, amperes: dict[str, float], config: MachineConfig) -> Float:
    """Return the contour error (n,) of independent drives that begin with a current, on the first rows."""
    reference = load_trajectory(program, config)
    positions = []
    for axis, whole in reference.position_mm.items():
        path = whole[:CUT_ROWS]
        drive = ReferenceDrive(MODELS[axis], config.axis[axis], 0.001)
        drive.i = drive.speed_sum = amperes[axis]
        drive.current_sum = MODELS[axis].R * amperes[axis]
        offset_mm = np.array(piece.offset[axis][:CUT_ROWS]) / config.axis[axis].scaling.increments_per_mm
        positions.append(drive.follow_demand((path + config.axis[axis].drive.sign * offset_mm).tolist()))
    return compute_contour_error_um(reference.path_mm, np.column_stack(positions), 0.001, 0)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("text", [LONG, SHORT])
def test_error_before_first_corner_is_removed(text: str, tmp_path: Path) -> None:
    amperes = {"X": 4.0, "Y": -3.0}
    program, begin = make_checked(tmp_path, text, MODELS, CONFIG)
    first = FirstBlock(begin, program, MODELS, CONFIG)
    rows = first.recompute(make_standstill(amperes))
    assert rows is not None
    assert first.begin is begin
    first.apply_rows(rows)
    recomputed = first.begin
    before, after = (simulate_cut(program, piece, amperes, CONFIG) for piece in (begin, recomputed))
    without = simulate_cut(program, begin, {"X": 0.0, "Y": 0.0}, CONFIG)
    assert compute_rms(after[:600]) < 0.2 * compute_rms(before[:600])
    assert compute_rms(after) < 1.1 * compute_rms(without)
    assert recomputed.demand == begin.demand
    assert all(rows.offset[axis] == recomputed.offset[axis][: len(rows.offset[axis])] for axis in "XY")
    assert all(rows.demand[axis] == recomputed.demand[axis][: len(rows.offset[axis])] for axis in "XY")
    for axis in "XY":
        assert len(recomputed.offset[axis]) == len(begin.offset[axis])
        assert recomputed.offset[axis][1700:] == begin.offset[axis][1700:] or text == SHORT
        limits = PlanLimits.derive(CONFIG.axis[axis], 0.001)
        assert check_offsets(np.array(recomputed.offset[axis]), limits) == []


def test_correct_rows_are_kept(tmp_path: Path) -> None:
    program, begin = make_checked(tmp_path, SHORT, MODELS, CONFIG)
    first = FirstBlock(begin, program, MODELS, CONFIG)
    assert first.recompute(make_standstill({"X": 0.1, "Y": -0.1})) is None
    rows = first.recompute(make_standstill({"X": 0.0, "Y": 4.0}))
    assert rows is not None
    first.apply_rows(rows)
    assert first.recompute(make_standstill({"X": 0.0, "Y": 4.1})) is None
    assert first.recompute(make_standstill({"X": 0.0, "Y": 0.0})) is not None  # it has moved since


@pytest.mark.usefixtures("long_computation")
def test_current_after_move_to_start_is_predicted(tmp_path: Path) -> None:
    program, begin = make_checked(tmp_path, LONG, MODELS, CONFIG)
    first = FirstBlock(begin, program, MODELS, CONFIG)
    rows = first.predict_rows({"X": StandstillState(250.0, 250.0, 3.0), "Y": StandstillState(0.0, 0.0, 5.0)})
    assert rows is not None
    first.apply_rows(rows)
    amperes = {"X": -6.0, "Y": 5.0}
    before, after = (simulate_cut(program, piece, amperes, CONFIG) for piece in (begin, first.begin))
    assert compute_rms(after[:600]) < 0.3 * compute_rms(before[:600])
    assert first.recompute(make_standstill(amperes)) is None  # as it was expected


def test_load_shifts_holding_current(tmp_path: Path) -> None:
    """The plant is independent of the model: each axis stands at an edge of a friction band shifted by its load."""
    plant = replace(Mechanics(), load_nm=4.0, static=0.2)
    model = Parameters.from_mapping({**plant.truth(), "load": 4.0, "stribeck": 1.0, "stribeck_speed": 10.0})
    models = {"X": model, "Y": model}
    program, begin = make_checked(tmp_path, LONG, models, CONFIG)
    first = FirstBlock(begin, program, models, CONFIG)
    amperes = {"X": (4.0 - 5.8) / 0.8, "Y": (4.0 + 5.8) / 0.8}
    rows = first.predict_rows({"X": StandstillState(9.0, 9.0, 0.0), "Y": StandstillState(-9.0, -9.0, 0.0)})
    assert rows is not None
    first.apply_rows(rows)
    reference = load_trajectory(program, CONFIG)
    error = []
    for piece in (begin, first.begin):
        positions = []
        for axis, path in reference.position_mm.items():
            ordered = path + np.array(piece.offset[axis]) / CONFIG.axis[axis].scaling.increments_per_mm
            start = np.array([amperes[axis], 0.0, 0.0, 0.0, 0.0, amperes[axis], plant.R * amperes[axis]])
            positions.append(real_plant.simulate_axis(plant, ordered * 1e-3, start=start).table_m * 1e3)
        error.append(compute_contour_error_um(reference.path_mm, np.column_stack(positions), 0.001))
    assert compute_rms(error[1]) < 0.2 * compute_rms(error[0])
    assert compute_rms(error[1]) < 0.3


@pytest.mark.parametrize(
    "rest", [{}, {"X": StandstillState(0, 0, 3)}, {"X": StandstillState(0, 0, 3), "Y": StandstillState(5, 5, 3)}]
)
def test_rows_are_kept_for_axis_away_from_start(rest: dict[str, StandstillState], tmp_path: Path) -> None:
    program, begin = make_checked(tmp_path, SHORT, MODELS, CONFIG)
    first = FirstBlock(begin, program, MODELS, CONFIG)
    assert first.recompute(rest) is None
    assert first.begin is begin


def make_samples(first: int, current: Float, position: float = 1.0) -> AxisSamples:
    n = current.size
    still = freeze_array(np.full(n, position))
    zero, ticks = freeze_array(np.zeros(n)), freeze_integers(np.arange(first, first + n))
    return AxisSamples("X", ticks, still, still, zero, freeze_array(current), None, zero, freeze_integers(np.zeros(n)))


def test_holding_current_is_of_the_last_samples() -> None:
    standstill = StandstillMonitor(CONFIG)
    rows = round(WATCHED_S / 0.001)
    standstill.take_samples(make_samples(0, np.full(rows // 2, 1.0)))
    assert standstill.find_standing_axes() == {}
    standstill.take_samples(make_samples(rows // 2, np.full(rows, 2.0)))
    assert standstill.find_standing_axes()["X"] == pytest.approx(StandstillState(1.0, 1.0, 2.0))


def test_moving_or_unsampled_axis_is_not_at_standstill() -> None:
    rows = round(WATCHED_S / 0.001)
    good = make_samples(0, np.full(2 * rows, 2.0))
    moved = replace(good, position_mm=freeze_array(np.linspace(0, 1, 2 * rows)))
    holed = replace(good, tick=freeze_integers(np.where(good.tick > rows, good.tick + 1, good.tick)))
    offset = replace(good, offset_mm=freeze_array(np.full(2 * rows, 0.001)))
    for samples in (moved, holed, offset):
        standstill = StandstillMonitor(CONFIG)
        standstill.take_samples(samples)
        assert standstill.find_standing_axes() == {}
    standstill = StandstillMonitor(CONFIG)
    standstill.take_samples(good)
    standstill.take_samples(make_samples(0, np.full(10, 2.0)))
    assert standstill.find_standing_axes() == {}
