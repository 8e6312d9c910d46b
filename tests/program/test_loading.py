"""Reading and writing of demand CSV, and recognition of files by their suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil.errors import ConfigError, ProgramError, RecordingError
from fdhil.program import compute_program_digest, load_trajectory, write_demand_csv
from tests.bench import bench_config

PROGRAMS = Path(__file__).parents[2] / "configs" / "programs"


def test_written_demand_is_read_unchanged(tmp_path: Path) -> None:
    config = bench_config()
    planned = load_trajectory(PROGRAMS / "bench_10m.ngc", config)
    write_demand_csv(planned, tmp_path / "demand.csv")
    read = load_trajectory(tmp_path / "demand.csv", config)
    np.testing.assert_allclose(read.time_s, planned.time_s, atol=1e-9)
    for axis in planned.axes:
        np.testing.assert_allclose(read.position_mm[axis], planned.position_mm[axis], atol=1e-9)
    assert (tmp_path / "demand.csv").read_text().splitlines()[0] == "time_s,X_mm,Y_mm"


@pytest.mark.parametrize("name", ["bench_10m.ngc", "bench_20m.ngc", "bench_rounded_10m.ngc", "shuttle.ngc"])
def test_example_programs_can_be_planned(name: str) -> None:
    reference = load_trajectory(PROGRAMS / name, bench_config())
    assert reference.position_mm["X"].max() >= 250.0 - 1e-9
    assert reference.rapid.any() == (name == "shuttle.ngc")


ROWS = [f"{k / 1000:.3f},{k * 0.1:.4f},0.0" for k in range(20)]


@pytest.mark.parametrize(
    "lines",
    [
        [],
        ["time_s,X_mm,Y_mm"],
        ["time_s,X_mm", *[row.rpartition(",")[0] for row in ROWS]],
        ["X_mm,Y_mm", *[row.partition(",")[2] for row in ROWS]],
        ["time_s,X_mm,Y_mm", *ROWS[:5], "0.005,abc,0", *ROWS[6:]],
        ["time_s,X_mm,Y_mm", *ROWS[:5], "0.005,nan,0", *ROWS[6:]],
        ["time_s,X_mm,Y_mm", *ROWS[:5], "0.005,,0", *ROWS[6:]],
        ["time_s,X_mm,Y_mm", *ROWS, "0.020,1."],
        ["time_s,X_mm,Y_mm", *ROWS[:5], *ROWS[6:]],
        ["time_s,X_mm,Y_mm,Z_mm", *[f"{row},{k}" for k, row in enumerate(ROWS)]],
        ["time_s,X_mm,Y_mm", ROWS[0]],
    ],
)
def test_broken_demand_raises_recording_error(lines: list[str], tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("".join(f"{line}\n" for line in lines))
    with pytest.raises(RecordingError):
        load_trajectory(tmp_path / "d.csv", bench_config())


def test_missing_column_is_reported_with_expected_header(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("time_s,X_mm\n" + "\n".join(row.rpartition(",")[0] for row in ROWS))
    with pytest.raises(
        RecordingError, match="no column Y_mm, Z_mm; a demand begins with the line time_s,X_mm,Y_mm,Z_mm"
    ):
        load_trajectory(tmp_path / "d.csv", bench_config("XYZ"))


NAMES = "time_s,X_mm,Y_mm\n"
DATA = "".join(f"{row}\n" for row in ROWS)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (NAMES + DATA[:-1], "is truncated: line 21 has no end of line, so its last number may be truncated"),
        (NAMES + "\n" + DATA.replace("0.005,0.5000,0.0", "0.005,0.5000"), "line 8 has 2 values in 3 columns"),
        (NAMES + "\n" + DATA.replace("0.5000", "abc"), "line 8 has 'abc' instead of a finite number"),
        (NAMES + "\n" + DATA.replace("0.5000", "inf"), "line 8 has 'inf' instead of a finite number"),
        (NAMES + "\n" + DATA.replace("0.005,0.5000,0.0\n", "\n"), "line 9 is 0.002 s after the row before it"),
        (NAMES.replace("X", "Y") + DATA, "no column X_mm; a demand"),
        ("time_s,X_mm,Y_mm,X_mm\n" + DATA.replace("\n", ",0\n"), "has two columns 'X_mm'"),
        (NAMES.replace(",", ";") + DATA.replace(",", ";"), "its first line has semicolons, but only commas separate"),
        ('"time_s"\t"X_mm"\n', "its first line has tabs and quotes, but only commas separate names"),
        (NAMES + "".join(f"{k / 1000},{k % 2}e300,0\n" for k in range(9)), "axis X moves at 1e+303 mm/s, 2e+300 times"),
    ],
)
def test_demand_error_names_line(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(RecordingError) as caught:
        load_trajectory(tmp_path / "d.csv", bench_config())
    assert told in str(caught.value)


def test_step_other_than_sync_period_is_config_error(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("time_s,X_mm,Y_mm\n" + "".join(f"{k * 0.002:.3f},0,0\n" for k in range(9)))
    with pytest.raises(ConfigError, match="sync_period_s"):
        load_trajectory(tmp_path / "d.csv", bench_config())


def test_digest_distinguishes_programs(tmp_path: Path) -> None:
    assert compute_program_digest(PROGRAMS / "bench_10m.ngc") != compute_program_digest(PROGRAMS / "bench_20m.ngc")
    with pytest.raises(ProgramError):
        compute_program_digest(tmp_path / "none.ngc")
    with pytest.raises(ProgramError):
        load_trajectory(tmp_path / "none.ngc", bench_config())


def write_straight_demand(factor: float) -> str:
    """A move of 100 mm at 10 m/min as a demand, in millimetres times ``factor``."""
    rows = "".join(f"{k * 1e-3:.6f},{min(k, 600) / 6 * factor:.9f},{0.0:.1f}\n" for k in range(700))
    return "time_s,X_mm,Y_mm\n" + rows


def test_demand_in_micrometres_is_refused_and_in_metres_warned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "demand.csv"
    path.write_text(write_straight_demand(1.0))
    assert load_trajectory(path, bench_config()).time_s.size == 700
    assert caplog.records == []
    path.write_text(write_straight_demand(1e3))
    with pytest.raises(
        RecordingError, match=r"axis X moves at 1.67e\+05 mm/s, 333 times its rapid speed; is X_mm in um"
    ):
        load_trajectory(path, bench_config())
    path.write_text(write_straight_demand(1e-3))
    load_trajectory(path, bench_config())
    assert "is it in m? convert it to mm" in caplog.records[0].getMessage()
