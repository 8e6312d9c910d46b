"""A program planned at once has rows in the drives' increments; a refused one has none."""

from __future__ import annotations

import copy
import io
from pathlib import Path

import numpy as np
import pytest

from fdhil import correction
from fdhil.arming.arm_plan import ArmRequest, Refusal
from fdhil.arming.checked_program import TablePiece
from fdhil.arming.first_block import FirstBlock
from fdhil.arming.program_check import check_program, encode_rows
from fdhil.arming.whole_plan import plan_whole_program
from fdhil.config import MachineConfig, parse_config
from fdhil.errors import ProgramError
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import compute_program_digest
from tests.arming.test_arm_plan import make_whole_plan
from tests.bench import bench_config, bench_document
from tests.daemon.simulated_machine import config_of
from tests.paths import build_bench_trajectory


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    return config_of(tmp_path, ("X", "Y"))


def test_rows_are_in_drive_increments_and_sign() -> None:
    document = copy.deepcopy(bench_document())
    document["axis"]["Y"]["drive"] = {"sign": -1}
    config = parse_config(document)
    planned = correction.plan_correction(build_bench_trajectory(10), build_nominal_models(config), config, "mirror")
    position = planned.before.reference.position_mm
    rows = np.frombuffer(encode_rows(position, planned.offset_um, config), "<i4").reshape(-1, 4)
    per_mm = 65536 / 20
    assert np.array_equal(rows[:, 0], np.rint(position["X"] * per_mm))
    assert np.array_equal(rows[:, 3], np.rint(-planned.offset_um["Y"] * 1e-3 * per_mm))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e9])
def test_value_beyond_int32_is_refused(wrong: float) -> None:
    rows = {axis: np.array([0.0, wrong]) for axis in "XY"}
    with pytest.raises(ProgramError, match="not finite, or too large"):
        encode_rows(rows, rows, bench_config())


def test_refused_program_has_no_rows(config: MachineConfig, tmp_path: Path) -> None:
    program = tmp_path / "dwell.ngc"
    program.write_text("G4 P0.2\nM2\n")
    refused = make_whole_plan(program, config)
    assert isinstance(refused, Refusal)
    assert refused.reasons[0].code == "NoGain"


FAR = "G1 X{:.4f} F30000\nG1 X0\nM2\n"


def test_program_beyond_32_bits_is_refused_by_both_checks(tmp_path: Path) -> None:
    document = bench_document("X")
    document["axis"]["X"]["drive"] = {"increments_per_rev": 20_000_000}
    config = parse_config(document, folder=tmp_path)
    program = tmp_path / "far.ngc"
    program.write_text(FAR.format(2147.2337))
    reported = "line 1, 'X': axis X at 2147.2337 mm: .* is 2147.2336 mm"
    for method in (None, "mirror"):
        with pytest.raises(ProgramError, match=reported):
            make_whole_plan(program, config, method)
    with pytest.raises(ProgramError, match=reported):
        check_program(
            program, compute_program_digest(program), build_nominal_models(config), config, io.BytesIO(), print
        )


@pytest.mark.parametrize("name", ["program.ngc", "program.csv"])
def test_rows_and_digest_belong_to_the_same_content(name: str, config: MachineConfig, tmp_path: Path) -> None:
    program, other = tmp_path / name, tmp_path / "other"
    texts = {".ngc": FAR.format(30), ".csv": "time_s,X_mm,Y_mm\n0.000,0,0\n0.001,0,0\n0.002,0,0\n"}
    program.write_text(texts[program.suffix])
    request = ArmRequest(program, compute_program_digest(program), build_nominal_models(config), config, "mirror")
    other.write_text(texts[program.suffix].replace("0", "0.0", 1))
    other.rename(program)
    with pytest.raises(ProgramError, match="was modified while it was checked"):
        plan_whole_program(request, {})
    with pytest.raises(ProgramError, match="was modified while it was checked"):
        check_program(program, request.program_digest, request.models, config, io.BytesIO(), print)
    begin = TablePiece(0, {"X": [0], "Y": [0]}, {"X": [0], "Y": [0]}, True)
    with pytest.raises(ProgramError, match="was modified while it was checked"):
        FirstBlock(begin, program, request.models, config, request.program_digest)
