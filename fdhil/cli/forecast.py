"""Adds to ``fdhil predict --from-history`` what a step costs, each zone's change, and when it leaves a tolerance."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from fdhil.records import INTERVAL_95

if TYPE_CHECKING:
    from pathlib import Path

    from fdhil.config import MachineConfig
    from fdhil.prediction.forecast import Step, ZoneChange
    from fdhil.records import Float, Parameters, Prediction
    from fdhil.store.rows import Comparison, Revision, Stamp

DAY_S = 86400.0
FAR_DAYS = 36500.0
RECENT = 64  # revisions of an axis, or comparisons of a program, that are looked at
BEYOND_CHANCE = 2.0  # standard deviations
TOLD_UM = 0.1  # a smaller change is listed by --json only
MANY_CHANGES = 12
MANY_CAUSES, WORTH_TELLING = 3, 0.3  # of a change, those that did so much of what the first did
KEPT = ("start_s", "end_s", "where", "line", "max_um", "cause", "std_um")


@dataclass(frozen=True, slots=True)
class Past:
    """The recent revisions of each axis, oldest first, and what was predicted of a program, newest first."""

    revisions: Mapping[str, Sequence[Revision]]
    comparisons: Sequence[tuple[Stamp, Comparison]]

    @staticmethod
    def read(config: MachineConfig, program_digest: str) -> Past:
        """Read the machine's history; StoreError when there is none."""
        from fdhil.store.history import History

        with History.read(config.store.directory, partial(click.echo, err=True)) as history:
            revisions = {axis: history.revisions(axis, RECENT) for axis in config.axis}
            return Past(revisions, history.comparisons(program_digest, RECENT))


def comparison(
    program: Path,
    digest: str,
    past: Past,
    predicted: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    zones: Sequence[Mapping[str, Any]],
) -> Comparison:
    """Return this prediction as the store keeps it; ``zones`` as JSON has them."""
    from fdhil.store.rows import Comparison, UsedParameters

    newest = {axis: found[-1].set.revision for axis, found in past.revisions.items() if found}
    return Comparison(
        program=digest,
        name=program.name,
        config_digest=config.digest,
        used={axis: UsedParameters(newest.get(axis, 0), models[axis]) for axis in predicted.reference.axes},
        rms_um=predicted.rms_um,
        zones=tuple({key: zone[key] for key in KEPT} for zone in zones),
    )


def remember(past: Past, now: Comparison, config: MachineConfig) -> None:
    """Store this prediction, unless it is the last one again; a store that takes nothing is told, and no more."""
    if past.comparisons and _same(past.comparisons[0][1], now):
        return
    from fdhil.errors import StoreError
    from fdhil.store.history import History
    from fdhil.store.rows import Stamp

    try:
        with History.open(config.store.directory) as history:
            history.add_comparison(now, Stamp.now())
    except StoreError as error:
        click.echo(f"this prediction is not kept for the next one to compare with: {error}", err=True)


def _same(one: Comparison, other: Comparison) -> bool:
    return one.used == other.used and one.config_digest == other.config_digest


def compared(
    past: Past, now: Comparison, predicted: Prediction, std_um: Float, config: MachineConfig
) -> dict[str, Any] | None:
    """Return as JSON has it what became of each zone since the program was last predicted otherwise than now.

    None when it was not predicted before, or always with these parameters and this configuration.
    """
    from fdhil.prediction import forecast
    from fdhil.records import Zone

    before = next(((stamp, old) for stamp, old in past.comparisons if not _same(old, now)), None)
    if before is None:
        return None
    stamp, old = before
    recorded = [(Zone(z["start_s"], z["end_s"], z["where"], z["max_um"], z["cause"]), z["std_um"]) for z in old.zones]
    models = {axis: used.parameters for axis, used in now.used.items()}
    earlier = {axis: used.parameters for axis, used in old.used.items() if axis in models}
    same_settings = old.config_digest == now.config_digest
    changes = forecast.zone_changes(predicted, models, earlier, std_um, recorded, config, same_settings)
    return {
        "at": datetime.datetime.fromtimestamp(stamp.wall_s, datetime.UTC).isoformat(timespec="seconds"),
        "revisions": {axis: used.revision for axis, used in old.used.items()},
        "configuration_changed": not same_settings,
        "rms_um": {"before": old.rms_um, "now": now.rms_um},
        "zones": [_change_entry(change, earlier, models) for change in changes],
    }


def _change_entry(
    change: ZoneChange, earlier: Mapping[str, Parameters], models: Mapping[str, Parameters]
) -> dict[str, Any]:
    from fdhil.prediction.model_terms import values_of

    old, new = ({axis: values_of(p) for axis, p in models.items()} for models in (earlier, models))
    return {
        "line": change.line,
        "where": change.where,
        "cause": change.cause,
        "before_um": change.before_um,
        "now_um": change.now_um,
        "change_um": change.now_um - change.before_um,
        "std_um": change.std_um,
        "by": [
            {
                "axis": axis,
                "parameter": name,
                "before": old[axis].get(name, 0.0),
                "now": new[axis].get(name, 0.0),
                "um": um,
            }
            for axis, name, um in change.by
        ],
        "settings_um": change.settings_um,
    }


