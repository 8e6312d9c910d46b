"""``fdhil identify`` of recordings without voltage, and its model file."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest

from fdhil.prediction.axis_models import load_model_file
from studies import bench
from tests.bench import bench_toml
from tests.cli.test_identify import invoke, told_document
from tests.identification.bench_recordings import simulate_bench_shuttle
from tests.identification.no_voltage_recordings import SCREW, SECTION, format_screw_csv


@pytest.fixture
def deaf(tmp_path: Path) -> Path:
    path = tmp_path / "deaf.csv"
    path.write_text(format_screw_csv())
    return path


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(bench_toml("X", **SECTION))
    return path


def test_r_and_l_are_null_k_is_given_and_terms_are_told(deaf: Path) -> None:
    result = invoke(deaf, "--json")
    assert result.return_value == 0
    (told,) = told_document(result)["files"]
    pooled = told["pooled"]
    assert (pooled["validated"], pooled["windows_used"]) == (True, 4)
    for name in ("R", "L"):
        assert pooled["parameters"][name]["value"] is None
        assert "no voltage" in pooled["parameters"][name]["reason"]
    assert pooled["parameters"]["K"] == {"value": SCREW.K, "std": 0.0, "unit": "N.m/A", "given": True}
    assert pooled["parameters"]["Jt"]["value"] == pytest.approx(SCREW.Jt, rel=0.01)
    assert set(pooled["terms"]["load"]) == {"value", "std", "unit"}
    assert pooled["terms"]["load"]["unit"] == "N.m"
    for window in told["windows"]:
        assert window["validated"] is True
        assert window["fit_percent"] is None
        assert {"terms", "unexplained_um", "warnings"} <= set(window)
    shown = invoke(deaf).stdout
    assert "(given)" in shown
    assert "terms of all: load -0.0" in shown


def test_the_config_gives_what_the_recording_does_not(deaf: Path, machine: Path) -> None:
    text = deaf.read_text()
    deaf.write_text("".join(x for x in text.splitlines(keepends=True) if "torque_constant" not in x))
    alone = invoke(deaf, "--json")
    assert alone.return_value == 1
    assert "torque_constant_nm_per_a" in invoke(deaf).stdout
    told = told_document(invoke(deaf, "--json", "--config", machine))["files"][0]["pooled"]["parameters"]
    assert told["K"]["value"] == 0.33
    assert told["R"]["value"] is None
    assert told["Jt"]["value"] == pytest.approx(SCREW.Jt * 0.33 / SCREW.K, rel=0.01)


def test_a_model_file_is_written_that_predict_reads(deaf: Path, machine: Path, tmp_path: Path) -> None:
    out = tmp_path / "model.json"
    without = invoke(deaf, "--write-model", out).exception
    assert isinstance(without, click.UsageError)
    assert "R and L of axis X" in str(without)
    assert not out.exists()
    assert invoke(deaf, "--config", machine, "--write-model", out).return_value == 0
    written = json.loads(out.read_text())["X"]
    assert (written["R"], written["L"], written["K"]) == (0.6, 0.003, SCREW.K)
    assert written["Cd"] == pytest.approx(SCREW.Cd, rel=0.06)
    assert set(written["terms"]) >= {"load"}


def test_a_whole_model_needs_no_config_and_none_is_written_without_a_validated_pool(tmp_path: Path) -> None:
    recording, out = tmp_path / "shuttle.csv", tmp_path / "model.json"
    recording.write_text(
        bench.format_as_csv(
            bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=0.02, speed=0.1)), 0.003
        )
    )
    refused = invoke(recording, "--write-model", out)
    assert refused.return_value == 1
    assert "is not written" in refused.stderr
    assert not out.exists()
    recording.write_text(bench.format_as_csv(simulate_bench_shuttle(moves=2), 0.003))
    assert invoke(recording, "--write-model", out).return_value == 0
    assert load_model_file(out).parameters["X"].Jt == pytest.approx(0.075, rel=0.01)
