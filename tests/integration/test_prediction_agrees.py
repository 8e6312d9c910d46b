"""The predictor and the simulator's physics are independent code; on the bench path they must agree.

The simulator runs behind its own NC and CiA 402 drive, two cycles late and in whole increments; the predictor has
neither.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.prediction import predict_path
from fdhil.program import load_trajectory
from fdhil.records import Float, Parameters
from tests.bench import bench_document
from tests.sim.bench_simulator import SteppedSimulator

pytestmark = pytest.mark.usefixtures("long_computation")

PROGRAMS = Path(__file__).parents[2] / "configs" / "programs"
PLANTS: dict[str, dict[str, dict[str, float]]] = {
    "bench": {"X": {}, "Y": {}},
    "drifted": {"X": {"ft": 0.01, "Cd": 1.0, "Jt": 0.085}, "Y": {"R": 0.53, "L": 0.0046, "K": 0.83}},
}


def machine(feedforward: float, plant: dict[str, dict[str, float]]) -> MachineConfig:
    document = bench_document()
    for axis in document["axis"].values():
        axis["regulators"]["speed_feedforward"] = feedforward
    quiet = {"voltage_v": 0.0, "current_a": 0.0, "speed_rad_s": 0.0}
    document["sim"] = {"noise": quiet, "modbus": False, "axis": plant}
    return machine_config.parse_config(document)


def table(config: MachineConfig, program: Path, folder: Path) -> Float:
    reference = load_trajectory(program, config)
    twin = SteppedSimulator(config)
    twin.switch_on()
    twin.machine.record_next_file(folder / "trace.csv")
    twin.machine.nc.play_demand("bench", reference)
    twin.run_until("finished", limit=2 * reference.time_s.size + 5000)
    rows = np.genfromtxt(folder / "trace.csv", delimiter=",", names=True)
    return np.column_stack([rows["X_table_mm"], rows["Y_table_mm"]])


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("feedforward", [1.0, 0.5])
@pytest.mark.parametrize("program", ["bench_10m.ngc", "bench_20m.ngc"])
def test_prediction_matches_the_simulator_within_half_a_micrometre(
    program: str, feedforward: float, plant: str, tmp_path: Path
) -> None:
    config = machine(feedforward, PLANTS[plant])
    actual = table(config, PROGRAMS / program, tmp_path)
    models = {
        axis: Parameters(**(settings.nominal.model_dump() | PLANTS[plant][axis]))
        for axis, settings in config.axis.items()
    }
    prediction = predict_path(load_trajectory(PROGRAMS / program, config), models, config)
    both = np.column_stack([prediction.predicted_mm["X"], prediction.predicted_mm["Y"]])
    limited = any(prediction.limited_s.values())
    assert limited == (plant == "drifted" and program == "bench_20m.ngc" and feedforward == 1.0)
    assert np.max(np.abs(both - actual[: len(both)])) < (5e-3 if limited else 0.5e-3)
