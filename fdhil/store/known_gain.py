"""What a correction is predicted to gain, with the uncertainty that the history knows."""

from collections.abc import Mapping

from fdhil.config import MachineConfig
from fdhil.prediction.gain import Gain, gain
from fdhil.records import Correction, Parameters
from fdhil.store.history import History

RECENT_MOVES = 3  # whose skill bounds what a correction can reach


def known_gain(
    planned: Correction, models: Mapping[str, Parameters], config: MachineConfig, from_history: bool
) -> Gain:
    """Return the gain; without ``from_history`` nothing is known of how well the models fit. StoreError."""
    if not from_history:
        return gain(planned, models, config, {}, {})
    with History.read(config.store.directory) as history:
        newest = {axis: history.revisions(axis, limit=1) for axis in config.axis}
        skills = {axis: history.skills(axis, limit=RECENT_MOVES) for axis in config.axis}
    covariances = {axis: found[0].set.covariance for axis, found in newest.items() if found}
    return gain(planned, models, config, covariances, skills)
