"""History part of ``fdhil predict --from-history``: step costs, zone changes, and forecast tolerance crossings."""

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
    from fdhil.prediction import ParameterStep, ZoneChange
    from fdhil.records import Float, Parameters, Prediction
    from fdhil.store import Comparison, Revision, TimeStamp

DAY_S = 86400.0
FAR_DAYS = 36500.0
RECENT = 64  # revisions of an axis, or predictions of a program, that are read
BEYOND_CHANCE = 2.0  # standard deviations
TOLD_UM = 0.1  # smaller changes are listed only with --json
MANY_CHANGES = 12
MANY_CAUSES, WORTH_TELLING = 3, 0.3  # causes shown per change, and their least share of the largest one
KEPT = ("start_s", "end_s", "where", "line", "max_um", "cause", "std_um")


@dataclass(frozen=True, slots=True)
class ProgramHistory:
    """Recent revisions of each axis, oldest first, and earlier predictions of a program, newest first."""

    revisions: Mapping[str, Sequence[Revision]]
    comparisons: Sequence[tuple[TimeStamp, Comparison]]

    @staticmethod
    def read(config: MachineConfig, program_digest: str) -> ProgramHistory:
        """Read the machine's history. Raises StoreError if there is none."""
        from fdhil.store import History

        with History.open_read_only(config.store.directory, partial(click.echo, err=True)) as history:
            revisions = {axis: history.read_revisions(axis, RECENT) for axis in config.axis}
            return ProgramHistory(revisions, history.read_comparisons(program_digest, RECENT))


def build_comparison(
    program: Path,
    digest: str,
    past: ProgramHistory,
    predicted: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    zones: Sequence[Mapping[str, Any]],
) -> Comparison:
    """Return this prediction as a row of the store; ``zones`` are the JSON entries."""
    from fdhil.store import Comparison, UsedParameters

    newest = {axis: found[-1].set.revision for axis, found in past.revisions.items() if found}
    return Comparison(
        program=digest,
        name=program.name,
        config_digest=config.digest,
        used={axis: UsedParameters(newest.get(axis, 0), models[axis]) for axis in predicted.reference.axes},
        rms_um=predicted.rms_um,
        zones=tuple({key: zone[key] for key in KEPT} for zone in zones),
    )


def store_comparison(past: ProgramHistory, now: Comparison, config: MachineConfig) -> None:
    """Store this prediction unless it equals the last one; only warn if the store fails."""
    if past.comparisons and _is_same_basis(past.comparisons[0][1], now):
        return
    from fdhil.errors import StoreError
    from fdhil.store import History, TimeStamp

    try:
        with History.open(config.store.directory) as history:
            history.add_comparison(now, TimeStamp.now())
    except StoreError as error:
        click.echo(f"this prediction was not stored for later comparison: {error}", err=True)


def _is_same_basis(one: Comparison, other: Comparison) -> bool:
    return one.used == other.used and one.config_digest == other.config_digest


def compare_zones(
    past: ProgramHistory, now: Comparison, predicted: Prediction, std_um: Float, config: MachineConfig
) -> dict[str, Any] | None:
    """Return as JSON the change of each zone since the last prediction with other parameters or configuration.

    None if there is no such prediction.
    """
    from fdhil.prediction import compare_zones as compare_zone_errors
    from fdhil.records import Zone

    before = next(((stamp, old) for stamp, old in past.comparisons if not _is_same_basis(old, now)), None)
    if before is None:
        return None
    stamp, old = before
    recorded = [(Zone(z["start_s"], z["end_s"], z["where"], z["max_um"], z["cause"]), z["std_um"]) for z in old.zones]
    models = {axis: used.parameters for axis, used in now.used.items()}
    earlier = {axis: used.parameters for axis, used in old.used.items() if axis in models}
    same_settings = old.config_digest == now.config_digest
    changes = compare_zone_errors(predicted, models, earlier, std_um, recorded, config, same_settings)
    return {
        "at": datetime.datetime.fromtimestamp(stamp.wall_s, datetime.UTC).isoformat(timespec="seconds"),
        "revisions": {axis: used.revision for axis, used in old.used.items()},
        "configuration_changed": not same_settings,
        "rms_um": {"before": old.rms_um, "now": now.rms_um},
        "zones": [_describe_change(change, earlier, models) for change in changes],
    }


