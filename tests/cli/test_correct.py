"""``fdhil correct`` as called by another program."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from fdhil.program import write_demand_csv
from fdhil.records import Skill
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from tests.cli.test_predict import _bench as _bench
from tests.cli.test_predict import run_cli, store_parameters
from tests.paths import build_bench_trajectory, build_trajectory, smooth_demand


def write_one_corner(folder: Path) -> Path:
    """A demand with one corner and a rest, for a small page."""
    ramp = np.linspace(0.0, 30.0, 180)
    corner = np.column_stack(
        [np.append(ramp, np.full(480, 30.0)), np.concatenate([np.zeros(180), ramp, np.full(300, 30.0)])]
    )
    path = folder / "corner.csv"
    write_demand_csv(build_trajectory(smooth_demand(corner, (0.060, 0.030), 0.001)), path)
    return path


def test_correct_writes_json_and_csv(bench: Path) -> None:
    out = bench / "out.csv"
    arguments = ["--config", bench / "bench.toml", "--method", "mirror", "--json", "--out", out]
    result = run_cli("correct", bench / "demand.csv", *arguments)
    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert document["refused"] == []
    assert document["gain"] == pytest.approx(document["before"]["rms_um"] / document["after"]["rms_um"])
    with out.open() as file:
        rows = list(csv.DictReader(file))
    corrected = np.array([float(row["corrected_contour_error_um"]) for row in rows])
    assert np.sqrt(np.mean(corrected**2)) == pytest.approx(document["after"]["rms_um"], rel=1e-3)
    increments = np.array([float(row["X_offset_um"]) for row in rows]) * 65536 / 20e3
    assert np.allclose(increments, np.rint(increments), atol=1e-3)
    assert {"Y_offset_um", "X_corrected_error_um", "Y_corrected_error_um", "contour_error_um"} <= set(rows[0])


def test_refused_correction_writes_zeros_and_exits_1(bench: Path) -> None:
    write_demand_csv(build_bench_trajectory(20, (0.030, 0.015)), bench / "fast.csv")
    out = bench / "out.csv"
    result = run_cli("correct", bench / "fast.csv", "--config", bench / "bench.toml", "--json", "--out", out)
    assert result.exit_code == 1
    refused = json.loads(result.stdout)["refused"]
    assert {entry["code"] for entry in refused} == {"DemandTooHigh"}
    assert all(entry["text"] and entry["advice"] for entry in refused)
    with out.open() as file:
        assert all(float(row["X_offset_um"]) == float(row["Y_offset_um"]) == 0.0 for row in csv.DictReader(file))


def test_correct_prints_text(bench: Path) -> None:
    """A gain without an independent check is not called better."""
    result = run_cli("correct", bench / "demand.csv", "--config", bench / "bench.toml", "--method", "mirror")
    assert result.exit_code == 0
    assert "predicted with the mirror correction: " in result.stdout
    assert "by the model alone; its accuracy on this machine is unknown" in result.stdout
    assert "times better" not in result.stdout


@pytest.mark.usefixtures("long_computation")
def test_gain_from_history_has_nonzero_uncertainty(bench: Path) -> None:
    """With parameters known to 1e-6 the gain is limited by the prediction error of held-out moves."""
    store_parameters(bench, [{}], known_to=1e-6)
    with History.open(bench / "fdhil-data") as history:
        for axis in "XY":
            history.add_skill(Skill(axis, 1, 0.4, 1.0, 0.0, 30.0), TimeStamp(0.0, "boot", 0))
    arguments = ["correct", bench / "demand.csv", "--config", bench / "bench.toml", "--from-history"]
    text = run_cli(*arguments).stdout
    assert re.search(
        r"predicted with the inverse correction: at most \d\.\d\d um RMS \(95 %\), \d\.\d\d by the model; .*"
        r" at least \d+\.\d times better",
        text,
    )
    document = json.loads(run_cli(*arguments, "--json").stdout)
    assert document["after"]["uncertainty_um"] == pytest.approx(0.4 * 2**0.5, rel=1e-3)
    assert 1 < document["gain_at_least"] < document["gain"]
    page = bench / "correct.html"
    assert run_cli("correct", write_one_corner(bench), *arguments[2:], "--report", page).exit_code == 0
    assert "predicted smaller by at least" in page.read_text("utf-8")
    text = run_cli("predict", *arguments[1:]).stdout
    assert "± <0.1 um" in text
    assert "± 0.0" not in text


def test_unknown_method_is_refused(bench: Path) -> None:
    result = run_cli("correct", bench / "demand.csv", "--config", bench / "bench.toml", "--method", "magic")
    assert result.exit_code == 2
    assert "mirror" in result.stderr


def test_flatness_writes_speed_and_torque(bench: Path) -> None:
    out = bench / "out.csv"
    arguments = ["--config", bench / "bench.toml", "--method", "flatness", "--json", "--out", out]
    result = run_cli("correct", bench / "demand.csv", *arguments)
    assert result.exit_code == 0
    assert json.loads(result.stdout)["gain"] > 50
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert all(float(row["X_offset_um"]) == 0.0 for row in rows)
    assert max(float(row["Y_torque_offset_Nm"]) for row in rows) > 50
    assert "X_speed_offset_rad_per_s" in rows[0]


def test_default_method_is_the_best(bench: Path) -> None:
    result = run_cli("correct", bench / "demand.csv", "--config", bench / "bench.toml", "--json")
    document = json.loads(result.stdout)
    assert document["method"] == "inverse"
    assert document["gain"] > 60
    assert document["delay_s"] == 0.0


@pytest.mark.usefixtures("long_computation")
def test_report_shows_errors_before_and_after_correction(bench: Path) -> None:
    for command, shown in (("predict", "predicted, RMS"), ("correct", "not known here")):
        page = bench / f"{command}.html"
        arguments = [command, write_one_corner(bench), "--config", bench / "bench.toml", "--report", page]
        assert run_cli(*arguments).exit_code == 0
        assert shown in page.read_text("utf-8")
        assert "with the nominal parameters of the configuration" in page.read_text("utf-8")
    missing = bench / "demand.csv" / "page.html"
    refused = run_cli("predict", bench / "demand.csv", "--config", bench / "bench.toml", "--report", missing)
    assert refused.exit_code == 3
    assert "cannot be written" in refused.stderr
