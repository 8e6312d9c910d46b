"""Predictions of the paper's path in every scenario, without and with a correction of unlimited offsets.

The guard's limits do not apply to a simulation, so that the figures correspond to those of the paper.
"""

from collections.abc import Mapping
from functools import cache
from importlib.resources import as_file, files

import numpy as np

from fdhil.cli.demo.demo_page import POINTS
from fdhil.cli.paper import simulated_drive
from fdhil.cli.paper.claim_drawings import TracedPath
from fdhil.cli.paper.scenarios import PATHS, load_machine
from fdhil.config import MachineConfig
from fdhil.correction import compute_feedforward_offsets, invert_loop
from fdhil.prediction import build_nominal_models, compute_contour_error_um, predict_corrected_path
from fdhil.program import load_trajectory
from fdhil.records import Bool, Float, Parameters, Prediction, Trajectory, compute_rms

PROGRAMS: Mapping[str, str] = {
    "10 m/min": "bench_10m.ngc",
    "20 m/min": "bench_20m.ngc",
    "rounded": "bench_rounded_10m.ngc",
}
PLACES = POINTS
CORNERS, SMOOTH = ("A", "C", "E", "G"), ("B", "D", "F")
NEAR_MM = 10.0  # radius around a named place
AXES = ("X", "Y")
SLOW, FAST = "10 m/min", "20 m/min"
METHODS = ("mirror", "inverse", "flatness")


@cache
def _plan_trajectory(program: str, smoothing_s: tuple[float, ...]) -> Trajectory:
    sharp = load_machine("sharp-full")
    config = sharp.model_copy(update={"nc": sharp.nc.model_copy(update={"smoothing_s": smoothing_s})})
    with as_file(files("fdhil.cli.demo").joinpath(PROGRAMS[program])) as path:
        return load_trajectory(path, config)


def load_reference(scenario: str, program: str = SLOW) -> Trajectory:
    """Return the demand that the NC of a scenario generates from a program."""
    return _plan_trajectory(program, tuple(load_machine(scenario).nc.smoothing_s))


@cache
def compute_desired_mm(scenario: str, program: str = SLOW) -> Float:
    """Return the reference path (n, 2) of the errors, mm: the demand, or the programmed path padded to its length."""
    demand = load_reference(scenario, program).path_mm
    if not PATHS[scenario].programmed:
        return demand
    path = _plan_trajectory(program, ()).path_mm
    return np.vstack([path, np.repeat(path[-1:], max(0, len(demand) - len(path)), axis=0)])[: len(demand)]


def _change_models(changes: tuple[tuple[str, float], ...], config: MachineConfig) -> dict[str, Parameters]:
    models = build_nominal_models(config)
    return models | {"X": models["X"].replace_values(**dict(changes))}


@cache
def predict_path(scenario: str, program: str = SLOW, changes: tuple[tuple[str, float], ...] = ()) -> Prediction:
    """Predict a program without correction; ``changes`` replace nominal parameters of X."""
    config = load_machine(scenario)
    # no offsets; unlike predict() this skips the zones, which are not needed
    return predict_corrected_path(load_reference(scenario, program), _change_models(changes, config), config, None)


@cache
def predict_paper_correction(scenario: str, method: str, program: str = SLOW) -> Prediction:
    """Predict a program with an unlimited correction by one of ``METHODS``."""
    before, config = predict_path(scenario, program), load_machine(scenario)
    models = build_nominal_models(config)
    if method == "flatness":
        offsets = {
            axis: compute_feedforward_offsets(np.asarray(path), models[axis], config.axis[axis], before.reference.dt_s)
            for axis, path in before.reference.position_mm.items()
        }
        speed, torque = ({axis: pair[k] for axis, pair in offsets.items()} for k in (0, 1))
        return predict_corrected_path(before.reference, models, config, None, speed, torque)
    return predict_corrected_path(before.reference, models, config, compute_offset_um(scenario, method, program))


def compute_offset_um(scenario: str, method: str, program: str = SLOW) -> dict[str, Float]:
    """Return the offsets (n,) of each axis, um: -e for the mirror, else -Hr^-1 e of equation [11]."""
    before, config = predict_path(scenario, program), load_machine(scenario)
    if method == "mirror":
        return {axis: -error for axis, error in before.error_um.items()}
    models = build_nominal_models(config)
    return {
        axis: -invert_loop(models[axis], config.axis[axis], before.reference.dt_s, error.size).compute_offset(error)
        for axis, error in before.error_um.items()
    }


@cache
def simulate_table_mm(scenario: str, program: str = SLOW) -> Float:
    """Return the table path (n, 2), mm, of the simulator's physics, independent of the model."""
    config, demand = load_machine(scenario), load_reference(scenario, program).position_mm
    models, period_s = build_nominal_models(config), config.machine.sync_period_s
    tables = [
        simulated_drive.simulate_drive(config.axis[axis], period_s, models[axis], np.asarray(demand[axis])).table_mm
        for axis in AXES
    ]
    return np.column_stack(tables)


def extract_path_mm(answer: Prediction) -> Float:
    """Return the predicted table path (n, 2), mm."""
    return np.column_stack([answer.predicted_mm[axis] for axis in AXES])


def compute_contour_um(scenario: str, answer: Prediction, program: str = SLOW) -> Float:
    """Return the contour error (n,), um, relative to the scenario's reference path."""
    if not PATHS[scenario].programmed:
        return answer.contour_um
    return compute_contour_error_um(
        compute_desired_mm(scenario, program), extract_path_mm(answer), answer.reference.dt_s
    )


def trace_prediction(label: str, scenario: str, answer: Prediction, program: str = SLOW) -> TracedPath:
    """Return a predicted path with its contour error, for a drawing."""
    return TracedPath(label, extract_path_mm(answer), compute_contour_um(scenario, answer, program))


def find_rows_near(answer: Prediction, place: str, within_mm: float = NEAR_MM) -> Bool:
    """Return the samples (n,) in which the table, not the demand, is near a place."""
    away = np.hypot(*(extract_path_mm(answer) - PLACES[place]).T)
    return np.asarray(away < within_mm)


def find_largest_um(scenario: str, answer: Prediction, place: str, program: str = SLOW) -> float:
    """Return the largest contour error near a place, um."""
    return float(compute_contour_um(scenario, answer, program)[find_rows_near(answer, place)].max())


def compute_rms_um(scenario: str, answer: Prediction, program: str = SLOW) -> float:
    """Return the RMS contour error of the whole path, um."""
    return compute_rms(compute_contour_um(scenario, answer, program))


def measure_corner_distance_mm(scenario: str, place: str = "A", program: str = SLOW) -> float:
    """Return the smallest distance of the demand from a programmed corner, mm."""
    return float(np.hypot(*(load_reference(scenario, program).path_mm - PLACES[place]).T).min())
