"""Finds the newest published parameter set of each axis, and its newest identified regulators."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from fdhil.identification import get_regulator_values, is_better_than_configured
from fdhil.records import LoopEstimate
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import Revision


def read_newest_parameters(
    store_directory: Path, axes: Iterable[str], warn: Callable[[str], object] | None = None
) -> dict[str, Revision]:
    """Return the newest published parameter set of each axis; empty if nothing was recorded yet.

    ``warn`` receives the damaged rows. Raises StoreError if a history exists but cannot be read.
    """
    if not (store_directory / HISTORY_FILE_NAME).is_file():
        return {}
    with History.open_read_only(store_directory, warn) as history:
        return find_newest_parameters(history, axes)


def find_newest_parameters(history: History, axes: Iterable[str]) -> dict[str, Revision]:
    """Return the newest published parameter set of each axis that has one."""
    newest = {axis: history.read_revisions(axis, limit=1) for axis in axes}
    return {axis: _add_newest_loops(found[0], history) for axis, found in newest.items() if found}


def _add_newest_loops(revision: Revision, history: History) -> Revision:
    """Add regulators that were identified after the set, or whose use was not recorded with it."""
    loops = history.read_loops(revision.set.axis, limit=1)
    if not loops or not loops[0][1].verdict.accepted:
        return revision
    stamp, found = loops[0]
    if revision.set.loops is not None and not stamp.is_after(revision.stamp):
        return revision
    return replace(
        revision,
        set=replace(revision.set, loops=get_regulator_values(found) if is_better_than_configured(found) else {}),
    )


def find_newest_loops(history: History, axis: str, config_digest: str) -> LoopEstimate | None:
    """Return the newest regulators of an axis if they were identified with this configuration.

    The configuration may have been tuned with the drive. Regulators without a set published since then belong to an
    earlier configuration.
    """
    newest = next(iter(history.read_revisions(axis, limit=1)), None)
    loops = history.read_loops(axis, limit=1)
    if newest is None or not loops or newest.set.config_digest != config_digest:
        return None
    stamp, found = loops[0]
    outdated = newest.set.loops == {} and is_better_than_configured(found) and not stamp.is_after(newest.stamp)
    return None if outdated else found
