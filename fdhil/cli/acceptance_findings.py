"""Content of an acceptance report and the rules of its open points."""

import csv
import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click
import numpy as np

from fdhil import correction
from fdhil.cli.doctor.latency import read_latency
from fdhil.cli.prediction_commands import load_inputs
from fdhil.commissioning import CommissioningRecord, StepProgress, is_record_valid, is_record_void, load_record
from fdhil.config import MachineConfig
from fdhil.errors import RecordingError, StoreError
from fdhil.prediction import CircleDeviations, evaluate_circle, write_circle_program
from fdhil.program import compute_program_digest
from fdhil.records import PARAMETERS, UNITS, Correction, Float, Prediction
from fdhil.report import PASS_CODE, AxisHistory, group_by_axis, read_history, read_notices, read_passes

SCHEMA = "fdhil-acceptance-1"
NO_LIMIT = "no limit was set: give the required accuracy with --circle-um and --contour-um"
NEWEST_PASSES = 20


@dataclass(frozen=True, slots=True)
class AcceptanceOptions:
    """Options of ``fdhil acceptance``."""

    by: str
    customer: str
    site: str
    program: Path | None
    radius_mm: float
    feed_mm_min: float
    measured_circle: Path | None
    contour_um: float | None
    circle_um: float | None

    @property
    def limits(self) -> Sequence[float]:
        """Limits that were set, um."""
        return [um for um in (self.contour_um, self.circle_um) if um is not None]


@dataclass(frozen=True, slots=True)
class AxisProof:
    """Commissioning of one drive: record, time of each step, and the objection, or an empty text."""

    record: CommissioningRecord | None
    steps: Mapping[str, str]
    against: str


@dataclass(frozen=True, slots=True)
class Findings:
    """Content of the report. ``circles`` are by their origin; ``plane`` is None without two linear axes.

    ``passes`` are the latest corrected passes and ``notices`` the pending notices, both as JSON entries; ``latency`` is
    the latest result of fdhil doctor --latency.
    """

    machine: MachineConfig
    options: AcceptanceOptions
    made_utc: str
    proofs: Mapping[str, AxisProof]
    histories: Sequence[AxisHistory]
    identified: bool
    plane: tuple[str, str] | None
    circles: Mapping[str, CircleDeviations]
    path: Correction | None
    passes: Sequence[Mapping[str, Any]]
    notices: Sequence[Mapping[str, Any]]
    latency: Mapping[str, Any] | None
    open_points: Sequence[str]


def gather_findings(machine: MachineConfig, config: Path, options: AcceptanceOptions) -> Findings:
    """Gather the content. Raises ConfigError, StoreError, ProgramError, RecordingError."""
    proofs = {axis: _gather_axis_proof(machine, axis) for axis in machine.axis}
    passes: Sequence[Mapping[str, Any]] = []
    notices: Sequence[Mapping[str, Any]] = []
    try:
        histories = group_by_axis(machine, *read_history(machine, tell=partial(click.echo, err=True)))
        passes = read_passes(machine)[-NEWEST_PASSES:]
        notices = [n for n in read_notices(machine) if n["acknowledged"] is None and n["code"] != PASS_CODE]
    except StoreError as error:
        if error.code != "NoHistory":
            raise
        histories = []
    known = {history.axis for history in histories if history.rows}
    identified = known >= set(machine.axis)
    linear = [axis for axis in ("X", "Y", "Z") if axis in machine.axis]
    plane = (linear[0], linear[1]) if len(linear) > 1 else None
    circles = _evaluate_circles(config, options, plane, identified) if plane else {}
    path = _plan_correction(options.program, config, identified) if options.program else None
    points = [f"{axis}: {proof.against}" for axis, proof in proofs.items() if proof.against]
    points += [
        f"{axis}: no published parameters, nominal ones are used; run the daemon while the axis makes rapids"
        for axis in machine.axis
        if axis not in known
    ]
    points += _find_exceeded_limits(options, circles, path)
    if major := sum(notice["severity"] == "MAJOR" for notice in notices):
        points.append(f"{major} MAJOR notices are pending; see fdhil status, then fdhil acknowledge")
    made = datetime.now(UTC).isoformat(timespec="seconds")
    known_by = (machine, options, made, proofs, histories, identified, plane, circles, path)
    return Findings(*known_by, passes, notices, read_latency(machine), points)


def _gather_axis_proof(machine: MachineConfig, axis: str) -> AxisProof:
    directory, key = machine.store.directory, machine.store.directory / "commissioning.key"
    try:
        record = load_record(directory, axis, key, may_lack_key=True)
    except StoreError as error:
        return AxisProof(None, {}, str(error))
    if record is None:
        return AxisProof(None, {}, "not commissioned; run fdhil commission")
    against = ""
    if is_record_void(directory, axis):
        against = "its record is void; run fdhil check with the NC off"
    elif not is_record_valid(record, machine, axis):
        against = "its record was made with another configuration; commission it again"
    return AxisProof(record, StepProgress(directory, axis).list_step_times(), against)


def _plan_correction(program: Path, config: Path, from_history: bool) -> Correction:
    reference, models, machine = load_inputs(program, config, None, from_history)
    return correction.plan_correction(reference, models, machine)


