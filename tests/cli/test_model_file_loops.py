"""A correction planned with the loops of a model file improves the real drive."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fdhil import config as configuration
from fdhil.cli.main import cli
from fdhil.prediction.axis_models import load_model_file
from fdhil.prediction.contour_error import compute_contour_error_um
from fdhil.program import write_demand_csv
from fdhil.records import Float
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from studies import real_plant as real
from tests.bench import bench_toml
from tests.cli.test_predict import run_cli as run
from tests.identification.test_loop_identification import build_shuttle_demand
from tests.paths import build_bench_trajectory, compute_rms
from tests.store.sample_records import make_published

MECHANICS, LOOPS = real.Mechanics(), real.Loops(speed_filter_s=0.002)
WORSE_UM = 1.0


def run_cli(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, list(map(str, arguments)))


@dataclass(frozen=True)
class Recordings:
    """A bench whose drives filter their speed over 2 ms."""

    folder: Path
    recording: Path
    config: Path
    model: Path


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory, long_computation: None) -> Recordings:
    folder = tmp_path_factory.mktemp("filtered")
    shop = Recordings(folder, folder / "filtered.csv", folder / "bench.toml", folder / "model.json")
    run = real.simulate_axis(MECHANICS, build_shuttle_demand(2, 0.25, 0.5), LOOPS)
    shop.recording.write_text(real.format_as_csv(run, MECHANICS, real.Sensors(), 0.5))
    shop.config.write_text(bench_toml())
    result = run_cli("identify", shop.recording, "--config", shop.config, "--write-model", shop.model)
    assert result.exit_code == 0, result.output
    return shop


def test_model_file_has_validated_loops(recordings: Recordings) -> None:
    loops = json.loads(recordings.model.read_text())["X"]["loops"]
    assert loops["speed_filter_s"] == pytest.approx(LOOPS.speed_filter_s, rel=0.03)
    assert all(isinstance(value, float) for value in loops.values())


def test_correction_with_model_file_worsens_no_location(recordings: Recordings) -> None:
    model = json.loads(recordings.model.read_text())
    both = recordings.folder / "both.json"
    both.write_text(json.dumps({"X": model["X"], "Y": model["X"]}))
    assert_corrected(recordings, "--model", both)


def test_correction_from_history_uses_published_loops(recordings: Recordings) -> None:
    config = configuration.load_config(recordings.config)
    model = load_model_file(recordings.model)
    found = replace(make_published(1, "X", model.parameters["X"]), config_digest=config.digest, loops=model.loops["X"])
    with History.open(config.store.directory) as history:
        for axis in "XY":
            history.add_revision(replace(found, axis=axis), [], TimeStamp.now())
    assert_corrected(recordings, "--from-history")
    older = {
        axis: {k: v for k, v in json.loads(recordings.model.read_text())["X"].items() if k != "loops"} for axis in "XY"
    }
    path = recordings.folder / "older.json"
    path.write_text(json.dumps(older))
    refused = run("correct", recordings.folder / "demand.csv", "--config", recordings.config, "--model", path)
    assert refused.exit_code == 2
    assert "X.loops: LoopsDiffer: is missing" in refused.stderr
    assert "speed_filter_s 0.002" in refused.stderr
    path.write_text(json.dumps({axis: model | {"loops": {}} for axis, model in older.items()}))  # declared as correct
    assert (
        run("predict", recordings.folder / "demand.csv", "--config", recordings.config, "--model", path).exit_code == 0
    )


def test_model_without_config_warns_of_unconfirmed_loops(recordings: Recordings) -> None:
    path = recordings.folder / "alone.json"
    result = run_cli("identify", recordings.recording, "--write-model", path)
    assert "loops" not in json.loads(path.read_text())["X"]
    assert "has no loops of axis X: predict and correct will use the configured regulators" in result.stderr


def assert_corrected(shop: Recordings, *source: str | Path) -> None:
    """Plan a correction of the bench path with a model, and simulate the real drives with it."""
    reference, out = build_bench_trajectory(10), shop.folder / "out.csv"
    write_demand_csv(reference, shop.folder / "demand.csv")
    result = run_cli("correct", shop.folder / "demand.csv", "--config", shop.config, "--out", out, *source)
    assert result.exit_code == 0, result.output
    with out.open() as file:
        rows = list(csv.DictReader(file))
    demand = np.column_stack([reference.position_mm[axis] for axis in "XY"])
    offset = np.column_stack([[float(row[f"{axis}_offset_um"]) / 1e3 for row in rows] for axis in "XY"])
    before, after = (
        compute_contour_error_um(demand, simulate_table_mm(order), reference.dt_s)
        for order in (demand, demand + offset)
    )
    assert compute_rms(before) > 30.0
    assert compute_rms(after) < 0.5
    assert (after - before).max() < WORSE_UM


def simulate_table_mm(order_mm: Float) -> Float:
    return np.column_stack([real.simulate_axis(MECHANICS, column / 1e3, LOOPS).table_m * 1e3 for column in order_mm.T])
