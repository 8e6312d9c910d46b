"""Predicts the gain of a correction, with the uncertainty recorded in the history."""

from collections.abc import Mapping

from fdhil.config import MachineConfig
from fdhil.prediction import CorrectionGain, find_worst_rms_um, predict_gain
from fdhil.records import Correction, Parameters, Skill
from fdhil.store.history_database import History

RECENT_MOVES = 3  # whose skill bounds what a correction can reach


def predict_gain_from_history(
    planned: Correction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    from_history: bool,
    held_out_um: Mapping[str, float] | None = None,
) -> CorrectionGain:
    """Return the predicted gain; ``from_history`` uses the newest parameters' covariance and skill. StoreError.

    ``held_out_um`` is the error of externally given models in moves that they were not identified on.
    """
    if not from_history:
        return predict_gain(planned, models, config, {}, held_out_um or {})
    with History.open_read_only(config.store.directory) as history:
        newest = {axis: history.read_revisions(axis, limit=1) for axis in config.axis}
    covariances = {axis: found[0].set.covariance for axis, found in newest.items() if found}
    return predict_gain(planned, models, config, covariances, find_worst_rms_um(read_recent_skills(config)))


def read_recent_skills(config: MachineConfig) -> dict[str, list[Skill]]:
    with History.open_read_only(config.store.directory) as history:
        return {axis: history.read_skills(axis, limit=RECENT_MOVES) for axis in config.axis}
