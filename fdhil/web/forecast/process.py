"""Forecasts a program that came from a browser: its path error without and with the correction, or feeds for it.

A process of its own (``python -m fdhil.web.forecast.process``, one JSON request on stdin), at low priority and with
bounded time, memory and disk: whatever the program is, neither the daemon nor the pages wait for it. It reads the
history and writes into the folder that it is given; nothing is sent to any machine.
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
from fdhil.bounded_process import limit_process, receive_request, report
from fdhil.config import MachineConfig
from fdhil.correction.result_documents import advised, correction_document, entry, sources
from fdhil.errors import FdhilError, ProgramError
from fdhil.prediction.feed_search import Source
from fdhil.prediction.models import models_for, nominal_models, validated_models
from fdhil.program import Budget, interpret, planner
from fdhil.program.demand_csv import read_demand_csv
from fdhil.records import Correction, Parameters, Trajectory
from fdhil.report.figures import LEAST_UM, common_scale
from fdhil.report.path import planes, worst_places
from fdhil.store.known_gain import known_gain
from fdhil.store.newest_sets import read_newest_sets
from fdhil.web.forecast import kept

MOST_ROWS = 600_000
"""Ten minutes at 1 kHz: they take six seconds and half a gigabyte; the unit of the pages has one."""
MOST_ZONES = 20
NICENESS = 15
LIMITS = {resource.RLIMIT_CPU: 300, resource.RLIMIT_AS: 6 << 30, resource.RLIMIT_FSIZE: 1 << 30}

Tell = Callable[[Mapping[str, Any]], None]


def forecast(program: Path, name: str, config: MachineConfig, folder: Path, tell: Tell) -> None:
    """Read, predict and correct one program with the newest parameters, and leave the result in ``folder``.

    FdhilError where it cannot be judged; OSError where the result cannot be written.
    """
    tell({"step": "read"})
    reference = load(program, name, config)
    models, parameters, config = newest_models(reference, config)
    tell({"step": "correct", "rows": reference.time_s.size})
    planned = correction.plan(reference, models, config)
    predicted = known_gain(planned, models, config, any(told["revision"] for told in parameters.values()))
    document = correction_document(name, planned, predicted, models) | {
        "rows": reference.time_s.size,
        "sync_period_s": reference.dt_s,
        "axes": list(reference.table_axes),
        "moved": _reach(reference),
        "planes": planes(reference) or _single(reference),
        "parameters": parameters,
        "has_lines": bool(reference.line.any()),
        "zones": zones(planned),
        "zones_in_all": len(planned.before.zones),
        "scale": _scale(planned),
    }
    tell({"step": "write"})
    kept.write(folder, document, planned)


def advice(program: Path, name: str, config: MachineConfig, tolerance_um: float, tell: Tell) -> list[dict[str, Any]]:
    """Return the lines that leave a tolerance, with the feeds that keep it, as ``fdhil advise --json`` has them."""
    reference = load(program, name, config)
    models, _, config = newest_models(reference, config)
    motions = None if program.suffix == ".csv" else list(interpret(_lines(program), Budget.of(config.nc)))
    trials = itertools.count(1)

    def telling(source: Source) -> Source:
        def at(shares: Mapping[int, float]) -> Trajectory:
            tell({"step": "advise", "trial": next(trials)})
            return source.at(shares)

        return replace(source, at=at)

    sure, hopeful = sources(motions, reference, models, config, tolerance_um)
    found, most = advised(telling(sure), hopeful and telling(hopeful), models, config, tolerance_um)
    return [entry(each, most) for each in found]


def load(program: Path, name: str, config: MachineConfig) -> Trajectory:
    """Return what the NC will order; FdhilError for a program that is faulty or too long.

    An NC program is read as lines of text, by which it has no folder: no word in it opens another file.
    """
    if program.suffix == ".csv":
        reference = read_demand_csv(program, config)
        if reference.time_s.size > MOST_ROWS:
            minutes = MOST_ROWS * config.machine.sync_period_s / 60
            text = f"{name} lasts longer than the {minutes:.0f} minutes that are judged in a browser"
            raise ProgramError(0, "", f"{text}; use fdhil correct")
        return reference
    return planner.plan(interpret(_lines(program), Budget.of(config.nc)), config, MOST_ROWS)


def _lines(program: Path) -> Iterator[str]:
    with program.open(encoding="utf-8", errors="replace", newline="\n") as file:
        yield from file


def newest_models(
    reference: Trajectory, config: MachineConfig
) -> tuple[dict[str, Parameters], dict[str, dict[str, Any]], MachineConfig]:
    """Return the model of each axis, what is known of it, and the configuration with the loops it was validated with.

    The models are the history's newest, else the data sheet's values.
    """
    given = nominal_models(config)
    told: dict[str, dict[str, Any]] = {axis: {"revision": 0, "age_s": None} for axis in config.axis}
    newest, source = read_newest_sets(config.store.directory, config.axis), str(config.store.directory)
    for axis, revision in newest.items():
        told[axis] = {"revision": revision.set.revision, "age_s": round(revision.stamp.age_s(), 1)}
    models, config = validated_models({axis: revision.set for axis, revision in newest.items()}, config, source)
    return models_for(reference, given | models, config, source), told, config


def zones(planned: Correction) -> list[dict[str, Any]]:
    """Return the largest zones, the worst first; ``place`` numbers those that the map names, in the path's order."""
    before, after = planned.before, planned.after
    reference = before.reference
    numbers = {row: k for k, (_, row) in enumerate(worst_places(before), 1)}
    largest = sorted(before.zones, key=lambda zone: -zone.max_um)
    listed = [zone for k, zone in enumerate(largest) if k < MOST_ZONES or before.worst_row(zone) in numbers]
    told = []
    for zone in listed:
        row = before.worst_row(zone)
        told.append(
            {
                "place": numbers.get(row),
                "row": row,
                "line": int(reference.line[row]),
                "where": zone.where,
                "cause": zone.cause,
                "start_s": zone.start_s,
                "end_s": zone.end_s,
                "feed_mm_min": round(_feed_mm_min(reference, row)),
                "at_mm": [round(float(reference.position_mm[axis][row]), 6) for axis in reference.table_axes],
                "before_um": zone.max_um,
                "after_um": float(after.contour_um[before.rows(zone)].max()),
            }
        )
    return told


