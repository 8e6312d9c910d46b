"""Examines machines of the zoo: what fdhil identifies, what it says of a correction, and what the table gets."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from fdhil.cli.main import cli
from fdhil.errors import FdhilError
from studies.zoo import peers
from studies.zoo.files import (
    locate_table_m,
    report_signals,
    simulate_cut,
    write_configuration,
    write_demand,
    write_recording,
)
from studies.zoo.machines import KINDS, Axis, Kind, machine
from studies.zoo.nc import make_path, measure_distance_um
from studies.zoo.plant import Array

NOTHING = {"gain": None, "refused": ["NoModel"]}


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the results of every machine, by kind and seed."""
    chosen = [kind for kind in KINDS if options.kind in kind.name]
    tasks = [(kind, options.seed + k) for kind in chosen for k in range(options.draws)]
    done = []
    with ProcessPoolExecutor(options.processes) as executor:
        for found in executor.map(examine_machine, *zip(*tasks, strict=True)):
            done.append(found)
            print(f"{len(done)} of {len(tasks)}: {found['kind']}", flush=True)
    return done


def examine_machine(kind: Kind, seed: int) -> dict[str, Any]:
    """Return the results of fdhil and the other methods for one machine."""
    axes = machine(kind, seed)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        columns = write_machine(place, axes, seed)
        identified = _run_command(
            "identify", *(f"{place}/{name}.csv" for name in axes),
            "--config", f"{place}/machine.toml", "--write-model", f"{place}/model.json",
        )  # fmt: skip
        files = {document["axis"]: document for document in identified["files"]}
        found = {name: _examine_axis(files[name], axis, columns[name]) for name, axis in axes.items()}
        accepted = all(axis["pool"] for axis in found.values())
        corrected = _assess_correction(place, axes, place / "model.json") if accepted else dict(NOTHING)
        all_the_same = None
        if corrected["refused"] and (model := _build_refused_model(files, axes)) is not None:
            (place / "refused.json").write_text(json.dumps(model), "utf-8")
            all_the_same = _assess_correction(place, axes, place / "refused.json")
    return {"kind": kind.name, "seed": seed, "axes": found, "correction": corrected, "with_refused": all_the_same}


def write_machine(place: Path, axes: Mapping[str, Axis], seed: int) -> dict[str, dict[str, Array]]:
    """Write all files of a machine; return the columns of its recordings by axis."""
    kind = next(iter(axes.values())).kind
    write_configuration(place / "machine.toml", axes)
    write_demand(place / "demand.csv", make_path(kind.rapids.feed, kind.period_s), kind.period_s)
    columns = {}
    for k, (name, axis) in enumerate(axes.items()):
        columns[name] = report_signals(axis, kind.rapids.train(kind.period_s), 10 * seed + k)
        write_recording(place / f"{name}.csv", name, axis, columns[name])
    return columns


def _run_command(*words: str) -> dict[str, Any]:
    """Return the JSON document that a command of fdhil answers with."""
    answer = CliRunner().invoke(cli, [*words, "--json"])
    if isinstance(answer.exception, FdhilError):
        return {"error": {"class": type(answer.exception).__name__, "text": str(answer.exception)}}
    document: dict[str, Any] = json.loads(answer.stdout)
    return document


def _examine_axis(document: Mapping[str, Any], axis: Axis, columns: Mapping[str, Array]) -> dict[str, Any]:
    """Return the results of one axis: windows, errors of the pool, errors of the other methods."""
    truth, windows, pooled = axis.truth(), document["windows"], document["pooled"]
    accepted = [window for window in windows if window["validated"]]
    return {
        "moves": 2 * len(axis.kind.rapids.lengths),
        "windows": len(windows),
        "believed": len(accepted),
        "pool": pooled["validated"],
        "errors": _compute_errors(pooled["parameters"], truth),
        "window_errors": [_compute_errors(window["parameters"], truth) for window in accepted],
        "reasons": _count_codes([r for window in windows for r in window["reasons"]]),
        "pool_reasons": [] if pooled["validated"] else _count_codes(pooled["reasons"]),
        "unexplained_um": pooled["unexplained_um"],
        "peers": {name: _assess_peer(method, axis, columns) for name, method in peers.installed().items()},
    }


def _compute_errors(parameters: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, tuple[float, float] | None]:
    """Return per parameter the error as a share of the truth, and in standard deviations."""
    found: dict[str, tuple[float, float] | None] = {}
    for name, true in truth.items():
        value, std = parameters[name].get("value"), parameters[name].get("std")
        found[name] = None if value is None or not std else ((value - true) / true, (value - true) / std)
    return found


def _count_codes(reasons: Sequence[str]) -> list[str]:
    """Return the codes of reasons, the most frequent first."""
    return [f"{count} {code}" for code, count in Counter(r.split(":")[0] for r in reasons).most_common(3)]


def _assess_peer(method: Any, axis: Axis, columns: Mapping[str, Array]) -> dict[str, float | None]:
    """Return the errors of another method as shares of the truth; None where it gives up."""
    try:
        with np.errstate(all="ignore"):
            found = method(columns, axis.kind.period_s)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return dict.fromkeys(peers.NAMES)
    return {name: (found[name] - true) / true for name, true in axis.truth().items()}


def _assess_correction(place: Path, axes: Mapping[str, Axis], model: Path) -> dict[str, Any]:
    """Return the result of ``correct`` for the program, and the error at the machine's table."""
    kind = next(iter(axes.values())).kind
    planned = _run_command("correct", f"{place}/demand.csv", "--config", f"{place}/machine.toml", "--model", str(model),
                     "--out", f"{place}/offsets.csv")  # fmt: skip
    if "error" in planned:
        return {"gain": None, "refused": [planned["error"]["class"]]}
    rows = np.genfromtxt(place / "offsets.csv", delimiter=",", names=True)
    offsets = {name: rows[f"{name}_offset_um"] for name in axes}
    wanted = make_path(kind.rapids.feed, kind.period_s)
    before, after = (
        measure_distance_um(wanted, locate_table_m(axes, simulate_cut(axes, wanted, each)), kind.period_s)
        for each in (None, offsets)
    )
    return {
        "gain": planned["gain"],
        "said": [planned["before"]["rms_um"], planned["after"]["rms_um"]],
        "got": [compute_rms(before), compute_rms(after)],
        "worse_um": float((after - before).max()),
        "refused": [reason["code"] for reason in planned["refused"]],
    }


def compute_rms(values: Array) -> float:
    """Return the root of the mean square."""
    return math.sqrt(float(np.mean(np.square(values))))


def _build_refused_model(files: Mapping[str, Any], axes: Mapping[str, Axis]) -> dict[str, Any] | None:
    """Return the model that was refused: of each axis the median of its windows, where they have values."""
    model = {}
    for name in axes:
        windows = [window["parameters"] for window in files[name]["windows"]]
        values = {key: [w[key]["value"] for w in windows if w[key].get("value") is not None] for key in peers.NAMES}
        if not all(values.values()):
            return None
        model[name] = {key: max(float(np.median(each)), 1e-6) for key, each in values.items()}
    return model
