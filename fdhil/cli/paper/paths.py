"""Cuts the paper's path in every scenario: predicted, and with what a correction adds, without any ceiling.

In a simulation no drive can be harmed, so the offsets are not limited here as the guard limits them on a machine: the
figures are drawn as the paper drew them.
"""

from collections.abc import Mapping
from functools import cache
from importlib.resources import as_file, files

import numpy as np

from fdhil.cli.demo.report import POINTS
from fdhil.cli.paper import bench
from fdhil.cli.paper.drawings import Traced
from fdhil.cli.paper.scenarios import PATHS, machine
from fdhil.config import MachineConfig
from fdhil.correction import flatness_feedforward, linear
from fdhil.prediction import contour_error_um
from fdhil.prediction.models import nominal_models
from fdhil.prediction.predict import predict_corrected
from fdhil.program import load_trajectory
from fdhil.records import Bool, Float, Parameters, Prediction, Trajectory, rms

PROGRAMS: Mapping[str, str] = {
    "10 m/min": "bench_10m.ngc",
    "20 m/min": "bench_20m.ngc",
    "rounded": "bench_rounded_10m.ngc",
}
PLACES = POINTS
CORNERS, SMOOTH = ("A", "C", "E", "G"), ("B", "D", "F")
NEAR_MM = 10.0  # what belongs to a place, either way
AXES = ("X", "Y")
SLOW, FAST = "10 m/min", "20 m/min"
METHODS = ("mirror", "inverse", "flatness")


@cache
def _planned(program: str, smoothing_s: tuple[float, ...]) -> Trajectory:
    sharp = machine("sharp-full")
    config = sharp.model_copy(update={"nc": sharp.nc.model_copy(update={"smoothing_s": smoothing_s})})
    with as_file(files("fdhil.cli.demo").joinpath(PROGRAMS[program])) as path:
        return load_trajectory(path, config)


def reference(scenario: str, program: str = SLOW) -> Trajectory:
    """Return the demand that the scenario's NC makes of a program."""
    return _planned(program, tuple(machine(scenario).nc.smoothing_s))


@cache
def desired_mm(scenario: str, program: str = SLOW) -> Float:
    """Return the path (n, 2) against which errors are told: the demand, or the programmed path on as many rows."""
    demand = reference(scenario, program).path_mm
    if not PATHS[scenario].programmed:
        return demand
    path = _planned(program, ()).path_mm
    return np.vstack([path, np.repeat(path[-1:], max(0, len(demand) - len(path)), axis=0)])[: len(demand)]


def _models(changes: tuple[tuple[str, float], ...], config: MachineConfig) -> dict[str, Parameters]:
    models = nominal_models(config)
    return models | {"X": models["X"].changed(**dict(changes))}


@cache
def predicted(scenario: str, program: str = SLOW, changes: tuple[tuple[str, float], ...] = ()) -> Prediction:
    """Predict a program without correction; ``changes`` are parameters of X that are not the nominal ones."""
    config = machine(scenario)
    # nothing is added: what is predicted of the corrected path, without the zones that are not asked for here
    return predict_corrected(reference(scenario, program), _models(changes, config), config, None)


@cache
def corrected(scenario: str, method: str, program: str = SLOW) -> Prediction:
    """Predict a program with a correction by one of ``METHODS``, unlimited."""
    before, config = predicted(scenario, program), machine(scenario)
    models = nominal_models(config)
    if method == "flatness":
        offsets = {
            axis: flatness_feedforward.offsets(np.asarray(path), models[axis], config.axis[axis], before.reference.dt_s)
            for axis, path in before.reference.position_mm.items()
        }
        speed, torque = ({axis: pair[k] for axis, pair in offsets.items()} for k in (0, 1))
        return predict_corrected(before.reference, models, config, None, speed, torque)
    return predict_corrected(before.reference, models, config, offset_um(scenario, method, program))


def offset_um(scenario: str, method: str, program: str = SLOW) -> dict[str, Float]:
    """Return the offsets (n,) of each axis: the mirror's -e, or the -Hr^-1 e of equation [11]."""
    before, config = predicted(scenario, program), machine(scenario)
    if method == "mirror":
        return {axis: -error for axis, error in before.error_um.items()}
    models = nominal_models(config)
    return {
        axis: -linear.inverse(models[axis], config.axis[axis], before.reference.dt_s, error.size).apply(error)
        for axis, error in before.error_um.items()
    }


@cache
def measured_mm(scenario: str, program: str = SLOW) -> Float:
    """Return where the table of the simulated machine goes (n, 2), mm: the twin's physics, not the model's."""
    config, demand = machine(scenario), reference(scenario, program).position_mm
    models, period_s = nominal_models(config), config.machine.sync_period_s
    tables = [bench.run(config.axis[axis], period_s, models[axis], np.asarray(demand[axis])).table_mm for axis in AXES]
    return np.column_stack(tables)


def path_mm(answer: Prediction) -> Float:
    """Return the path (n, 2) that a prediction has the table take."""
    return np.column_stack([answer.predicted_mm[axis] for axis in AXES])


def contour_um(scenario: str, answer: Prediction, program: str = SLOW) -> Float:
    """Return the contour error (n,) against what the scenario tells errors against."""
    if not PATHS[scenario].programmed:
        return answer.contour_um
    return contour_error_um(desired_mm(scenario, program), path_mm(answer), answer.reference.dt_s)


def traced(label: str, scenario: str, answer: Prediction, program: str = SLOW) -> Traced:
    """Return a predicted path with its contour error, to be drawn."""
    return Traced(label, path_mm(answer), contour_um(scenario, answer, program))


def near(answer: Prediction, place: str, within_mm: float = NEAR_MM) -> Bool:
    """Return the rows (n,) in which the table is near to a place; where it should be then may be far on."""
    away = np.hypot(*(path_mm(answer) - PLACES[place]).T)
    return np.asarray(away < within_mm)


def largest_um(scenario: str, answer: Prediction, place: str, program: str = SLOW) -> float:
    """Return the largest contour error near a place."""
    return float(contour_um(scenario, answer, program)[near(answer, place)].max())


def rms_um(scenario: str, answer: Prediction, program: str = SLOW) -> float:
    """Return the RMS of the contour error along the whole path."""
    return rms(contour_um(scenario, answer, program))


def corner_missed_mm(scenario: str, place: str = "A", program: str = SLOW) -> float:
    """Return how near the demand itself comes to a programmed corner."""
    return float(np.hypot(*(reference(scenario, program).path_mm - PLACES[place]).T).min())
