"""A model file contains identified loops, and is not written while they are unknown."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil.api.recording_analysis import FileResult
from fdhil.cli.model_file import write_model
from fdhil.identification.drive_loops.loop_identification import DIFFER
from fdhil.prediction.axis_models import apply_loops, load_model_file
from fdhil.records import PARAMETERS, Estimate, LoopEstimate, Reason, Result, Verdict, freeze_array
from tests.bench import bench_config
from tests.store.sample_records import BENCH

CONFIG = bench_config("X")
POOLED = Estimate(
    "maximum_likelihood", PARAMETERS, freeze_array([*BENCH.as_dict().values()]), freeze_array(np.eye(6)), {}, Result.OK
)
VALID = FileResult("a.csv", "X", (), POOLED, Verdict(True, 99.0))
REFUTED = replace(VALID, pooled=None, verdict=Verdict(False, None, (Reason(DIFFER, "the loops are others"),)))
PID = LoopEstimate(
    "X", "pid", ("position_gain_per_s", "position_ki_per_s2"), freeze_array([84.0, 1760.0]), freeze_array(np.eye(2)),
    Verdict(True, None, (), 0.3, (Reason(DIFFER, "72 um"),)), 72.0,
)  # fmt: skip


@pytest.mark.parametrize("results", [[replace(VALID, loops=PID)], [replace(REFUTED, loops=PID), VALID]])
def test_identified_structure_is_written_with_its_gains(results: list[FileResult], tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model(results, CONFIG.axis, path)
    assert json.loads(path.read_text())["X"]["loops"] == {
        "structure": "pid", "position_gain_per_s": 84.0, "position_ki_per_s2": 1760.0, "speed_ki": 0.0,
    }  # fmt: skip
    used = apply_loops(CONFIG, load_model_file(path).loops, str(path)).axis["X"].regulators
    assert (used.structure, used.speed_kp) == ("pid", CONFIG.axis["X"].regulators.speed_kp)


def test_configured_loops_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model([replace(VALID, loops=replace(PID, verdict=Verdict(True, None)))], CONFIG.axis, path)
    assert "loops" not in json.loads(path.read_text())["X"]


def test_model_is_not_written_when_loops_are_refuted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "model.json"
    write_model([REFUTED, VALID], CONFIG.axis, path)
    assert not path.exists()
    assert "its loops would be wrong: axis X: LoopsDiffer: the loops are others" in capsys.readouterr().err
    unexplained = Verdict(False, None, (Reason("LoopsUnexplained", "the best loops leave 30 um"),))
    write_model([replace(VALID, loops=replace(PID, verdict=unexplained, configured_um=None))], {}, path)
    assert not path.exists()
    assert "axis X: LoopsUnexplained: the best loops leave 30 um" in capsys.readouterr().err
