"""Plans, predicts and corrects the path of a machine: the functions behind the command line."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fdhil import config, correction, prediction
from fdhil.api.compilation_notice import announce_compilation
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.prediction import (
    apply_loops,
    build_nominal_models,
    combine_held_out_um,
    describe_loop_differences,
    find_largest_error_um,
    find_moving_axes,
    load_model_file,
    load_validated_models,
    select_models,
)
from fdhil.program import load_trajectory
from fdhil.records import Correction, Parameters, Prediction, Trajectory
from fdhil.store import read_newest_parameters, read_recent_skills

HISTORY = "history"
Models = Mapping[str, Parameters] | str | Path | None
"""The model of each axis; a model file (JSON); "history", the newest validated ones; None, the nominal ones."""


@dataclass(frozen=True)
class Machine:
    """A machine, defined by its configuration.

    >>> import fdhil
    >>> machine = fdhil.Machine.load("configs/sim.toml")
    >>> machine.axes
    ('X', 'Y')
    """

    config: MachineConfig
    source: str = "machine"

    @classmethod
    def load(cls, path: str | Path) -> Machine:
        """Read a configuration (TOML). ConfigError with all its faults."""
        return cls(config.load_config(Path(path)), str(path))

    @classmethod
    def of(cls, machine: Machine | str | Path) -> Machine:
        """Return the machine, or load it from the path of a configuration."""
        return machine if isinstance(machine, Machine) else cls.load(machine)

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of its axes."""
        return tuple(self.config.axis)

    @property
    def models(self) -> Mapping[str, Parameters]:
        """The nominal model of each axis."""
        return build_nominal_models(self.config)


def plan(program: str | Path | Trajectory, machine: Machine | str | Path) -> Trajectory:
    """Return the demand (n,) per axis, mm, that the machine's NC makes of a program (NC program or demand CSV).

    ProgramError or RecordingError for an unreadable file, ConfigError for an axis that is not configured.
    """
    return program if isinstance(program, Trajectory) else load_trajectory(Path(program), Machine.of(machine).config)


def predict(program: str | Path | Trajectory, machine: Machine | str | Path, models: Models = None) -> Prediction:
    """Predict the path error of a program on the machine's drives. Raises the errors of plan().

    >>> import fdhil
    >>> found = fdhil.predict("configs/programs/bench_10m.ngc", "configs/sim.toml")
    >>> found.rms_um > 0, found.contour_um.shape == found.reference.time_s.shape
    (True, True)
    """
    announce_compilation("predict")
    return prediction.predict_path(*read_inputs(program, machine, models))


def correct(
    program: str | Path | Trajectory,
    machine: Machine | str | Path,
    models: Models = None,
    *,
    method: str | None = None,
) -> Correction:
    """Plan the offsets (n,) per axis, um, that correct the predicted path error. Nothing is sent to a machine.

    ``refused`` has the reasons where a correction is not predicted to help: its offsets are 0. Raises the errors of
    plan().
    """
    announce_compilation("predict", "correct")
    reference, given, settings = read_inputs(program, machine, models)
    return correction.plan_correction(
        reference, given, settings, method, find_held_out_max_um(reference, settings, models)
    )


def find_held_out_max_um(reference: Trajectory, settings: MachineConfig, models: Models) -> float | None:
    """Return the largest error (um) of the models in moves that they were not identified from; None where unknown."""
    found: Mapping[str, float] = {}
    if models == HISTORY:
        found = find_largest_error_um(read_recent_skills(settings))
    elif isinstance(models, str | Path):
        found = load_model_file(Path(models)).held_out_max_um
    return combine_held_out_um(found, find_moving_axes(reference))


def read_inputs(
    program: str | Path | Trajectory,
    machine: Machine | str | Path,
    models: Models,
    warn: Callable[[str], None] = warnings.warn,
) -> tuple[Trajectory, dict[str, Parameters], MachineConfig]:
    """Return reference, models and configuration, the latter with the loops of a model file or of the history."""
    known = Machine.of(machine)
    settings, source = known.config, known.source
    given: Mapping[str, Parameters] = known.models
    if models == HISTORY:
        source = str(settings.store.directory)
        newest = read_newest_parameters(settings.store.directory, settings.axis, warn)
        sets = {axis: found.set for axis, found in newest.items()}
        given, settings = load_validated_models(sets, settings, source)
    elif isinstance(models, str | Path):
        source = str(models)
        file = load_model_file(Path(models))
        given = file.parameters
        _refuse_refuted_loops(settings, given.keys() - file.loops.keys(), source)
        settings = apply_loops(settings, file.loops, source)
    elif models is not None:
        given = {**given, **models}
    reference = program if isinstance(program, Trajectory) else load_trajectory(Path(program), settings)
    return reference, select_models(reference, given, settings, source), settings


def _refuse_refuted_loops(config: MachineConfig, axes: Iterable[str], source: str) -> None:
    """Raise ConfigError where a model file lacks the loops of an axis whose rapids refuted the configured ones."""
    faults = []
    with contextlib.suppress(StoreError):
        for axis, newest in read_newest_parameters(config.store.directory, config.axis.keys() & axes).items():
            loops, same = newest.set.loops or {}, newest.set.config_digest == config.digest
            if same and (apart := describe_loop_differences(loops, config.axis[axis].regulators)):
                text = f"LoopsDiffer: is missing, and the machine's rapids showed other loops than configured ({apart})"
                advice = "write the model again with fdhil identify --write-model, or use --from-history"
                faults.append(ConfigFault(f"{axis}.loops", text, advice))
    if faults:
        raise ConfigError(source, faults)
