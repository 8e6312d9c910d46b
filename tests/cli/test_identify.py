"""``fdhil identify`` as called by users and programs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from fdhil import tables
from fdhil.cli.identify_command import identify
from fdhil.cli.main import cli, run_safely
from fdhil.errors import ConfigError
from fdhil.store import file_suffixes
from fdhil.store.window_export import convert_window, export_table
from studies import bench
from studies.slow_sensor import record_slow_windows
from tests.bench import bench_toml
from tests.identification.bench_recordings import simulate_bench_shuttle


@pytest.fixture
def shuttle(tmp_path: Path) -> Path:
    path = tmp_path / "shuttle.csv"
    path.write_text(bench.format_as_csv(simulate_bench_shuttle(moves=2), 0.003))
    return path


def run_cli(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["identify", *map(str, arguments)], standalone_mode=False)


def load_json_document(result: Result) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(result.stdout)
    return document


def test_json_has_every_window_and_the_pool(shuttle: Path) -> None:
    result = run_cli(shuttle, "--json")
    assert result.return_value == 0
    document = load_json_document(result)
    assert document["schema"] == "fdhil-identify-1"
    (reported,) = document["files"]
    assert (reported["file"], reported["axis"]) == (str(shuttle), "X")
    assert [w["direction"] for w in reported["windows"]] == [1, -1]
    for window in reported["windows"]:
        assert window["validated"] is True
        assert window["reasons"] == []
        assert 98 < window["fit_percent"] < 100
        assert set(window) == {
            "start_s", "end_s", "direction", "parameters", "terms", "validated", "fit_percent", "unexplained_um",
            "reasons", "warnings",
        }  # fmt: skip
    pooled = reported["pooled"]
    assert pooled["windows_used"] == 2
    assert pooled["validated"] is True
    truth = bench.Plant().truth()
    for name, entry in pooled["parameters"].items():
        assert entry["value"] == pytest.approx(truth[name], rel=0.02)
        assert 0 < entry["std"] < 0.05 * truth[name]
    assert pooled["parameters"]["L"]["unit"] == "H"


def test_delay_of_slow_sensor_is_reported_with_deviation(tmp_path: Path) -> None:
    path = tmp_path / "slow.csv"
    export_table(convert_window(record_slow_windows(0.005, delay_s=0.0012)[0]), path)
    result = run_cli(path, "--json")
    assert result.return_value == 0
    (window,) = load_json_document(result)["files"][0]["windows"]
    assert set(window["delay_s"]) == {"value", "std", "unit"}
    assert window["delay_s"]["unit"] == "s"
    assert abs(window["delay_s"]["value"] - 0.0012) < 4 * window["delay_s"]["std"] < 2e-4
    assert "voltage is delayed by 1.2" in run_cli(path).stdout


@pytest.mark.parametrize("method", ["least_squares", "maximum_likelihood"])
def test_method_option_selects_estimator(shuttle: Path, method: str) -> None:
    assert run_cli(shuttle, "--json", "--method", method).return_value == 0


def test_identify_prints_table(shuttle: Path) -> None:
    result = run_cli(shuttle)
    assert result.return_value == 0
    assert "all 2" in result.stdout
    assert "g.m2" in result.stdout


def test_table_fits_80_columns(shuttle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = run_cli(shuttle).stdout.splitlines()
    assert max(map(len, lines[1:])) <= 80
    assert any(line.split()[-1:] == ["valid"] for line in lines)
    assert not any("\N{HORIZONTAL ELLIPSIS}" in line for line in lines)


def test_refused_recording_exits_1_with_null_values(tmp_path: Path) -> None:
    path = tmp_path / "still.csv"
    path.write_text(
        bench.format_as_csv(
            bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=0.02, speed=0.1)), 0.003
        )
    )
    result = run_cli(path, "--json")
    assert result.return_value == 1
    (reported,) = load_json_document(result)["files"]
    assert reported["windows"] == []
    assert reported["pooled"]["windows_used"] == 0
    assert reported["pooled"]["reasons"][0].startswith("NoWindow")
    assert reported["pooled"]["parameters"]["R"]["value"] is None
    assert "reason" in reported["pooled"]["parameters"]["R"]
    assert "NoWindow" in run_cli(path).stdout


def test_rapid_speed_comes_from_config(shuttle: Path, tmp_path: Path) -> None:
    text = "".join(x for x in shuttle.read_text().splitlines(keepends=True) if "rapid_speed" not in x)
    shuttle.write_text(text)
    config = tmp_path / "machine.toml"
    fast = tmp_path / "fast.toml"
    config.write_text(_write_config(500.0))
    fast.write_text(_write_config(2000.0))
    assert len(load_json_document(run_cli(shuttle, "--json", "--config", config))["files"][0]["windows"]) == 2
    assert load_json_document(run_cli(shuttle, "--json", "--config", fast))["files"][0]["windows"] == []


def _write_config(rapid: float) -> str:
    return bench_toml("X", rapid_speed_mm_s=rapid)


def test_unreadable_recording_does_not_stop_batch(shuttle: Path, tmp_path: Path) -> None:
    """The error of the bad recording is in the document, in the table and on stderr."""
    bad, absent = tmp_path / "bad.csv", tmp_path / "absent.csv"
    bad.write_bytes(b"time_s,voltage_V\n1,two\n")
    result = run_cli(bad, shuttle, absent, "--json")
    assert result.return_value == 3
    first, good, last = load_json_document(result)["files"]
    assert good["pooled"]["validated"] is True
    assert "error" not in good
    for reported, path in ((first, bad), (last, absent)):
        assert set(reported) == {*good, "error"}
        assert (reported["file"], reported["axis"], reported["windows"]) == (str(path), None, [])
        assert reported["pooled"]["validated"] is False
        assert reported["pooled"]["windows_used"] == 0
        assert reported["pooled"]["parameters"]["R"]["value"] is None
        assert reported["pooled"]["reasons"] == [f"RecordingError: {reported['error']['text']}"]
        assert reported["error"]["class"] == "RecordingError"
    shown = run_cli(bad, shuttle, absent)
    assert shown.return_value == 3
    assert "all 2" in shown.stdout
    assert " ".join(shown.stdout.split()).count("not identified") == 2
    assert [line.split(" cannot")[0].split(":")[0] for line in shown.stderr.splitlines()] == ["fdhil", "fdhil"]


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("place", ["empty", "closed", "a" * 300])
def test_unreadable_folder_does_not_stop_batch(place: str, shuttle: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "closed").mkdir()
    (tmp_path / "closed" / "in").mkdir(mode=0)
    result = identify_without_permissions(tmp_path / place, shuttle)
    assert result.returncode == 3, result.stderr
    bad, good = json.loads(result.stdout)["files"]
    assert good["pooled"]["validated"] is True
    why = {"empty": "has no recordings (.csv", "closed": "closed/in cannot be read (Permission denied)"}
    assert why.get(place, "cannot be read (File name too long)") in bad["error"]["text"]


def identify_without_permissions(*recordings: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fdhil", "identify", "--json", *map(str, recordings)]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", *command]
    return subprocess.run(command, capture_output=True, text=True, timeout=100)


def test_axis_missing_in_config_is_reported(shuttle: Path, tmp_path: Path) -> None:
    """Without the axis in the configuration no comparison with nominal values is possible."""
    shuttle.write_text(shuttle.read_text().replace("# axis: X", "# axis: Q", 1))
    (tmp_path / "machine.toml").write_text(_write_config(500.0))
    (reported,) = load_json_document(run_cli(shuttle, "--json", "--config", tmp_path / "machine.toml"))["files"]
    assert reported["pooled"]["validated"] is True
    assert [text for text in reported["pooled"]["warnings"] if "NoSuchAxis: axis Q is not in the configuration" in text]
    (reported,) = load_json_document(run_cli(shuttle, "--json"))["files"]
    assert "NoSuchAxis" not in str(reported)


def test_unreadable_recording_exits_3_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["fdhil-identify", str(tmp_path / "absent.csv")])
    assert run_safely(identify) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "cannot be read" in error


def test_unknown_method_exits_2(shuttle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["fdhil-identify", str(shuttle), "--method", "guess"])
    assert run_safely(identify) == 2


@pytest.mark.usefixtures("processes")
def test_every_file_format_gives_identical_result(tmp_path: Path) -> None:
    table = convert_window(record_slow_windows(0.005)[0])
    answers = []
    for name in tables.RECORDING_FORMATS:
        path = tmp_path / f"rapid{file_suffixes.find_suffix(file_suffixes.RECORDING_SUFFIXES, name)}"
        export_table(table, path, name)
        answers.append(load_json_document(run_cli("--json", path))["files"][0]["pooled"])
    assert answers[0]["validated"]
    assert answers == [answers[0]] * len(answers)


def test_wrong_column_map_is_reported_as_configuration_error(shuttle: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "map.toml"
    wrong.write_text("[columns]\n")
    refused = run_cli(shuttle, "--columns", wrong).exception
    assert isinstance(refused, ConfigError)
    assert "headers.axis" in str(refused)


TRACE_MAP = """
[headers]
axis = "X"
pitch_m_per_rev = 0.02
rapid_speed_m_per_s = 0.5
voltage_sampling = "%s"
[columns]
time_s = { name = "Time", unit = "ms" }
voltage_V = { name = "Voltage", unit = "V" }
current_A = { name = "Current", unit = "A" }
speed_rad_per_s = { name = "Speed", unit = "rad/s" }
position_m = { name = "Position", unit = "um" }
demand_m = { name = "Demand", unit = "mm" }
"""


def _write_trace(tmp_path: Path, every: int = 1, sampling: str = "interval_mean") -> tuple[Path, Path]:
    """Write an oscilloscope trace with decimal commas, quotes and a 16-bit position counter, and its column map."""
    lines = bench.format_as_csv(simulate_bench_shuttle(moves=2), 0.003).partition("time_s")[2].splitlines()[1::every]
    rows = ['"Time","Voltage","Current","Speed","Position","Demand"']
    for line in lines:
        time_s, voltage, current, speed, position_m, demand_m = map(float, line.split(","))
        counts = (round(position_m * 1e6) + 32768) % 65536 - 32768
        cells = (
            f"{time_s * 1e3:.3f}",
            f"{voltage:,.4f}",
            f"{current:,.4f}",
            f"{speed:,.5f}",
            str(counts),
            f"{demand_m * 1e3:.4f}",
        )
        rows.append(",".join(f'"{cell}"'.translate(str.maketrans(".,", ",.")) for cell in cells))
    (tmp_path / "trace.csv").write_text("\n".join([*rows, ""]))
    (tmp_path / "map.toml").write_text(TRACE_MAP % sampling)
    return tmp_path / "trace.csv", tmp_path / "map.toml"


def test_oscilloscope_trace_is_identified_with_column_map(tmp_path: Path) -> None:
    trace, columns = _write_trace(tmp_path)
    result = run_cli(trace, "--columns", columns, "--json")
    pooled = load_json_document(result)["files"][0]["pooled"]
    assert pooled["validated"], pooled
    assert pooled["parameters"]["K"]["value"] == pytest.approx(0.8, rel=0.01)
    assert "ReadOtherwise: Position wraps like a counter of 16 bits and was unwrapped" in pooled["warnings"]


def test_recording_with_low_sample_rate_is_refused(tmp_path: Path) -> None:
    trace, columns = _write_trace(tmp_path, every=50, sampling="instant")
    pooled = load_json_document(run_cli(trace, "--columns", columns, "--json"))["files"][0]["pooled"]
    assert not pooled["validated"]
    assert pooled["reasons"][0] == "LowExcitation: 20 Hz is too slow to resolve a drive's acceleration"


@pytest.mark.usefixtures("processes")
def test_columns_of_different_lengths_give_json_error(tmp_path: Path) -> None:
    from scipy import io

    columns = _write_trace(tmp_path)[1]
    names = ("Time", "Voltage", "Current", "Speed", "Position", "Demand")
    io.savemat(tmp_path / "short.mat", {name: list(range(50 + (name == "Current"))) for name in names})
    result = run_cli(tmp_path / "short.mat", "--columns", columns, "--json")
    assert result.return_value == 3
    assert "different lengths" in load_json_document(result)["files"][0]["error"]["text"]
