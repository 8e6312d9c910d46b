"""``fdhil identify`` with measurements at the table: columns of the recording, or an accelerometer file."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fdhil.cli.main import cli
from fdhil.cli.status_view import describe_model
from studies import bench, real_plant
from studies.real_plant import Mechanics, Sensors
from tests.bench import bench_toml

HERTZ = 60.0
DEMAND_M = bench.make_shuttle_demand(moves=2)
SOFT = Mechanics(resonance_hz=HERTZ)


@cache
def make_signals() -> dict[str, bench.Array]:
    """Return the columns of two rapids of an axis with a compliant screw, including the table position."""
    run = real_plant.simulate_axis(SOFT, DEMAND_M, None, 1e-3)
    reported = real_plant.report_signals(run, SOFT, Sensors(noise=0.001, speed="difference"), 1)
    return {**reported, "table_mm": np.round(1e3 * run.table_m, 4)}


def write_recording(folder: Path, table: bool) -> Path:
    columns = {name: values for name, values in make_signals().items() if table or name != "table_mm"}
    path = folder / "soft.csv"
    path.write_text(bench.format_table(1e-3, columns))
    return path


def print_status(folder: Path, begin_s: float = 4321.0, lead: int = 400) -> Path:
    """Write the data of an ADXL345 at 3200 samples/s in the same run: y opposite to the axis, gravity on z."""
    place = real_plant.simulate_axis(SOFT, DEMAND_M, None, real_plant.STEP_S).table_m
    push = np.gradient(np.gradient(place, real_plant.STEP_S), real_plant.STEP_S)
    push = np.convolve(push, np.ones(10) / 10, "same")[::10]  # every 0.3125 ms
    push = np.concatenate([np.zeros(lead), push, np.zeros(200)])
    rng = np.random.default_rng(2)
    axes = 1e3 * np.column_stack([0 * push + 0.1, -push - 0.2, 0 * push + 9.81]) + 50 * rng.standard_normal(
        (push.size, 3)
    )
    rows = np.column_stack([begin_s + 3.125e-4 * np.arange(push.size), axes])
    path = folder / "adxl345.csv"
    path.write_text(
        "#time,accel_x,accel_y,accel_z\n" + "".join(",".join(f"{v:.6f}" for v in row) + "\n" for row in rows)
    )
    return path


def run_cli(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["identify", *map(str, arguments)], standalone_mode=False)


def load_json_document(result: Result) -> dict[str, Any]:
    (file,) = json.loads(result.stdout)["files"]
    return dict(file)


@pytest.mark.usefixtures("long_computation")
def test_table_encoder_gives_resonance_and_true_error(tmp_path: Path) -> None:
    config = tmp_path / "machine.toml"
    config.write_text(bench_toml("X", resonance_hz=45.0))
    path = write_recording(tmp_path, table=True)
    file = load_json_document(run_cli(path, "--config", config, "--json"))
    for window in file["windows"]:
        found = window["terms"]["resonance"]
        assert found["unit"] == "Hz"
        assert found["value"] == pytest.approx(HERTZ, rel=0.08)
        assert abs(found["value"] - HERTZ) < 3 * found["std"]
        assert {"resonance_damping", "resonance_share"} <= set(window["terms"])
        assert any("ResonanceDiffers: the table resonates at" in text for text in window["warnings"])
        assert window["at_table"]["unseen_rms_um"] > 5.0
        assert window["at_table"]["left_rms_um"] < window["at_table"]["unseen_rms_um"] / 2
    assert file["pooled"]["terms"]["resonance"]["value"] == pytest.approx(HERTZ, rel=0.08)
    shown = " ".join(run_cli(path, "--config", config).stdout.split())
    assert "resonance" in shown
    assert "unseen by the drive's encoder" in shown
    assert "not at 45 Hz as configured" in shown


@pytest.mark.usefixtures("long_computation")
def test_accelerometer_file_is_aligned_with_recording(tmp_path: Path) -> None:
    path = write_recording(tmp_path, table=False)
    file = load_json_document(run_cli(path, "--accelerometer", print_status(tmp_path), "--json"))
    found = [window["terms"]["resonance"] for window in file["windows"] if "resonance" in window["terms"]]
    assert found
    for one in found:
        assert one["value"] == pytest.approx(HERTZ, rel=0.1)
    assert all("at_table" not in window for window in file["windows"])


def test_status_shows_table_error_and_resonance() -> None:
    figures = {"value": 60.0, "std": 1.0, "low": 58.0, "high": 62.0, "unit": "Hz"}
    seen = {
        "error_rms_um": 46.2,
        "error_max_um": 103.0,
        "unseen_rms_um": 21.0,
        "unseen_max_um": 46.0,
        "left_rms_um": 5.0,
    }
    text = describe_model({"terms": {"resonance": figures}, "last_window": {"at_table": seen}, "warnings": []})
    assert "resonance 60" in text
    assert "table error of 46.20 um RMS in the last rapid" in text
    assert "table" not in describe_model({"terms": {}, "last_window": {"at_table": None}})


def test_foreign_accelerometer_file_is_refused(tmp_path: Path) -> None:
    path, other = write_recording(tmp_path, table=False), tmp_path / "other.csv"
    rows = np.random.default_rng(1).standard_normal((4000, 3))
    other.write_text("".join(f"{k * 1e-3:.4f},{a:.3f},{b:.3f},{c:.3f}\n" for k, (a, b, c) in enumerate(rows)))
    file = load_json_document(run_cli(path, "--accelerometer", other, "--json"))
    assert "does not match the moves of the recording" in file["error"]["text"]
    other.write_text("time,x\n1,2\n")
    assert (
        "is not an accelerometer recording"
        in load_json_document(run_cli(path, "--accelerometer", other, "--json"))["error"]["text"]
    )
    result = CliRunner().invoke(cli, ["identify", str(path), str(path), "--accelerometer", str(other)])
    assert "applies to one recording" in str(result.output) + str(result.exception)
