"""Signals of a rapid that are dead, swapped, copied or of another axis are refused by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from fdhil.cli.batch_analysis import analyse_file
from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Recording, Window, freeze_array
from fdhil.validation.signal_consistency import explain_missing_move
from fdhil.validation.window_signals import WindowSignals
from studies import real_plant
from studies.bench import Array, make_shuttle_demand
from studies.real_plant import SLOW, SLOW_LOOPS, Sensors
from studies.slow_sensor import record_slow_windows
from studies.wrong_signals import FIELDS, NAMED, PLANTS, Fault, Plant, assess_fault, list_faults

SETTINGS = Identification()


@lru_cache(maxsize=4)
def make_plant(name: str) -> Plant:
    return PLANTS[name]()


def list_refusals(recording: Recording) -> str:
    outcomes = [analyse_window(window, SETTINGS) for window in find_windows(recording)]
    _, verdict = pool_windows(outcomes, SETTINGS)
    return " ".join(reason.text for reason in verdict.reasons)


def change_signal(recording: Recording, name: str, change: Callable[[Array], Array]) -> Recording:
    values = np.array(getattr(recording, FIELDS[name]))
    corrupted: Recording = replace(recording, **{FIELDS[name]: freeze_array(change(values))})  # type: ignore[arg-type]
    return corrupted


@pytest.mark.parametrize("voltage", [True, False])
@pytest.mark.parametrize("names", [("position",), ("demand",), ("position", "demand"), ("current", "position")])
def test_constant_signal_is_named_with_travel(names: tuple[str, ...], voltage: bool) -> None:
    recording = make_plant("bench").make_recording(voltage=voltage)
    for name in names:
        recording = change_signal(recording, name, lambda values: np.full_like(values, 400.0))
    text = list_refusals(recording)
    for name in names:
        assert f"{name} stays at 400" in text
    assert "the integral of speed travels 399.9 mm" in text


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("name", ["bench", "slow", "screw"])
def test_signal_faults_never_give_silent_error(name: str) -> None:
    own = make_plant(name)
    assert assess_fault(own, own.make_recording(), Fault((), "none", {}), configured=False).result == "harmless"
    rng = np.random.default_rng(1)
    faults = [fault for fault in list_faults(own) if not fault.is_gain]
    for _ in range(6):
        one, other = rng.choice(len(faults), 2, replace=False)
        for fault in (faults[one], faults[one] & faults[other]):
            found = assess_fault(own, own.make_recording(), fault, configured=False)
            assert found.result in (NAMED, "harmless"), (fault.signals, fault.way, found)


@pytest.mark.parametrize("gains", [{"voltage": 2.0}, {"current": 2**0.5}, {"current": 0.1, "voltage": 1.5}])
def test_wrong_scale_is_named_by_data_sheet(gains: dict[str, float]) -> None:
    own = make_plant("screw")
    values = {name: getattr(own.make_recording(), FIELDS[name]) * gain for name, gain in gains.items()}
    found = assess_fault(own, own.make_recording(), Fault(tuple(gains), "scaled", values), configured=True)
    assert found.result == NAMED
    read = dict(re.findall(r"the (\w+) is read ([\d.]+) times", found.text))
    assert {name: float(gain) for name, gain in read.items()} == pytest.approx(gains, rel=0.05)


def test_current_scale_is_named_without_voltage() -> None:
    own = make_plant("screw")
    recording = own.make_recording(voltage=False)
    fault = Fault(("current",), "scaled", {"current": recording.current_a * 2.0})
    assert "the current is read 1.9" in assess_fault(own, recording, fault, configured=True).text


@pytest.mark.parametrize("change", [lambda v: 0.0 * v, lambda v: v[:1].repeat(v.size), lambda v: v / 2])
def test_missing_rapid_is_explained_by_speed_signal(change: Callable[[Array], Array]) -> None:
    recording = make_plant("bench").make_recording()
    recording = change_signal(recording, "speed", change)
    reason = explain_missing_move(recording)
    assert find_windows(recording) == []
    assert reason is not None
    assert "the position travels 400 mm" in reason.text


def test_recording_at_rest_has_no_missing_move() -> None:
    recording = make_plant("bench").make_recording()
    still = {name: freeze_array(np.full_like(getattr(recording, f), 3.0)) for name, f in FIELDS.items()}
    assert (
        explain_missing_move(replace(recording, speed_rad_s=0 * still["speed"], position_mm=still["position"])) is None
    )


def _quantise_signal(counts: int, kind: str) -> list[Window]:
    moved = real_plant.simulate_axis(SLOW, make_shuttle_demand(0.1, 0.126, 2.0), SLOW_LOOPS)
    sensors = Sensors(speed="difference" if kind == "difference" else "sensor", encoder_bits=np.log2(counts))
    recording = real_plant.make_recording(moved, SLOW, sensors, 0.126, 3)
    turn_mm = 20.0 / counts
    if kind == "rounded":
        step = 2 * np.pi / counts / moved.dt_s
        recording = replace(recording, speed_rad_s=freeze_array(np.round(moved.speed / step) * step))
    return find_windows(replace(recording, position_mm=freeze_array(np.round(moved.motor_m * 1e3 / turn_mm) * turn_mm)))


@pytest.mark.parametrize("kind", ["difference", "rounded"])
@pytest.mark.parametrize("counts", [8000, 2**17])
def test_coarse_encoder_at_constant_speed_is_accepted(counts: int, kind: str) -> None:
    for window in _quantise_signal(counts, kind):
        assert analyse_window(window, SETTINGS).verdict.reasons == ()


def test_stuck_speed_sensor_in_motion_is_named() -> None:
    recording = make_plant("slow").make_recording()
    (window,) = find_windows(recording)
    begin = WindowSignals(window, SETTINGS).motion_range[0] + 20
    speed = np.array(window.speed_rad_s)
    speed[begin : begin + 60] = speed[begin]
    text = " ".join(
        r.text for r in analyse_window(replace(window, speed_rad_s=freeze_array(speed)), SETTINGS).verdict.reasons
    )
    assert "speed" in text


def test_current_updated_every_100_ms_is_named_with_period() -> None:
    recording = make_plant("bench").make_recording(voltage=False)
    held = change_signal(recording, "current", lambda values: values[np.arange(values.size) // 50 * 50])
    assert "current changes only every 50 ms" in list_refusals(held)


def test_constant_slow_voltage_is_named() -> None:
    (window,) = record_slow_windows()
    slow = window.slow_voltage
    assert slow is not None
    dead = replace(window, slow_voltage=replace(slow, voltage_v=freeze_array(0.0 * slow.voltage_v)))
    assert "voltage stays at 0 V" in analyse_window(dead, SETTINGS).verdict.reasons[0].text


def test_identify_explains_missing_rapid(tmp_path: Path) -> None:
    own = make_plant("bench")
    run = replace(own.move, speed=0.0 * own.move.speed)
    text = real_plant.format_as_csv(run, own.machine.mechanics, Sensors(noise=0.0), own.rapid_m_s)
    (tmp_path / "dead.csv").write_text(text)
    result = analyse_file(tmp_path / "dead.csv", SETTINGS)
    assert [reason.code for reason in result.verdict.reasons] == ["NoWindow", "Implausible"]
    assert "the position travels 400 mm" in result.verdict.reasons[1].text


@pytest.fixture(scope="module")
def table_window() -> Window:
    soft = replace(SLOW, resonance_hz=60.0)
    moved = real_plant.simulate_axis(soft, make_shuttle_demand(0.1, 0.2, 2.0), SLOW_LOOPS)
    recording = real_plant.make_recording(moved, soft, Sensors(), 0.2)
    rate = np.gradient(np.gradient(moved.table_m, moved.dt_s), moved.dt_s)
    table = freeze_array(moved.table_m * 1e3 + 7.0)
    (window,) = find_windows(replace(recording, table_mm=table, table_m_s2=freeze_array(rate)))
    return window


def test_valid_table_sensors_are_used_without_warning(table_window: Window) -> None:
    good = analyse_window(table_window, SETTINGS)
    assert good.at_table is not None
    assert not any("table" in warning.text for warning in good.verdict.warnings)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("field", "change", "text"),
    [
        ("table_mm", lambda v: 0 * v, "table sensor and position differ by"),
        ("table_mm", lambda v: -v, "table sensor and position differ by"),
        ("table_mm", lambda v: 2 * v, "table sensor and position differ by"),
        ("table_m_s2", lambda v: 0 * v, "table acceleration is constant"),
        ("table_m_s2", lambda v: -v, "table acceleration is -"),
        ("table_m_s2", lambda v: v / 9.81, "table acceleration is 0.1"),
    ],
)
def test_wrong_table_sensor_is_named_and_ignored(
    table_window: Window, field: str, change: Callable[[Array], Array], text: str
) -> None:
    corrupted: Window = replace(table_window, **{field: freeze_array(change(np.array(getattr(table_window, field))))})  # type: ignore[arg-type]
    without: Window = replace(table_window, **{field: None})  # type: ignore[arg-type]
    found, expected = (analyse_window(window, SETTINGS) for window in (corrupted, without))
    assert any(text in warning.text for warning in found.verdict.warnings)
    assert found.at_table == expected.at_table
    assert found.estimate is not None
    assert expected.estimate is not None
    assert found.estimate.names == expected.estimate.names
    assert np.array_equal(found.estimate.values, expected.estimate.values)
