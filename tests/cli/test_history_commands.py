"""replay, history, report, export: stored data and errors for wrong input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fdhil.cli.history_commands import read_windows
from fdhil.cli.main import cli
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.records import freeze_array
from fdhil.store.recording_file import read_recording
from fdhil.store.window_file import encode_window
from studies.slow_sensor import record_slow_windows
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import make_outcome, make_published, make_window


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    store = OutcomeStore(config_of(tmp_path, ("X", "Y")))
    store.open()
    store.store_outcomes(
        [
            make_outcome(),
            make_published(1),
            make_outcome(accepted=False),
            make_outcome(),
            make_published(2),
            make_published(1, "Y"),
        ]
    )
    store.close()
    return path


@pytest.fixture
def rapid(tmp_path: Path) -> Path:
    path = tmp_path / "w00000001-X.parquet"
    config = config_of(tmp_path)
    path.write_bytes(encode_window(simulate_nominal_rapid("X", config.axis["X"], 0.001), config.digest))
    return path


def test_replay_prints_outcomes_in_full_precision(rapid: Path, capsys: Any) -> None:
    code, out, _ = fdhil("replay", "--json", rapid, capsys=capsys)
    document = json.loads(out)
    assert (code, document["schema"], document["validated"]) == (0, "fdhil-replay-1", True)
    reported, parameters = document["files"][0]["outcomes"]
    assert (reported["kind"], reported["axis"], reported["direction"], reported["validated"]) == (
        "window",
        "X",
        1,
        True,
    )
    assert reported["parameters"]["Jt"]["unit"] == "kg.m2"
    assert parameters["parameters"]["Jt"]["value"] == reported["parameters"]["Jt"]["value"]
    assert fdhil("replay", "--json", rapid, capsys=capsys)[1] == out
    code, out, _ = fdhil("replay", rapid, "--method", "least_squares", capsys=capsys)
    assert code == 0
    assert out.startswith("X: G0 + at 0.00 s (850 samples) accepted")


def test_replay_of_refused_window_exits_1(tmp_path: Path, capsys: Any) -> None:
    bad = tmp_path / "bad.parquet"
    bad.write_bytes(encode_window(make_window(), ""))
    code, out, _ = fdhil("replay", bad, capsys=capsys)
    assert code == 1
    assert "refused" in out


def test_exported_recording_can_be_replayed(rapid: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.csv"
    assert fdhil("export", rapid, "--out", out, capsys=capsys) == (0, "", f"wrote {out}\n")
    recording = read_recording(out)
    assert recording.pitch_mm == 20.0
    assert np.isfinite(recording.speed_rad_s).all()
    assert fdhil("replay", out, capsys=capsys)[0] == 0
    before = rapid.read_bytes()
    code, _, err = fdhil("export", rapid, "--out", rapid, capsys=capsys)
    assert code == 2
    assert "is also named by" in err
    assert rapid.read_bytes() == before


def test_export_keeps_low_rate_samples_bit_exact(tmp_path: Path, capsys: Any) -> None:
    stored, out = tmp_path / "w00000001-X.parquet", tmp_path / "out.csv"
    made = record_slow_windows(0.005, delay_s=0.0012)[0]
    before = made.slow_voltage
    assert before is not None
    reported = np.array(before.voltage_v)
    reported[70] = np.nan
    made = replace(made, slow_voltage=replace(before, voltage_v=freeze_array(reported)))
    stored.write_bytes(encode_window(made, ""))
    assert fdhil("export", stored, "--out", out, capsys=capsys) == (0, "", f"wrote {out}\n")
    (window,) = read_windows(out)
    assert window.voltage_v is None
    slow = window.slow_voltage
    assert slow is not None
    assert (slow.begin_s, slow.period_s, slow.error_s) == (before.begin_s, 0.005, 0.0002)
    assert np.array_equal(slow.voltage_v, reported, equal_nan=True)
    documents = [json.loads(fdhil("replay", "--json", path, capsys=capsys)[1]) for path in (stored, out)]
    one, other = (document["files"][0]["outcomes"][0] for document in documents)
    assert other["parameters"]["L"]["value"] == pytest.approx(one["parameters"]["L"]["value"], rel=1e-3)
    assert other["delay_s"]["value"] == pytest.approx(one["delay_s"]["value"], abs=1e-6)
    assert (one["delay_s"]["unit"], one["validated"], other["validated"]) == ("s", True, True)
    # other programs find the current sample in each row
    voltage = read_recording(out).voltage_v
    assert voltage is not None
    assert np.isfinite(voltage).all()


@pytest.mark.parametrize("command", [["replay"], ["export", "--out", "out.csv"]])
@pytest.mark.parametrize("content", [None, b"", b"PAR1", b"\x00" * 1000])
def test_unreadable_recording_exits_3_with_one_sentence(
    content: bytes | None, command: list[str], tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "broken.parquet"
    if content is not None:
        path.write_bytes(content)
    code, out, err = fdhil(*command, path, capsys=capsys)
    assert (code, out) == (3, "")
    assert err.count("\n") == 1
    assert "broken.parquet" in err
    assert not (tmp_path / "out.csv").exists()


def test_recording_of_other_axis_is_refused(machine: Path, tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "z.parquet"
    path.write_bytes(encode_window(make_window(axis="Z"), ""))
    code, _, err = fdhil("replay", "--config", machine, path, capsys=capsys)
    assert code == 3
    assert "is of axis Z" in err


def test_history_json_has_intervals_and_full_precision(machine: Path, capsys: Any) -> None:
    code, out, _ = fdhil("history", machine, "--json", capsys=capsys)
    document = json.loads(out)
    assert (code, document["schema"]) == (0, "fdhil-history-1")
    assert [(row["axis"], row["revision"]) for row in document["revisions"]] == [("X", 1), ("X", 2), ("Y", 1)]
    reported = document["revisions"][0]["parameters"]["R"]
    assert reported["value"] == make_published(1).parameters.R
    assert document["revisions"][1]["window_ids"] == [1, 3]
    code, out, _ = fdhil("history", machine, "--json", "--axis", "Y", capsys=capsys)
    assert [row["axis"] for row in json.loads(out)["revisions"]] == ["Y"]


@pytest.mark.usefixtures("long_computation")
def test_history_prints_table_and_writes_plot(machine: Path, tmp_path: Path, capsys: Any) -> None:
    code, out, err = fdhil("history", machine, "--plot", tmp_path / "plot.SVG", capsys=capsys)
    assert (code, err) == (0, f"wrote {tmp_path / 'plot.SVG'}\n")
    assert "axis X: 2 revisions" in out
    assert "▁" in out
    assert b"<svg" in (tmp_path / "plot.SVG").read_bytes()
    code, _, err = fdhil("history", machine, "--plot", tmp_path / "no" / "such" / "plot.png", capsys=capsys)
    assert code == 3
    assert "cannot be written" in err


def test_history_shows_temperature_slopes(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    store = OutcomeStore(config_of(tmp_path, ("X", "Y")))
    store.open()
    for k in range(6):
        warm = make_outcome(of=make_window(temperature_c=20.0 + k))
        assert warm.estimate is not None
        values = warm.estimate.values * np.where(np.array(warm.estimate.names) == "ft", 1 - 0.1 * k, 1.0)
        store.store_outcomes(
            [replace(warm, estimate=replace(warm.estimate, values=freeze_array(values))), make_published(k + 1)]
        )
    store.close()
    _, out, _ = fdhil("history", path, "--json", capsys=capsys)
    reported = json.loads(out)["slopes"]["X"]
    assert reported["ft"]["per_kelvin"] == pytest.approx(-0.005)
    assert reported["ft"]["high"] < 0.0
    assert reported["Jt"]["low"] <= 0.0 <= reported["Jt"]["high"]
    assert "per kelvin of" in fdhil("history", path, capsys=capsys)[1]


def test_empty_history_is_reported(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    code, _, err = fdhil("history", path, capsys=capsys)
    assert code == 3
    assert "nothing was recorded yet" in err
    code, _, err = fdhil("history", tmp_path / "absent.toml", capsys=capsys)
    assert code == 2
    assert "cannot be read" in err


@pytest.mark.usefixtures("long_computation")
def test_report_is_one_self_contained_page(machine: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "report.html"
    code, _, err = fdhil("report", machine, "--out", out, capsys=capsys)
    assert (code, err) == (0, f"wrote {out}\n")
    page = out.read_text()
    assert "Axis X" in page
    assert "<svg" in page
    assert "<script " not in page  # no external script
    assert "default-src 'none'" in page  # the browser must not load anything


@pytest.mark.parametrize("command", ["replay", "history", "report", "export", "run", "status", "arm", "disarm"])
def test_help_is_readable_without_heavy_imports(command: str) -> None:
    result: Result = CliRunner().invoke(cli, [command, "--help"])
    assert result.exit_code == 0
    assert result.output.startswith("Usage: ")