def _describe_change(
    change: ZoneChange, earlier: Mapping[str, Parameters], models: Mapping[str, Parameters]
) -> dict[str, Any]:
    from fdhil.prediction import list_values

    both = {"before": earlier, "now": models}
    values = {when: {axis: list_values(p) for axis, p in of.items()} for when, of in both.items()}
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
                **{when: of[axis].get(name, 0.0) for when, of in values.items()},
                "um": um,
            }
            for axis, name, um in change.by
        ],
        "settings_um": change.settings_um,
    }


def show_zone_changes(found: Mapping[str, Any] | None) -> None:
    """Print the zones with significant changes, largest change first, and their causes."""
    if found is None:
        return
    from fdhil.prediction import format_half_interval

    revisions = ", ".join(f"{axis} {revision}" for axis, revision in found["revisions"].items())
    since = f"since this program was predicted on {found['at'][:10]} (revisions {revisions})"
    beyond = [z for z in found["zones"] if abs(z["change_um"]) > max(TOLD_UM, BEYOND_CHANCE * z["std_um"])]
    if not beyond:
        click.echo(f"no significant change {since}")
        return
    rms = found["rms_um"]
    click.echo(f"{since}: {rms['before']:.1f} -> {rms['now']:.1f} um RMS")
    for zone in sorted(beyond, key=lambda z: -abs(z["change_um"]))[:MANY_CHANGES]:
        line = f"line {zone['line']}, " if zone["line"] else ""
        half_um = INTERVAL_95 * zone["std_um"]
        click.echo(
            f"  {zone['change_um']:+.1f} {format_half_interval(half_um)} um at {line}{zone['where']} ({zone['cause']},"
            f" {zone['before_um']:.1f} -> {zone['now_um']:.1f}){_describe_causes(zone)}"
        )
    if len(beyond) > MANY_CHANGES:
        click.echo(f"  and {len(beyond) - MANY_CHANGES} zones with smaller changes (--json lists all)")


def _describe_causes(zone: Mapping[str, Any]) -> str:
    causes = [
        (by["um"], f"by {by['parameter']} of axis {by['axis']}, {by['before']:.4g} -> {by['now']:.4g}")
        for by in zone["by"]
    ]
    if zone["settings_um"]:
        causes.append((zone["settings_um"], "by the configuration"))
    causes.sort(key=lambda cause: -abs(cause[0]))
    shown = [f"{um:+.1f} {text}" for um, text in causes[:MANY_CAUSES] if abs(um) >= WORTH_TELLING * abs(causes[0][0])]
    return f": {'; '.join(shown)}" if shown else ""


def estimate_step_costs(
    past: ProgramHistory,
    predicted: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    since: int | None,
) -> tuple[ParameterStep, ...]:
    """Return the cost of the parameter steps since revision ``since`` (default: since before each axis' last step).

    Raises click.UsageError if no axis has that revision.
    """
    from fdhil.prediction import compute_step_costs, find_last_step

    now = {axis: found[-1].set for axis, found in past.revisions.items() if found}
    earlier = {}
    for axis, found in past.revisions.items():
        sets = [revision.set for revision in found]
        if since is None:
            place = find_last_step(sets)
        else:
            place = next((k for k, one in enumerate(sets) if one.revision == since), None)
        if place is not None:
            earlier[axis] = sets[place]
    if since is not None and not earlier:
        raise click.UsageError(
            f"--since: there is no revision {since} among the last {RECENT}; fdhil history lists them"
        )
    return compute_step_costs(predicted, models, earlier, now, config)


def describe_steps(found: Sequence[ParameterStep]) -> list[dict[str, Any]]:
    """Return the steps as JSON entries."""
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


