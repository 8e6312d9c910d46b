"""A column in another unit than its name says is reported with that unit; a correct recording never is."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import Recording, Window, freeze_array
from fdhil.store.recording_csv import parse_recording
from fdhil.validation.signal_plausibility import collect_signal_warnings
from studies import bench
from tests.identification.bench_recordings import simulate_bench_shuttle


@pytest.fixture(scope="module")
def recording() -> Recording:
    return parse_recording(bench.format_as_csv(simulate_bench_shuttle(), 0.003))


def make_window(recording: Recording) -> Window:
    return find_windows(recording)[0]


def scale_position(recording: Recording, factor: float) -> Recording:
    return replace(
        recording,
        position_mm=freeze_array(recording.position_mm * factor),
        demand_mm=freeze_array(recording.demand_mm * factor),
    )


def scale_speed(recording: Recording, factor: float) -> Recording:
    return replace(recording, speed_rad_s=freeze_array(recording.speed_rad_s * factor))


@pytest.mark.parametrize(
    ("signal", "factor", "words"),
    [
        ("position", 1e3, "travels 1000 times the integral of speed, as if the position were in mm instead of m"),
        ("position", 1e3 / 25.4, "inches"),
        ("speed", 30 / math.pi, "as if the speed were in 1/min"),
        ("speed", 180 / math.pi, "degrees per second"),
        ("position", -1.0, "as if position and speed had opposite signs"),
        ("pitch", 1e3, "as if the screw pitch were in mm instead of m, or times in ms instead of s"),
    ],
)
def test_unit_error_is_named(signal: str, factor: float, words: str, recording: Recording) -> None:
    if signal == "pitch":  # with a rapid speed in the header the reader refuses it before
        made = replace(recording, pitch_mm=recording.pitch_mm * factor, rapid_speed_rad_s=None)
    else:
        made = (scale_position if signal == "position" else scale_speed)(recording, factor)
    verdict = analyse_window(make_window(made), Identification()).verdict
    assert not verdict.accepted
    (reported,) = [reason for reason in verdict.reasons if reason.code in ("CalibrationSuspect", "Implausible")]
    assert words in reported.text


def test_temperature_in_kelvin_only_warns(recording: Recording) -> None:
    warm = make_window(replace(recording, temperature_c=294.65))
    assert analyse_window(warm, Identification()).verdict.accepted
    assert [str(reason) for reason in collect_signal_warnings(warm)] == [
        "Implausible: 294.65 degC is not a plausible machine temperature; 22 degC in kelvin?"
    ]
    assert collect_signal_warnings(make_window(replace(recording, temperature_c=60.0))) == []
