"""Reads what the store knows of a machine's drives, as ``fdhil history --json`` and the pages have it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.history_course import AxisHistory
from fdhil.cli.history_trends import NEWEST_WINDOWS, health
from fdhil.cli.history_verdict import Refusals, refusals_of
from fdhil.config import MachineConfig

if TYPE_CHECKING:
    from fdhil.store.rows import Revision


def read_history(machine: MachineConfig, axis: str | None = None) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the published revisions and, by axis, what the windows tell of the drive's health. StoreError."""
    from fdhil.store.history import History

    with History.read(machine.store.directory, partial(click.echo, err=True)) as stored:
        return [_row(revision) for revision in stored.revisions(axis)], health(stored, machine, axis)


def _row(revision: Revision) -> dict[str, Any]:
    from fdhil.daemon.outcome_json import set_document

    return {
        **set_document(revision.set),
        "time": datetime.fromtimestamp(revision.stamp.wall_s, UTC).isoformat(timespec="seconds"),
        "window_ids": list(revision.window_ids),
        "config_digest": revision.set.config_digest,
    }


def read_refusals(machine: MachineConfig) -> dict[str, Refusals]:
    """Return by axis which of the newest windows were not believed. StoreError."""
    from fdhil.store.history import History

    with History.read(machine.store.directory) as stored:
        windows = stored.windows(limit=NEWEST_WINDOWS)
    axes = dict.fromkeys(window.axis for window in windows)
    return {axis: refusals_of([window for window in windows if window.axis == axis]) for axis in axes}


def by_axis(
    machine: MachineConfig, rows: Sequence[Mapping[str, Any]], told: Mapping[str, Any], seen: Iterable[str] = ()
) -> list[AxisHistory]:
    """Return the history of each axis that is known of, in the order of the config."""
    known = {*(row["axis"] for row in rows), *told, *seen}
    axes = [axis for axis in machine.axis if axis in known] + sorted(known - set(machine.axis))
    return [
        AxisHistory(
            axis,
            [row for row in rows if row["axis"] == axis],
            told.get(axis),
            machine.axis[axis].nominal.model_dump() if axis in machine.axis else {},
        )
        for axis in axes
    ]
