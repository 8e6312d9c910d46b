"""``fdhil identify`` of recordings without voltage, and its model file."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest

from fdhil.prediction.axis_models import load_model_file
from studies import bench
from tests.bench import bench_toml
from tests.cli.test_identify import load_json_document, run_cli
from tests.identification.bench_recordings import simulate_bench_shuttle
from tests.identification.no_voltage_recordings import SCREW, SECTION, format_screw_csv


@pytest.fixture
def recording_without_voltage(tmp_path: Path) -> Path:
    path = tmp_path / "deaf.csv"
    path.write_text(format_screw_csv())
    return path


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(bench_toml("X", **SECTION))
    return path


def test_r_and_l_are_null_k_is_given_and_terms_are_reported(recording_without_voltage: Path) -> None:
    result = run_cli(recording_without_voltage, "--json")
    assert result.return_value == 0
    (reported,) = load_json_document(result)["files"]
    pooled = reported["pooled"]
    assert (pooled["validated"], pooled["windows_used"]) == (True, 4)
    for name in ("R", "L"):
        assert pooled["parameters"][name]["value"] is None
        assert "no voltage" in pooled["parameters"][name]["reason"]
    assert pooled["parameters"]["K"] == {"value": SCREW.K, "std": 0.0, "unit": "N.m/A", "given": True}
    assert pooled["parameters"]["Jt"]["value"] == pytest.approx(SCREW.Jt, rel=0.01)
    assert set(pooled["terms"]["load"]) == {"value", "std", "unit"}
    assert pooled["terms"]["load"]["unit"] == "N.m"
    for window in reported["windows"]:
        assert window["validated"] is True
        assert window["fit_percent"] is None
        assert {"terms", "unexplained_um", "warnings"} <= set(window)
    shown = run_cli(recording_without_voltage).stdout
    assert "(given)" in shown
    assert "terms of all: load -0.0" in shown


def test_config_provides_missing_parameters(recording_without_voltage: Path, machine: Path) -> None:
    text = recording_without_voltage.read_text()
    recording_without_voltage.write_text(
        "".join(x for x in text.splitlines(keepends=True) if "torque_constant" not in x)
    )
    alone = run_cli(recording_without_voltage, "--json")
    assert alone.return_value == 1
    assert "torque_constant_nm_per_a" in run_cli(recording_without_voltage).stdout
    reported = load_json_document(run_cli(recording_without_voltage, "--json", "--config", machine))["files"][0][
        "pooled"
    ]["parameters"]
    assert reported["K"]["value"] == 0.33
    assert reported["R"]["value"] is None
    assert reported["Jt"]["value"] == pytest.approx(SCREW.Jt * 0.33 / SCREW.K, rel=0.01)


def test_predict_reads_written_model_file(recording_without_voltage: Path, machine: Path, tmp_path: Path) -> None:
    out = tmp_path / "model.json"
    without = run_cli(recording_without_voltage, "--write-model", out).exception
    assert isinstance(without, click.UsageError)
    assert "R and L of axis X" in str(without)
    assert not out.exists()
    assert run_cli(recording_without_voltage, "--config", machine, "--write-model", out).return_value == 0
    written = json.loads(out.read_text())["X"]
    assert (written["R"], written["L"], written["K"]) == (0.6, 0.003, SCREW.K)
    assert written["Cd"] == pytest.approx(SCREW.Cd, rel=0.06)
    assert set(written["terms"]) >= {"load"}


def test_model_file_needs_complete_validated_parameters(tmp_path: Path) -> None:
    recording, out = tmp_path / "shuttle.csv", tmp_path / "model.json"
    recording.write_text(
        bench.format_as_csv(
            bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=0.02, speed=0.1)), 0.003
        )
    )
    refused = run_cli(recording, "--write-model", out)
    assert refused.return_value == 1
    assert "is not written" in refused.stderr
    assert not out.exists()
    recording.write_text(bench.format_as_csv(simulate_bench_shuttle(moves=2), 0.003))
    assert run_cli(recording, "--write-model", out).return_value == 0
    assert load_model_file(out).parameters["X"].Jt == pytest.approx(0.075, rel=0.01)