def _evaluate_circles(
    config: Path, options: AcceptanceOptions, plane: tuple[str, str], from_history: bool
) -> dict[str, CircleDeviations]:
    with tempfile.TemporaryDirectory(prefix="fdhil-circle-") as folder:
        program = Path(folder) / "circle.ngc"
        program.write_text(write_circle_program(plane, options.radius_mm, options.feed_mm_min), "ascii")
        planned = _plan_correction(program, config, from_history)
    cases = {"predicted, uncorrected": planned.before}
    if not planned.refused:
        cases["predicted, corrected"] = planned.after
    found = {
        label: evaluate_circle(_extract_table_mm(predicted, plane), options.radius_mm, (0.0, 0.0))
        for label, predicted in cases.items()
    }
    if options.measured_circle is not None:
        found["measured"] = evaluate_circle(read_measured_path(options.measured_circle, plane), options.radius_mm)
    return found


def _extract_table_mm(predicted: Prediction, plane: tuple[str, str]) -> Float:
    reference = predicted.reference
    return reference.compute_table_mm(predicted.predicted_mm)[:, [reference.table_axes.index(axis) for axis in plane]]


def read_measured_path(path: Path, plane: tuple[str, str]) -> Float:
    """Return a measured path (n, 2), mm. Raises RecordingError if the file has none."""
    names = [f"{axis}_mm" for axis in plane]
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [[float(row[name]) for name in names] for row in csv.DictReader(file)]
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the path") from None
    except (KeyError, TypeError, ValueError, csv.Error):
        text = (
            f"{path} is not a measured path; provide a CSV with the columns {', '.join(names)} and numbers in each row"
        )
        raise RecordingError(text) from None
    if not rows or not np.isfinite(rows).all():
        raise RecordingError(f"{path} has no rows, or a value that is not finite; export it again")
    return np.array(rows)


def _find_exceeded_limits(
    options: AcceptanceOptions, circles: Mapping[str, CircleDeviations], path: Correction | None
) -> list[str]:
    # a limit without a result to compare is open as well
    points = []
    if options.circle_um is not None:
        circle = circles.get("measured") or circles.get("predicted, corrected") or circles.get("predicted, uncorrected")
        if circle is None or circle.both_um > options.circle_um:
            found = "no circle is possible" if circle is None else f"it is {circle.both_um:.1f} um"
            points.append(f"circular deviation: {options.circle_um:g} um are allowed, {found}")
    if options.contour_um is not None:
        if path is None:
            points.append(f"contour error: {options.contour_um:g} um are allowed, but no --program was given")
        elif (largest := float((path.before if path.refused else path.after).contour_um.max())) > options.contour_um:
            points.append(f"contour error: {options.contour_um:g} um are allowed, it is {largest:.1f} um")
    return points


def build_acceptance_document(found: Findings) -> dict[str, Any]:
    """Return the content as JSON; ``sha256`` covers all other entries, with sorted keys and without spaces."""
    machine, options = found.machine, found.options
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "made_utc": found.made_utc,
        "made_by": f"fdhil {version('fdhil')}",
        "by": options.by,
        "customer": options.customer,
        "site": options.site,
        "machine": {
            "name": machine.machine.name,
            "config_digest": machine.digest,
            "sync_period_s": machine.machine.sync_period_s,
        },
        "axes": {axis: _describe_axis(found, axis) for axis in machine.axis},
        "circle": {
            "plane": "".join(found.plane or ()),
            "radius_mm": options.radius_mm,
            "feed_mm_min": options.feed_mm_min,
            "limit_um": options.circle_um,
            "found": {label: _describe_circle(circle) for label, circle in found.circles.items()},
        },
        "program": _describe_program(found),
        "passes": list(found.passes),
        "notices": list(found.notices),
        "latency": found.latency,
        "limits_set": bool(options.limits),
        "open": list(found.open_points),
        "accepted": not found.open_points,
    }
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return document | {"sha256": hashlib.sha256(text.encode()).hexdigest()}


def _describe_axis(found: Findings, axis: str) -> dict[str, Any]:
    proof = found.proofs[axis]
    rows = next((history.rows for history in found.histories if history.axis == axis), ())
    newest = rows[-1]["parameters"] if rows else None
    return {
        "commissioning": proof.record and {**asdict(proof.record), "digest": proof.record.digest},
        "steps": dict(proof.steps),
        "against": proof.against or None,
        "parameters": newest and {
            name: {key: newest[name].get(key) for key in ("value", "low", "high")} | {"unit": UNITS[name]}
            for name in PARAMETERS if name in newest
        },
    }  # fmt: skip


def _describe_circle(circle: CircleDeviations) -> dict[str, Any]:
    counter, clockwise = circle.deviations_um
    largest, least = circle.radial_um
    return {
        "deviation_counter_clockwise_um": counter,
        "deviation_clockwise_um": clockwise,
        "deviation_both_um": circle.both_um,
        "hysteresis_um": circle.hysteresis_um,
        "radial_largest_um": largest,
        "radial_least_um": least,
    }


def _describe_program(found: Findings) -> dict[str, Any] | None:
    if found.path is None or found.options.program is None:
        return None
    path = found.path
    cases = {"uncorrected": path.before} | ({} if path.refused else {"corrected": path.after})
    return {
        "name": found.options.program.name,
        "sha256": compute_program_digest(found.options.program),
        "limit_um": found.options.contour_um,
        "method": path.method,
        "refused": [str(reason) for reason in path.refused],
        **{label: {"rms_um": p.rms_um, "max_um": float(p.contour_um.max())} for label, p in cases.items()},
    }
