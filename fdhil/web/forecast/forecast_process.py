"""Forecasts a program from the browser: its path error without and with correction, or advised feeds.

Runs as a child process (``python -m fdhil.web.forecast.forecast_process``, one JSON request on stdin), at low priority
and with
limited time, memory and disk, so that no program can delay the daemon or the pages. It reads the history and writes
into the given folder; nothing is sent to any machine.
"""

import itertools
import math
import resource
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fdhil import correction
from fdhil.bounded_process import limit_process, receive_request, report_to_parent
from fdhil.config import MachineConfig
from fdhil.correction import advise_with_correction, build_advice_document, build_correction_document, make_feed_sources
from fdhil.errors import FdhilError, ProgramError
from fdhil.prediction import FeedScaledPath, build_nominal_models, load_validated_models, select_models
from fdhil.program import Budget, interpret, plan, read_demand_csv
from fdhil.records import Correction, Parameters, Trajectory
from fdhil.report import LEAST_UM, find_common_scale, find_worst_positions, list_planes
from fdhil.store import predict_gain_from_history, read_newest_parameters
from fdhil.web.forecast import forecast_files

MOST_ROWS = 600_000
"""Ten minutes at 1 kHz, which take six seconds and half a gigabyte; the systemd unit allows one."""
MOST_ZONES = 20
NICENESS = 15
LIMITS = {resource.RLIMIT_CPU: 300, resource.RLIMIT_AS: 6 << 30, resource.RLIMIT_FSIZE: 1 << 30}

Tell = Callable[[Mapping[str, Any]], None]


def forecast_program(program: Path, name: str, config: MachineConfig, folder: Path, report_progress: Tell) -> None:
    """Read, predict and correct one program with the newest parameters, and write the result into ``folder``.

    Raises FdhilError if it cannot be judged, OSError if the result cannot be written.
    """
    report_progress({"step": "read"})
    reference = load_reference(program, name, config)
    models, parameters, config = load_newest_models(reference, config)
    report_progress({"step": "correct", "rows": reference.time_s.size})
    planned = correction.plan_correction(reference, models, config)
    predicted = predict_gain_from_history(
        planned, models, config, any(state["revision"] for state in parameters.values())
    )
    document = build_correction_document(name, planned, predicted, models) | {
        "rows": reference.time_s.size,
        "sync_period_s": reference.dt_s,
        "axes": list(reference.table_axes),
        "moved": _compute_travel(reference),
        "planes": list_planes(reference) or _choose_plane(reference),
        "parameters": parameters,
        "has_lines": bool(reference.line.any()),
        "zones": list_zones(planned),
        "zones_in_all": len(planned.before.zones),
        "scale": _compute_colour_scale(planned),
    }
    report_progress({"step": "write"})
    forecast_files.write_forecast(folder, document, planned)


def advise_feeds(
    program: Path, name: str, config: MachineConfig, tolerance_um: float, report_progress: Tell
) -> list[dict[str, Any]]:
    """Return the lines that exceed a tolerance with the feeds that keep it, as in ``fdhil advise --json``."""
    reference = load_reference(program, name, config)
    models, _, config = load_newest_models(reference, config)
    motions = (
        None
        if program.suffix == ".csv"
        else list(interpret(_read_lines(program), Budget.create_from_config(config.nc)))
    )
    trials = itertools.count(1)

    def report_trials(source: FeedScaledPath) -> FeedScaledPath:
        def plan_at(shares: Mapping[int, float]) -> Trajectory:
            report_progress({"step": "advise", "trial": next(trials)})
            return source.at(shares)

        return replace(source, at=plan_at)

    sure, hopeful = make_feed_sources(motions, reference, models, config, tolerance_um)
    found, most = advise_with_correction(
        report_trials(sure), hopeful and report_trials(hopeful), models, config, tolerance_um
    )
    return [build_advice_document(each, most) for each in found]


def load_reference(program: Path, name: str, config: MachineConfig) -> Trajectory:
    """Return the NC's demand. Raises FdhilError if the program is faulty or too long.

    An NC program is read as lines of text, without a folder, so that it cannot open other files.
    """
    if program.suffix == ".csv":
        reference = read_demand_csv(program, config)
        if reference.time_s.size > MOST_ROWS:
            minutes = MOST_ROWS * config.machine.sync_period_s / 60
            text = f"{name} lasts longer than the {minutes:.0f} minutes allowed in the browser"
            raise ProgramError(0, "", f"{text}; use fdhil correct")
        return reference
    return plan(interpret(_read_lines(program), Budget.create_from_config(config.nc)), config, MOST_ROWS)


