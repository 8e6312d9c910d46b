"""A window with the voltage of a slow sensor is stored exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.daemon.outcome_json import build_outcome_document
from fdhil.errors import RecordingError
from fdhil.pipeline import analyse_window
from fdhil.records import Window
from fdhil.store.recording_csv import encode, parse_recording
from fdhil.store.window_export import convert_window
from fdhil.store.window_file import decode_window, encode_window
from studies.slow_sensor import record_slow_windows
from tests.polled_voltage import build_polled_windows


def test_sensor_grid_is_stored_bit_identical() -> None:
    window = record_slow_windows(0.005)[0]
    assert window.slow_voltage is not None
    back = decode_window(encode_window(window, "digest")).slow_voltage
    assert back is not None
    assert (back.begin_s, back.period_s, back.error_s) == (
        window.slow_voltage.begin_s,
        window.slow_voltage.period_s,
        window.slow_voltage.error_s,
    )
    np.testing.assert_array_equal(back.voltage_v, window.slow_voltage.voltage_v)


def test_changed_grid_is_detected_as_damage() -> None:
    content = encode_window(record_slow_windows(0.005)[0], "digest")
    assert content.count(b'"period_s": 0.005') == 1
    with pytest.raises(RecordingError, match="digest"):
        decode_window(content.replace(b'"period_s": 0.005', b'"period_s": 0.006'))


def test_document_without_voltage_has_units() -> None:
    outcome = analyse_window(replace(record_slow_windows(0.005)[0], slow_voltage=None), Identification())
    reported = build_outcome_document(outcome)["parameters"]
    assert reported["Jt/K"]["value"] == pytest.approx(0.075 / 0.8, rel=0.01)
    assert [reported[name]["unit"] for name in ("Jt/K", "ft/K", "Cd/K")] == ["A.s2/rad", "A.s/rad", "A"]
    assert reported["L"]["value"] is None
    assert "there is no voltage" in reported["L"]["reason"]


def _make_lines(window: Window) -> list[str]:
    return encode(convert_window(window)).decode().splitlines()


@pytest.mark.parametrize("period", ["5e-6", "1e-320"])
def test_samples_closer_than_the_rows_are_refused(period: str) -> None:
    lines = [line for line in _make_lines(record_slow_windows(0.005)[0]) if not line.startswith("# voltage_period_s")]
    with pytest.raises(RecordingError, match="closer than its rows"):
        parse_recording("\n".join([f"# voltage_period_s: {period}", *lines]) + "\n")


def test_sample_delays_of_a_meter_are_stored() -> None:
    window = build_polled_windows()[0]
    assert window.slow_voltage is not None
    assert window.slow_voltage.late_s is not None
    back = decode_window(encode_window(window, "digest")).slow_voltage
    assert back is not None
    assert back.late_s is not None
    np.testing.assert_array_equal(back.late_s, window.slow_voltage.late_s)
    reported = parse_recording(encode(convert_window(window)).decode()).slow_voltage
    assert reported is not None
    assert reported.late_s is not None
    np.testing.assert_array_equal(reported.late_s, window.slow_voltage.late_s)


@pytest.mark.parametrize("late", ["0.001", "nonsense", "0.009 " * 500])
def test_times_that_do_not_match_values_are_refused(late: str) -> None:
    lines = [line for line in _make_lines(build_polled_windows()[0]) if not line.startswith("# voltage_late_s")]
    with pytest.raises(RecordingError, match="invalid voltage_late_s for its voltage samples"):
        parse_recording("\n".join([f"# voltage_late_s: {late}", *lines]) + "\n")