def show_steps(found: Sequence[ParameterStep]) -> None:
    """Print one line per step: the change, its cost and its location."""
    for step in found:
        changed = ", ".join(f"{name} {old:.4g} -> {new:.4g}" for name, (old, new) in step.changed.items())
        place = f"line {step.line}, {step.where}" if step.line else step.where
        verb = "costs" if step.cost_um > 0 else "saves"
        click.echo(
            f"the {step.what} of axis {step.axis} changed since revision {step.since_revision} ({changed}):"
            f" it {verb} {abs(step.cost_um):.1f} um at {place}"
        )


def predict_crossings(
    past: ProgramHistory,
    predicted: Prediction,
    um_per_percent: Sequence[Mapping[str, Mapping[str, float]]],
    models: Mapping[str, Parameters],
    tolerance_um: float,
) -> list[dict[str, Any]]:
    """Return as JSON when each zone will leave the tolerance.

    ``state`` is over, foreseen, not_foreseen (within ``within_days``) or not_enough_history (of
    ``compute_observed_days``).
    """
    from fdhil.identification import limit_forecast_days
    from fdhil.prediction import compute_observed_days, fit_parameter_trend, predict_tolerance_crossing

    newest = max((found[-1].stamp.wall_s for found in past.revisions.values() if found), default=0.0)
    courses = {
        axis: fit_parameter_trend([r.set for r in past.revisions[axis]], _convert_to_days(past.revisions[axis], newest))
        for axis in predicted.reference.axes
        if past.revisions.get(axis)
    }
    span_days = compute_observed_days(courses)
    within_days = min(limit_forecast_days(span_days), FAR_DAYS)
    entries: list[dict[str, Any]] = []
    for zone, per_axis in zip(predicted.zones, um_per_percent, strict=True):
        if zone.max_um > tolerance_um:
            entries.append({"state": "over"})
            continue
        if not within_days:
            entries.append({"state": "not_enough_history", "span_days": span_days})
            continue
        found = predict_tolerance_crossing(zone, per_axis, models, courses, tolerance_um)
        if found is None or found.days > within_days:
            entries.append({"state": "not_foreseen", "within_days": within_days})
            continue
        entries.append(
            {
                "state": "foreseen",
                "in_days": found.days,
                "date": _format_date(newest, found.days),
                "earliest": _format_date(newest, found.earliest_days),
                "latest": _format_date(newest, found.latest_days),
                "axis": found.axis,
                "parameter": found.parameter,
            }
        )
    return entries


def _convert_to_days(revisions: Sequence[Revision], newest_s: float) -> Any:
    import numpy as np

    return np.array([(revision.stamp.wall_s - newest_s) / DAY_S for revision in revisions])


def _format_date(start_s: float, days: float) -> str | None:
    if days > FAR_DAYS:
        return None
    at = datetime.datetime.fromtimestamp(start_s, datetime.UTC) + datetime.timedelta(days=days)
    return at.date().isoformat()


def format_crossing(entry: Mapping[str, Any], tolerance_um: float) -> str:
    """Return the forecast of one zone as text."""
    if entry["state"] == "over":
        return f"exceeds {tolerance_um:g} um now"
    if entry["state"] == "not_enough_history":
        return (
            f"no forecast for {tolerance_um:g} um: {_format_span(entry['span_days'])} of history are too short,"
            " at least one day is needed"
        )
    if entry["state"] == "not_foreseen":
        return f"is not expected to exceed {tolerance_um:g} um within {_format_span(entry['within_days'])}"
    latest = entry["latest"] or "later"
    if entry["date"] < datetime.datetime.now(datetime.UTC).date().isoformat():
        return (
            f"has probably exceeded {tolerance_um:g} um since {entry['date']} ({entry['earliest']} to {latest}),"
            f" after the newest parameters, because of {entry['parameter']} of axis {entry['axis']}: identify again"
        )
    return (
        f"is expected to exceed {tolerance_um:g} um about {entry['date']} ({entry['earliest']} to {latest}),"
        f" because of {entry['parameter']} of axis {entry['axis']}"
    )


def _format_span(days: float) -> str:
    if days >= 2.0:
        return f"{days:.0f} days"
    return f"{days * 24:.0f} h" if days >= 1 / 12 else f"{days * 1440:.0f} min"
