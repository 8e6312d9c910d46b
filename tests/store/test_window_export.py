"""A stored window is exported as a recording, exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdhil.records import freeze_array
from fdhil.store.recording_file import read_recording
from fdhil.store.window_export import convert_window, export_table
from fdhil.store.window_file import decode_window, encode_window
from tests.store.sample_records import make_window


def test_csv_has_every_sample_exactly_and_no_row_for_lost_ones(tmp_path: Path) -> None:
    made = make_window()
    path = tmp_path / "out.csv"
    export_table(convert_window(made), path)
    lines = path.read_text().splitlines()
    headers = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    body = np.loadtxt(lines, delimiter=",", skiprows=len(headers) + 1)
    kept = np.isfinite(made.speed_rad_s)
    assert headers["format"] == "fdhil-recording-1"
    assert (headers["sample_rate_hz"], headers["axis"], headers["pitch_m_per_rev"]) == ("1000", "X", "0.02")
    assert (headers["rapid_speed_m_per_s"], headers["temperature_C"]) == ("0.5", "21.37")
    assert made.voltage_v is not None
    assert np.array_equal(body[:, 1], made.voltage_v[kept])
    assert np.array_equal(body[:, 3], made.speed_rad_s[kept])
    assert np.array_equal(body[:, 4], made.position_mm[kept] / 1000)
    assert body.shape == (597, 6)
    assert np.allclose(body[:, 0], np.flatnonzero(kept) * 0.001, atol=1e-12)


def test_window_without_voltage_is_exported_and_read_back(tmp_path: Path) -> None:
    made = replace(make_window(), voltage_v=None, torque_constant_nm_per_a=0.3)
    path = tmp_path / "deaf.csv"
    export_table(convert_window(made), path)
    assert "voltage" not in path.read_text()
    read = read_recording(path)
    kept = np.isfinite(made.speed_rad_s)
    assert (read.voltage_v, read.torque_constant_nm_per_a) == (None, 0.3)
    assert np.array_equal(read.current_a[kept], made.current_a[kept])


def test_torque_constant_is_stored_with_its_window() -> None:
    made = replace(make_window(), torque_constant_nm_per_a=0.3)
    assert decode_window(encode_window(made, "c0ffee")).torque_constant_nm_per_a == 0.3
    assert b"torque_constant" not in encode_window(make_window(), "c0ffee")


def test_table_sensors_are_exported_with_lost_samples(tmp_path: Path) -> None:
    made = make_window()
    place = np.where(np.arange(made.n) % 7 == 0, np.nan, made.position_mm + 0.01)
    made = replace(made, table_mm=freeze_array(place), table_m_s2=freeze_array(np.linspace(-1.0, 1.0, made.n)))
    path = tmp_path / "table.csv"
    export_table(convert_window(made), path)
    read = read_recording(path)
    kept = np.isfinite(made.speed_rad_s)
    assert read.table_mm is not None
    assert read.table_m_s2 is not None
    assert np.array_equal(read.table_mm[kept], place[kept], equal_nan=True)
    assert read.table_m_s2[kept].tolist() == np.linspace(-1.0, 1.0, made.n)[kept].tolist()