def show_compared(found: Mapping[str, Any] | None) -> None:
    """Print the zones that have changed beyond chance, the most changed of them, and what caused it."""
    if found is None:
        return
    from fdhil.prediction.gain import format_half_interval

    revisions = ", ".join(f"{axis} {revision}" for axis, revision in found["revisions"].items())
    since = f"since this program was predicted on {found['at'][:10]} (revisions {revisions})"
    beyond = [z for z in found["zones"] if abs(z["change_um"]) > max(TOLD_UM, BEYOND_CHANCE * z["std_um"])]
    if not beyond:
        click.echo(f"nothing has changed beyond chance {since}")
        return
    rms = found["rms_um"]
    click.echo(f"{since}: {rms['before']:.1f} -> {rms['now']:.1f} um RMS")
    for zone in sorted(beyond, key=lambda z: -abs(z["change_um"]))[:MANY_CHANGES]:
        line = f"line {zone['line']}, " if zone["line"] else ""
        half_um = INTERVAL_95 * zone["std_um"]
        click.echo(
            f"  {zone['change_um']:+.1f} {format_half_interval(half_um)} um at {line}{zone['where']} ({zone['cause']},"
            f" {zone['before_um']:.1f} -> {zone['now_um']:.1f}){_because(zone)}"
        )
    if len(beyond) > MANY_CHANGES:
        click.echo(f"  and {len(beyond) - MANY_CHANGES} zones that changed less (--json lists them all)")


def _because(zone: Mapping[str, Any]) -> str:
    """Name what did it, the most first; what did little beside that is left to --json."""
    causes = [
        (by["um"], f"by {by['parameter']} of axis {by['axis']}, {by['before']:.4g} -> {by['now']:.4g}")
        for by in zone["by"]
    ]
    if zone["settings_um"]:
        causes.append((zone["settings_um"], "by the configuration"))
    causes.sort(key=lambda cause: -abs(cause[0]))
    told = [f"{um:+.1f} {text}" for um, text in causes[:MANY_CAUSES] if abs(um) >= WORTH_TELLING * abs(causes[0][0])]
    return f": {'; '.join(told)}" if told else ""


def steps(
    past: Past,
    predicted: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    since: int | None,
) -> tuple[Step, ...]:
    """Return what the steps since revision ``since`` (left out: since before each axis' last step) cost.

    UsageError when no axis has that revision.
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
        raise click.UsageError(
            f"--since: there is no revision {since} among the last {RECENT}; fdhil history lists them"
        )
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
    """Return per zone when it leaves the tolerance as JSON has it: ``state`` is over, foreseen, not_foreseen within
    ``within_days``, or not_enough_history, of which there are ``span_days``.
    """
    from fdhil.identification.trends import reach_days
    from fdhil.prediction import forecast

    newest = max((found[-1].stamp.wall_s for found in past.revisions.values() if found), default=0.0)
    courses = {
        axis: forecast.course([r.set for r in past.revisions[axis]], _days(past.revisions[axis], newest))
        for axis in predicted.reference.axes
        if past.revisions.get(axis)
    }
    span_days = forecast.span_days(courses)
    within_days = min(reach_days(span_days), FAR_DAYS)
    told: list[dict[str, Any]] = []
    for zone, per_axis in zip(predicted.zones, um_per_percent, strict=True):
        if zone.max_um > tolerance_um:
            told.append({"state": "over"})
            continue
        if not within_days:
            told.append({"state": "not_enough_history", "span_days": span_days})
            continue
        found = forecast.crossing(zone, per_axis, models, courses, tolerance_um)
        if found is None or found.days > within_days:
            told.append({"state": "not_foreseen", "within_days": within_days})
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
    if entry["state"] == "not_enough_history":
        return (
            f"when it leaves {tolerance_um:g} um cannot be told, not enough history: {_span(entry['span_days'])},"
            " a forecast wants a day or more"
        )
    if entry["state"] == "not_foreseen":
        return f"is not foreseen to leave {tolerance_um:g} um within {_span(entry['within_days'])}"
    latest = entry["latest"] or "later"
    if entry["date"] < datetime.datetime.now(datetime.UTC).date().isoformat():
        return (
            f"will have left {tolerance_um:g} um about {entry['date']} ({entry['earliest']} to {latest}), after the"
            f" newest parameters, driven by {entry['parameter']} of axis {entry['axis']}: identify anew"
        )
    return (
        f"leaves {tolerance_um:g} um about {entry['date']} ({entry['earliest']} to {latest}),"
        f" driven by {entry['parameter']} of axis {entry['axis']}"
    )


def _span(days: float) -> str:
    if days >= 2.0:
        return f"{days:.0f} days"
    return f"{days * 24:.0f} h" if days >= 1 / 12 else f"{days * 1440:.0f} min"
