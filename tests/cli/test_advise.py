"""``fdhil advise`` as called by another program."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from fdhil.cli.advise_view import show_advice
from fdhil.prediction.feed_advice import FeedAdvice, FeedResult
from tests.bench import bench_toml
from tests.cli.test_predict import _bench as _bench
from tests.cli.test_predict import run_cli


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(("tolerance", "code", "lines"), [(200, 0, 0), (60, 0, 2), (0.001, 1, 2)])
def test_advise_lists_lines_that_exceed_tolerance(bench: Path, tolerance: float, code: int, lines: int) -> None:
    program = bench / "corner.ngc"
    program.write_text("G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nM2\n")
    arguments = ["advise", program, "--config", bench / "bench.toml", "--tolerance-um", tolerance]
    result = run_cli(*arguments, "--json")
    assert result.exit_code == code, result.stderr
    found = json.loads(result.stdout)["lines"]
    assert len(found) == lines
    for entry in found if code == 0 else []:
        assert entry["cause"] == "corner"
        assert entry["advised_feed_mm_min"] == pytest.approx(entry["feed_share"] * 15000)
        assert entry["advised_feed_mm_min"] < entry["corrected_feed_mm_min"] == 15000
    shown = run_cli(*arguments).stdout
    assert ("line 3: F15000 -> F" in shown or "lines 2-3: F15000 -> F" in shown) == (lines > 0)


@pytest.mark.usefixtures("long_computation")
def test_written_program_beyond_tolerance_exits_1(bench: Path) -> None:
    """The correction would keep the tolerance in both lines, but the written feeds apply without it."""
    program, out = bench / "corner.ngc", bench / "slow.ngc"
    program.write_text("G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nM2\n")
    arguments = ["advise", program, "--config", bench / "bench.toml", "--tolerance-um", 1]
    assert run_cli(*arguments).exit_code == 0
    result = run_cli(*arguments, "--out", out)
    assert result.exit_code == 1
    assert "2 lines leave the tolerance at every feed tried, without the correction" in result.stderr


@pytest.fixture(scope="module")
def wave(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wave")
    (folder / "bench.toml").write_text(bench_toml())
    lines = ["%", "(a wave; F1)", "G21 G90 G64 F6000"]
    for k in range(400):
        angle = k / 40 * 2 * math.pi
        radius = 30 + 8 * math.sin(5 * angle)
        lines.append(f"N{k} G1 X{radius * math.cos(angle) - 30:.3f} Y{radius * math.sin(angle):.3f} ; k")
    (folder / "wave.ngc").write_bytes("\r\n".join([*lines, "M2", "%", ""]).encode())
    return folder


@pytest.mark.usefixtures("long_computation")
def test_many_lines_are_grouped_and_written_program_keeps_tolerance(wave: Path) -> None:
    """The written program keeps the tolerance, and differs from the original only in its F words."""
    program, out, config = wave / "wave.ngc", wave / "new.ngc", wave / "bench.toml"
    arguments = ["advise", program, "--config", config, "--tolerance-um", 40]
    result = run_cli(*arguments, "--out", out)
    assert result.exit_code == 0, result.stderr
    assert re.search(
        r"lines \d+-\d+: F6000 -> F[\d.]+, with the correction F[\d.]+, worst [\d.]+ um at line \d+", result.stdout
    )
    assert len(result.stdout.splitlines()) <= 25
    document = json.loads(run_cli(*arguments, "--json").stdout)
    assert len(document["lines"]) > 60
    predicted = json.loads(run_cli("predict", out, "--config", config, "--json").stdout)
    assert predicted["contour"]["max_um"] <= 40
    before, after = (path.read_bytes().split(b"\n") for path in (program, out))
    changed = {k for k, (one, other) in enumerate(zip(before, after, strict=True), 1) if one != other}
    assert {entry["line"] for entry in document["lines"] if entry["feed_share"] < 0.99} <= changed
    assert all(
        re.sub(rb" F[\d.]+", b"", other) == one for one, other in zip(before, after, strict=True) if other != one
    )


def make_advice(line: int, feed: float, error_um: float = 30.0) -> FeedAdvice:
    held = FeedResult(feed / 3000.0, feed / 3000.0, 1.0, feed / 3000.0)
    return FeedAdvice(
        line, line / 10, (line + 1) / 10, error_um, "X 1.0", "corner", "X", ("X", "current", 0.5), 3000.0, held, None
    )


@pytest.mark.usefixtures("long_computation")
def test_consecutive_lines_form_one_range(capsys: pytest.CaptureFixture[str]) -> None:
    """A line with its programmed feed, or a feed of twice the value, separates two ranges."""
    slow = [make_advice(line, 2100.0, 34.0 if line == 260 else 30.0) for line in range(120, 481, 2)]
    apart = [make_advice(line, 600.0) for line in (490, 492)]
    show_advice([*slow, *apart], None, 20.0, True, lambda line: line % 2 == 0)
    assert capsys.readouterr().out.splitlines() == [
        "lines 120-480: F3000 -> F2100, worst 34.0 um at line 260, X 1.0 (corner, most of it axis X)",
        "lines 490-492: F3000 -> F600, worst 30.0 um at line 490, X 1.0 (corner, most of it axis X)",
    ]
    show_advice(
        [make_advice(line, 100.0 if line % 3 else 2900.0, float(line)) for line in range(1, 16_000)],
        None,
        20.0,
        True,
        bool,
    )
    first, *shown, last = capsys.readouterr().out.splitlines()
    assert first.startswith("15999 lines in 10666 ranges, down to F100; the 20 worst of them:")
    assert len(shown) == 20
    assert "15999" in shown[-1]
    assert last == "--json lists every line"


def test_demand_csv_with_out_is_refused_before_computation(bench: Path) -> None:
    program, config = bench / "corner.ngc", bench / "bench.toml"
    program.write_text("G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nM2\n")
    arguments = ["--config", config, "--tolerance-um", 60, "--out"]
    assert run_cli("advise", program, *arguments, program).exit_code == 2
    assert run_cli("advise", bench / "demand.csv", *arguments, bench / "new.ngc").exit_code == 2
    assert run_cli("advise", program, *arguments, bench).exit_code == 3
    assert program.read_text().startswith("G21")


@pytest.mark.parametrize("tolerance", ["0", "-3", "nan", "inf", "wide"])
def test_tolerance_must_be_positive(bench: Path, tolerance: str) -> None:
    """nan would accept every path."""
    result = run_cli("advise", bench / "demand.csv", "--config", bench / "bench.toml", "--tolerance-um", tolerance)
    assert result.exit_code == 2
    assert "--tolerance-um" in result.stderr
