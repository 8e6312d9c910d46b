"""The loops by which a model was validated are in its file: a correction planned with it helps the real drive."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fdhil.cli.main import cli
from fdhil.prediction.contour import contour_error_um
from fdhil.program import write_demand_csv
from fdhil.records import Float
from studies import real_plant as real
from tests.bench import bench_toml
from tests.identification.test_loops import shuttle
from tests.paths import bench_trajectory, rms

MECHANICS, LOOPS = real.Mechanics(), real.Loops(speed_filter_s=0.002)
WORSE_UM = 1.0


def invoke(*arguments: str | Path) -> Result:
    """Run a command of ``fdhil``."""
    return CliRunner().invoke(cli, list(map(str, arguments)))


@dataclass(frozen=True)
class Shop:
    """A bench whose drives filter their speed over 2 ms: folder, recording, configuration, and the model written."""

    folder: Path
    recording: Path
    config: Path
    model: Path


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Shop:
    """Identify the drive once and write its model file."""
    folder = tmp_path_factory.mktemp("filtered")
    shop = Shop(folder, folder / "filtered.csv", folder / "bench.toml", folder / "model.json")
    run = real.run(MECHANICS, shuttle(2, 0.25, 0.5), LOOPS)
    shop.recording.write_text(real.as_csv(run, MECHANICS, real.Sensors(), 0.5))
    shop.config.write_text(bench_toml())
    result = invoke("identify", shop.recording, "--config", shop.config, "--write-model", shop.model)
    assert result.exit_code == 0, result.output
    return shop


def test_model_file_holds_the_loops_it_was_validated_with(shop: Shop) -> None:
    loops = json.loads(shop.model.read_text())["X"]["loops"]
    assert loops["speed_filter_s"] == pytest.approx(LOOPS.speed_filter_s, rel=0.03)
    assert all(isinstance(value, float) for value in loops.values())


def test_correction_with_the_model_file_makes_no_place_of_the_real_path_worse(shop: Shop) -> None:
    model = json.loads(shop.model.read_text())
    shop.model.with_name("both.json").write_text(json.dumps({"X": model["X"], "Y": model["X"]}))
    reference = bench_trajectory(10)
    write_demand_csv(reference, shop.folder / "demand.csv")
    arguments = ["--config", shop.config, "--model", shop.folder / "both.json", "--out", shop.folder / "out.csv"]
    result = invoke("correct", shop.folder / "demand.csv", *arguments)
    assert result.exit_code == 0, result.output
    with (shop.folder / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    demand = np.column_stack([reference.position_mm[axis] for axis in "XY"])
    offset = np.column_stack([[float(row[f"{axis}_offset_um"]) / 1e3 for row in rows] for axis in "XY"])
    before, after = (contour_error_um(demand, _table_mm(order), reference.dt_s) for order in (demand, demand + offset))
    assert rms(before) > 30.0
    assert rms(after) < 0.5
    assert (after - before).max() < WORSE_UM


def _table_mm(order_mm: Float) -> Float:
    """Return where the real table goes (n, 2)."""
    return np.column_stack([real.run(MECHANICS, column / 1e3, LOOPS).table_m * 1e3 for column in order_mm.T])
