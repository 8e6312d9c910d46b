"""The machine configuration: every fault at once, each with its path and a suggestion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from fdhil import config
from fdhil.errors import ConfigError
from tests.bench import bench_config, bench_document


def faults(document: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        config.parse(document)
    assert caught.value.exit_code == 2
    return "\n".join(str(fault) for fault in caught.value.faults)


def test_the_bench_is_complete_and_everything_else_has_a_default() -> None:
    machine = bench_config()
    assert machine.nc.smoothing_s == (0.060, 0.030)
    assert [machine.node_id(axis) for axis in machine.axis] == [1, 2]
    assert machine.axis["X"].scaling.increments_per_mm == pytest.approx(3276.8)
    assert machine.axis["X"].rapid_speed_rad_s == pytest.approx(157.0796, rel=1e-6)


def test_all_faults_are_told_at_once() -> None:
    document = bench_document()
    del document["axis"]["X"]["screw_pitch_mm"]
    document["axis"]["X"]["nominal"]["Jtt"] = 3.0
    document["axis"]["Y"]["nominal"]["R"] = math.nan
    document["axis"]["Y"]["correction"]["max_offset_um"] = 900.0
    document["g0"] = {"source": "infered"}
    text = faults(document)
    assert "axis.X.screw_pitch_mm: is missing (table travel per motor revolution)" in text
    assert "axis.X.nominal.Jtt: is no key of this section (did you mean 'Jt'?)" in text
    assert "axis.Y.nominal.R: " in text
    assert "nan" in text
    assert "axis.Y.correction.max_offset_um: " in text
    assert "did you mean 'inferred'?" in text


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"speed_period_s": 0.0003}, "axis.X.regulators.speed_period_s: 0.0003 s does not divide 0.001 s"),
        ({"current_kp": -1.0}, "axis.X.regulators.current_kp"),
        ({"structure": "p_pi"}, "did you mean 'p_pi_pi'?"),
        ({"voltage_limit_v": "300"}, ""),
    ],
)
def test_regulators(change: dict[str, Any], expected: str) -> None:
    document = bench_document()
    document["axis"]["X"]["regulators"].update(change)
    if not expected:  # a number in quotes is read as the number
        assert config.parse(document).axis["X"].regulators.voltage_limit_v == 300.0
    else:
        assert expected in faults(document)


def test_limits_that_cannot_be_ramped_down_in_time_are_refused() -> None:
    document = bench_document("X")
    document["axis"]["X"]["correction"] = {
        "max_offset_um": 250.0,
        "max_speed_mm_s": 2.0,
        "max_acceleration_mm_s2": 250.0,
    }
    assert "from the largest offset to zero these limits need" in faults(document)


def test_two_drives_with_one_node_id_are_refused() -> None:
    document = bench_document()
    document["axis"]["X"]["drive"] = {"node_id": 2}
    assert "two drives of one bus have the same node_id" in faults(document)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"[machine\n", "is no TOML"),
        (b"\xff\xfe", "is no TOML"),
        (b"#" * 300_000, "larger than 256 KiB"),
        (b"", "machine"),
    ],
)
def test_files_that_are_no_config(tmp_path: Path, text: bytes, expected: str) -> None:
    path = tmp_path / "machine.toml"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=expected):
        config.load(path)


def test_a_missing_file_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        config.load(Path("nowhere.toml"))


def test_the_store_lies_beside_the_config(tmp_path: Path) -> None:
    machine = bench_config(folder=tmp_path)
    assert machine.store.directory == tmp_path / "fdhil-data"
    assert machine.store.run_directory == tmp_path / "fdhil-data" / "run"