def _read_lines(program: Path) -> Iterator[str]:
    with program.open(encoding="utf-8", errors="replace", newline="\n") as file:
        yield from file


def load_newest_models(
    reference: Trajectory, config: MachineConfig
) -> tuple[dict[str, Parameters], dict[str, dict[str, Any]], MachineConfig]:
    """Return the model of each axis, its revision and age, and the configuration with its validated regulators.

    The models are the history's newest, else the data sheet's values.
    """
    given = build_nominal_models(config)
    states: dict[str, dict[str, Any]] = {axis: {"revision": 0, "age_s": None} for axis in config.axis}
    newest, source = read_newest_parameters(config.store.directory, config.axis), str(config.store.directory)
    for axis, revision in newest.items():
        states[axis] = {"revision": revision.set.revision, "age_s": round(revision.stamp.compute_age_s(), 1)}
    models, config = load_validated_models({axis: revision.set for axis, revision in newest.items()}, config, source)
    return select_models(reference, given | models, config, source), states, config


def list_zones(planned: Correction) -> list[dict[str, Any]]:
    """Return the largest zones, the worst first; ``place`` numbers those labelled in the map, in path order."""
    before, after = planned.before, planned.after
    reference = before.reference
    numbers = {row: k for k, (_, row) in enumerate(find_worst_positions(before), 1)}
    largest = sorted(before.zones, key=lambda zone: -zone.max_um)
    listed = [zone for k, zone in enumerate(largest) if k < MOST_ZONES or before.find_worst_row(zone) in numbers]
    documents = []
    for zone in listed:
        row = before.find_worst_row(zone)
        documents.append(
            {
                "place": numbers.get(row),
                "row": row,
                "line": int(reference.line[row]),
                "where": zone.where,
                "cause": zone.cause,
                "start_s": zone.start_s,
                "end_s": zone.end_s,
                "feed_mm_min": round(_compute_feed_mm_min(reference, row)),
                "at_mm": [round(float(reference.position_mm[axis][row]), 6) for axis in reference.table_axes],
                "before_um": zone.max_um,
                "after_um": float(after.contour_um[before.get_zone_rows(zone)].max()),
            }
        )
    return documents


def _compute_feed_mm_min(reference: Trajectory, row: int) -> float:
    step = [float(path[row + 1] - path[row]) for path in reference.position_mm.values() if row + 1 < path.size]
    return math.hypot(*step) / reference.dt_s * 60.0


def _compute_colour_scale(planned: Correction) -> dict[str, float | None]:
    largest_um, least_um = find_common_scale([planned.before.contour_um, planned.after.contour_um])
    return {"largest_um": max(largest_um, LEAST_UM), "least_um": least_um}


def _compute_travel(reference: Trajectory) -> dict[str, list[float]]:
    return {axis: [float(path.min()), float(path.max())] for axis, path in reference.position_mm.items()}


def _choose_plane(reference: Trajectory) -> list[tuple[str, str]]:
    moving = max(reference.table_axes, key=lambda axis: float(np.ptp(reference.position_mm[axis])))
    other = next((axis for axis in reference.table_axes if axis != moving), moving)
    return [(moving, other)]


def main() -> None:
    """Answer one request; each output line is a JSON object, the last one is the answer."""
    limit_process(NICENESS, LIMITS)
    request = receive_request()
    program, name = Path(request["program"]), str(request["name"])

    try:
        config = MachineConfig.model_validate(request["config"])
        tolerance_um = request["tolerance_um"]
        if tolerance_um is None:
            forecast_program(
                program,
                name,
                config,
                Path(request["folder"]),
                lambda progress: report_to_parent({"progress": progress}),
            )
        else:
            lines = advise_feeds(
                program, name, config, tolerance_um, lambda progress: report_to_parent({"progress": progress})
            )
            forecast_files.write_advice(Path(request["folder"]), tolerance_um, lines)
    except FdhilError as error:
        line = getattr(error, "line", None)
        report_to_parent(
            {"error": {"code": type(error).__name__, "text": str(error).replace(str(program), name), "line": line}}
        )
    except MemoryError:
        text = f"{name} needs more memory than allowed for the browser; shorten it"
        report_to_parent({"error": {"code": "TooLarge", "text": text}})
    except OSError as error:
        text = f"the result cannot be written ({error.strerror or error}); free disk space"
        report_to_parent({"error": {"code": "DiskFault", "text": text}})


if __name__ == "__main__":
    main()
