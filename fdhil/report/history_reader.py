"""Reads a machine's history from the store, for ``fdhil history --json`` and the pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from fdhil.config import MachineConfig
from fdhil.report.condition_summary import Refusals, count_refusals
from fdhil.report.drive_health import NEWEST_WINDOWS, assess_health
from fdhil.report.history_charts import AxisHistory

if TYPE_CHECKING:
    from fdhil.store import Revision, StoredWindow

NEWEST_NOTICES = 500
PASS_CODE = "PassMeasured"


def read_history(
    machine: MachineConfig, axis: str | None = None, tell: Callable[[str], object] | None = None
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the published revisions and the drives' health by axis. StoreError.

    ``tell`` receives a message about damaged rows that were left out.
    """
    from fdhil.store import History

    with History.open_read_only(machine.store.directory, tell) as stored:
        windows = stored.read_windows(axis, limit=NEWEST_WINDOWS)
        return [_describe_revision(revision) for revision in stored.read_revisions(axis)], assess_health(
            windows, stored, machine
        )


def read_axes(
    machine: MachineConfig, axis: str | None = None, newest: int = 1
) -> tuple[list[AxisHistory], dict[str, Refusals]]:
    """Return the history of each axis, or of one, and the refusals among its newest windows. StoreError.

    Of the published sets of one axis the first and the ``newest`` are read.
    """
    from fdhil.store import History

    with History.open_read_only(machine.store.directory) as stored:
        windows = stored.read_windows(axis, limit=NEWEST_WINDOWS)
        revisions = stored.read_revisions(axis, newest)
        if axis is not None and len(revisions) == newest > 1:
            first = stored.read_first_revision(axis)
            revisions = [first, *revisions[1:]] if first is not None else revisions
        assessed = assess_health(windows, stored, machine)
    refused = _count_refusals(windows)
    rows = [_describe_revision(revision) for revision in revisions]
    return group_by_axis(machine, rows, assessed, [*machine.axis, *refused]), refused


def read_refusals(machine: MachineConfig) -> dict[str, Refusals]:
    """Return the refusals among the newest windows, by axis. StoreError."""
    from fdhil.store import History

    with History.open_read_only(machine.store.directory) as stored:
        return _count_refusals(stored.read_windows(limit=NEWEST_WINDOWS))


def _count_refusals(windows: Sequence[StoredWindow]) -> dict[str, Refusals]:
    axes = dict.fromkeys(window.axis for window in windows)
    return {axis: count_refusals([window for window in windows if window.axis == axis]) for axis in axes}


def read_notices(machine: MachineConfig, axis: str | None = None) -> list[dict[str, Any]]:
    """Return the newest notices that require acknowledgement, and who acknowledged them, oldest first. StoreError."""
    from fdhil.store import RECENT_NOTICES, History, make_notice_document

    with History.open_read_only(machine.store.directory) as stored:
        known = stored.read_notices(limit=RECENT_NOTICES)
    asking = [n for n in known if n.notice.severity != "info" and axis in (None, n.notice.axis)]
    return [make_notice_document(notice) for notice in asking[-NEWEST_NOTICES:]]


def read_passes(machine: MachineConfig) -> list[dict[str, Any]]:
    """Return the notices of passes that were cut with correction, oldest first. StoreError."""
    from fdhil.store import RECENT_NOTICES, History, make_notice_document

    with History.open_read_only(machine.store.directory) as stored:
        known = stored.read_notices(limit=RECENT_NOTICES)
    return [make_notice_document(notice) for notice in known if notice.notice.code == PASS_CODE]


def _describe_revision(revision: Revision) -> dict[str, Any]:
    from fdhil.store import make_set_document

    return {
        **make_set_document(revision.set),
        "time": datetime.fromtimestamp(revision.stamp.wall_s, UTC).isoformat(timespec="seconds"),
        "window_ids": list(revision.window_ids),
        "config_digest": revision.set.config_digest,
    }


def group_by_axis(
    machine: MachineConfig, rows: Sequence[Mapping[str, Any]], assessed: Mapping[str, Any], seen: Iterable[str] = ()
) -> list[AxisHistory]:
    """Return the history of each axis, in the order of the configuration."""
    known = {*(row["axis"] for row in rows), *assessed, *seen}
    axes = [axis for axis in machine.axis if axis in known] + sorted(known - set(machine.axis))
    return [
        AxisHistory(
            axis,
            [row for row in rows if row["axis"] == axis],
            assessed.get(axis),
            _get_nominal_values(machine, axis) if axis in machine.axis else {},
        )
        for axis in axes
    ]


def _get_nominal_values(machine: MachineConfig, axis: str) -> dict[str, float]:
    settings = machine.axis[axis]
    return settings.nominal.model_dump(exclude=set[str](settings.guessed))
