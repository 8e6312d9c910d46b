"""``fdhil compare``: passes by contour error, models and recordings by parameters."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.machine_rig import fdhil

ROWS = 500


def write_trace(path: Path, away_um: float, along_um: float = 0.0, end: str = "_table_mm") -> Path:
    """Write a straight pass in X at 10 mm/s whose table deviates in Y and lags in X."""
    rows = [f"time_s,X_reference_mm,X{end},Y_reference_mm,Y{end}"]
    rows += [
        f"{k * 1e-3:.3f},{k * 0.01:.6f},{k * 0.01 - along_um * 1e-3:.6f},0,{away_um * 1e-3:.6f}" for k in range(ROWS)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_passes_are_compared_by_contour_error(tmp_path: Path, capsys: Any) -> None:
    before, after = (
        write_trace(tmp_path / "before.csv", 20.0),
        write_trace(tmp_path / "after.csv", 2.0, end="_predicted_mm"),
    )
    code, out, _ = fdhil("compare", before, after, "--json", capsys=capsys)
    document = json.loads(out)
    assert (code, document["schema"], document["kind"]) == (0, "fdhil-compare-1", "pass")
    assert document["before"]["contour"] == pytest.approx({"rms_um": 20.0, "max_um": 20.0})
    assert document["gain"] == pytest.approx(10.0)
    _, out, _ = fdhil("compare", before, after, capsys=capsys)
    assert "contour error smaller by a factor of 10" in out


def test_lag_along_path_is_not_a_contour_error(tmp_path: Path, capsys: Any) -> None:
    before, after = write_trace(tmp_path / "before.csv", 3.0), write_trace(tmp_path / "after.csv", 3.0, along_um=50.0)
    document = json.loads(fdhil("compare", before, after, "--json", capsys=capsys)[1])
    assert document["after"]["axes"]["X"]["rms_um"] == pytest.approx(50.0)
    assert document["after"]["contour"]["rms_um"] < math.hypot(3.0, 5.0)  # only the start of the path


def test_models_are_compared_by_parameters(tmp_path: Path, capsys: Any) -> None:
    model = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
    before, after = tmp_path / "before.json", tmp_path / "after.json"
    before.write_text(json.dumps({"X": model, "Y": model}))
    after.write_text(json.dumps({"X": model | {"R": 0.55}}))
    parameters = json.loads(fdhil("compare", before, after, "--json", capsys=capsys)[1])["parameters"]
    assert list(parameters) == ["X"]
    assert parameters["X"]["R"]["change_percent"] == pytest.approx(10.0)
    assert parameters["X"]["R"]["before"] == {"value": 0.5, "low": None, "high": None}
    assert "+10.0 %" in fdhil("compare", before, after, capsys=capsys)[1]


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("time_s,X_reference_mm\n0,1\n", 3, "is not a pass"),
        ("time_s,X_reference_mm,X_table_mm\n0,1,1\n0.001,nan,1\n", 3, "is not a pass"),
        ("time_s,X_reference_mm,X_table_mm\n0,1,1\n", 3, "is not a pass"),
        ("X_mm\n", 2, "give two files of one kind"),
        (None, 3, "cannot be read"),
    ],
)
def test_wrong_file_is_refused_in_one_sentence(
    text: str | None, code: int, message: str, tmp_path: Path, capsys: Any
) -> None:
    good, other = write_trace(tmp_path / "good.csv", 1.0), tmp_path / "other.csv"
    if text is not None:
        other.write_text(text)
    found, _, err = fdhil("compare", good, other, capsys=capsys)
    assert (found, message in err) == (code, True), err
