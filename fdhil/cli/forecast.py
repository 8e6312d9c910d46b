"""What ``fdhil predict --from-history`` adds: when a zone leaves a tolerance, and what a step of a parameter costs."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from fdhil.errors import FdhilError

if TYPE_CHECKING:
    from fdhil.config import MachineConfig
    from fdhil.prediction.forecast import Step
    from fdhil.records import Parameters, Prediction
    from fdhil.store.history import Revision

DAY_S = 86400.0
FAR_DAYS = 36500.0
RECENT = 64  # revisions of an axis that are looked at


@dataclass(frozen=True, slots=True)
class Past:
    """The recent revisions of each axis, oldest first."""

    revisions: Mapping[str, Sequence[Revision]]

    @staticmethod
    def read(config: MachineConfig) -> Past:
        """Read the machine's history; StoreError when there is none."""
        from fdhil.store.history import History

        with History.read(config.store.directory) as history:
            return Past({axis: history.revisions(axis, RECENT) for axis in config.axis})


def steps(
    past: Past,
    predicted: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    since: int | None,
) -> tuple[Step, ...]:
    """Return what the steps since revision ``since`` (left out: since before each axis' last step) cost.

    FdhilError when no axis has that revision.
    """
    from fdhil.prediction import forecast

    now = {axis: found[-1].set for axis, found in past.revisions.items() if found}
    earlier = {}
    for axis, found in past.revisions.items():
        sets = [revision.set for revision in found]
        if since is None:
            place = forecast.last_step(sets)
        else:
            place = next((k for k, known in enumerate(sets) if known.revision == since), None)
        if place is not None:
            earlier[axis] = sets[place]
    if since is not None and not earlier:
        raise FdhilError(f"there is no revision {since} among the last {RECENT}; fdhil history lists them")
    return forecast.step_costs(predicted, models, earlier, now, config)


def step_entries(found: Sequence[Step]) -> list[dict[str, Any]]:
    """Return the steps as JSON has them."""
    return [
        {
            "axis": step.axis,
            "what": step.what,
            "parameters": {name: {"before": old, "now": new} for name, (old, new) in step.changed.items()},
            "since_revision": step.since_revision,
            "cost_um": step.cost_um,
            "rms_um": step.rms_um,
            "line": step.line,
            "where": step.where,
        }
        for step in found
    ]


def show_steps(found: Sequence[Step]) -> None:
    """Print a line per step: what changed and what it costs where."""
    for step in found:
        changed = ", ".join(f"{name} {old:.4g} -> {new:.4g}" for name, (old, new) in step.changed.items())
        place = f"line {step.line}, {step.where}" if step.line else step.where
        verb = "costs" if step.cost_um > 0 else "saves"
        click.echo(
            f"the {step.what} of axis {step.axis} has changed since revision {step.since_revision} ({changed}):"
            f" it {verb} {abs(step.cost_um):.1f} um at {place}"
        )


def crossings(
    past: Past,
    predicted: Prediction,
    um_per_percent: Sequence[Mapping[str, Mapping[str, float]]],
    models: Mapping[str, Parameters],
    tolerance_um: float,
) -> list[dict[str, Any]]:
    """Return per zone when it leaves the tolerance as JSON has it: ``state`` is over, foreseen or not_foreseen."""
    from fdhil.prediction import forecast

    newest = max((found[-1].stamp.wall_s for found in past.revisions.values() if found), default=0.0)
    slopes = {
        axis: forecast.slopes_per_day([r.set for r in past.revisions[axis]], _days(past.revisions[axis], newest))
        for axis in predicted.reference.axes
        if past.revisions.get(axis)
    }
    told: list[dict[str, Any]] = []
    for zone, per_axis in zip(predicted.zones, um_per_percent, strict=True):
        if zone.max_um > tolerance_um:
            told.append({"state": "over"})
            continue
        found = forecast.crossing(zone, per_axis, models, slopes, tolerance_um)
        if found is None or found.days > FAR_DAYS:
            told.append({"state": "not_foreseen"})
            continue
        told.append(
            {
                "state": "foreseen",
                "in_days": found.days,
                "date": _date(newest, found.days),
                "earliest": _date(newest, found.earliest_days),
                "latest": _date(newest, found.latest_days),
                "axis": found.axis,
                "parameter": found.parameter,
            }
        )
    return told


def _days(revisions: Sequence[Revision], newest_s: float) -> Any:
    import numpy as np

    return np.array([(revision.stamp.wall_s - newest_s) / DAY_S for revision in revisions])


def _date(start_s: float, days: float) -> str | None:
    """Return the day as ISO 8601; None beyond what can be foreseen."""
    if days > FAR_DAYS:
        return None
    at = datetime.datetime.fromtimestamp(start_s, datetime.UTC) + datetime.timedelta(days=days)
    return at.date().isoformat()


def crossing_text(entry: Mapping[str, Any], tolerance_um: float) -> str:
    """Return the sentence for one zone."""
    if entry["state"] == "over":
        return f"is over {tolerance_um:g} um"
    if entry["state"] == "not_foreseen":
        return f"is not foreseen to leave {tolerance_um:g} um"
    latest = entry["latest"] or "later"
    return (
        f"leaves {tolerance_um:g} um about {entry['date']} ({entry['earliest']} to {latest}),"
        f" driven by {entry['parameter']} of axis {entry['axis']}"
    )
