"""``fdhil identify --loops``: the identified loops of the drive."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from fdhil.cli.main import cli
from studies import real_plant as real
from tests.bench import bench_toml
from tests.identification.test_loop_identification import build_shuttle_demand

pytestmark = pytest.mark.usefixtures("long_computation")


@pytest.fixture
def filtered_recording(tmp_path: Path) -> Path:
    mechanics = real.Mechanics()
    run = real.simulate_axis(mechanics, build_shuttle_demand(2, 0.25, 0.5), real.Loops(speed_filter_s=0.001))
    path = tmp_path / "filtered.csv"
    path.write_text(real.format_as_csv(run, mechanics, real.Sensors(), 0.5))
    return path


def test_unconfigured_filter_is_reported_and_used(filtered_recording: Path, tmp_path: Path) -> None:
    config = tmp_path / "machine.toml"
    config.write_text(bench_toml())
    result = CliRunner().invoke(cli, ["identify", str(filtered_recording), "--config", str(config), "--json"])
    (reported,) = json.loads(result.stdout)["files"]
    assert reported["pooled"]["validated"]
    loops = reported["loops"]  # identified without --loops, because the configured ones do not explain the rapids
    assert (loops["structure"], loops["configured_structure"]) == ("p_pi_pi", "p_pi_pi")
    found = loops["gains"]["speed_filter_s"]
    assert found["value"] == pytest.approx(0.001, rel=0.06)
    assert (found["unit"], found["configured"]) == ("s", 0.0)
    assert loops["unexplained_um"] < 0.5 < 20.0 < loops["configured_um"]
    assert loops["warnings"][0].startswith("LoopsDiffer: ")


def test_loops_are_printed_as_table(filtered_recording: Path) -> None:
    result = CliRunner().invoke(cli, ["identify", str(filtered_recording), "--loops"])
    assert result.exit_code == 0
    assert "loops: p_pi_pi" in result.stdout
    assert "speed_filter_s" in result.stdout
    assert "not explained by these loops: 0." in result.stdout