def _feed_mm_min(reference: Trajectory, row: int) -> float:
    step = [float(path[row + 1] - path[row]) for path in reference.position_mm.values() if row + 1 < path.size]
    return math.hypot(*step) / reference.dt_s * 60.0


def _scale(planned: Correction) -> dict[str, float | None]:
    """Return one scale of colours for both; ``least_um`` where it is logarithmic."""
    largest_um, least_um = common_scale([planned.before.contour_um, planned.after.contour_um])
    return {"largest_um": max(largest_um, LEAST_UM), "least_um": least_um}


def _reach(reference: Trajectory) -> dict[str, list[float]]:
    return {axis: [float(path.min()), float(path.max())] for axis, path in reference.position_mm.items()}


def _single(reference: Trajectory) -> list[tuple[str, str]]:
    """Return the plane of a path in which at most one axis moves."""
    moving = max(reference.table_axes, key=lambda axis: float(np.ptp(reference.position_mm[axis])))
    other = next((axis for axis in reference.table_axes if axis != moving), moving)
    return [(moving, other)]


def main() -> None:
    """Answer the one request; each line that is written is a JSON object, the last one is the answer."""
    limit_process(NICENESS, LIMITS)
    request = receive_request()
    program, name = Path(request["program"]), str(request["name"])

    try:
        config = MachineConfig.model_validate(request["config"])
        tolerance_um = request["tolerance_um"]
        if tolerance_um is None:
            forecast(program, name, config, Path(request["folder"]), lambda told: report({"progress": told}))
        else:
            lines = advice(program, name, config, tolerance_um, lambda told: report({"progress": told}))
            kept.write_advice(Path(request["folder"]), tolerance_um, lines)
    except FdhilError as error:
        line = getattr(error, "line", None)
        report({"error": {"code": type(error).__name__, "text": str(error).replace(str(program), name), "line": line}})
    except MemoryError:
        text = f"{name} takes more memory than a browser's program may; cut it"
        report({"error": {"code": "TooLarge", "text": text}})
    except OSError as error:
        text = f"the result cannot be written ({error.strerror or error}); free the disk"
        report({"error": {"code": "DiskFault", "text": text}})


if __name__ == "__main__":
    main()
