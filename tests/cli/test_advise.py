"""``fdhil advise`` as another program calls it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.test_predict import _bench as _bench
from tests.cli.test_predict import invoke


@pytest.mark.parametrize(("tolerance", "code", "lines"), [(200, 0, 0), (60, 0, 2), (0.001, 1, 2)])
def test_lists_the_lines_that_leave_the_tolerance(bench: Path, tolerance: float, code: int, lines: int) -> None:
    """Exit code 1 when no feed helps."""
    program = bench / "corner.ngc"
    program.write_text("G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nM2\n")
    arguments = ["advise", program, "--config", bench / "bench.toml", "--tolerance-um", tolerance]
    result = invoke(*arguments, "--json")
    assert result.exit_code == code, result.stderr
    found = json.loads(result.stdout)["lines"]
    assert len(found) == lines
    for entry in found if code == 0 else []:
        assert entry["cause"] == "corner"
        assert entry["advised_feed_mm_min"] == pytest.approx(entry["feed_share"] * 15000)
        assert entry["advised_feed_mm_min"] < entry["corrected_feed_mm_min"] == 15000
    assert ("line 3" in invoke(*arguments).stdout) == (lines > 0)


@pytest.mark.parametrize("tolerance", ["0", "-3", "nan", "inf", "wide"])
def test_the_tolerance_must_be_a_positive_number(bench: Path, tolerance: str) -> None:
    """Against nan every path would be within the tolerance."""
    result = invoke("advise", bench / "demand.csv", "--config", bench / "bench.toml", "--tolerance-um", tolerance)
    assert result.exit_code == 2
    assert "--tolerance-um" in result.stderr
