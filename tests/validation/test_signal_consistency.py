"""Signals of a rapid that are dead, swapped, copied or of another axis are refused by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from fdhil.cli.batch import analyse_file
from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse, pool
from fdhil.records import Recording, Window, freeze_array
from fdhil.validation.signal_consistency import missing_move
from fdhil.validation.window_signals import WindowSignals
from studies import real_plant
from studies.bench import Array, shuttle
from studies.real_plant import SLOW, SLOW_LOOPS, Sensors
from studies.slow_sensor import slow_windows
from studies.wrong_signals import FIELDS, NAMED, PLANTS, Fault, Plant, faults_of, judge

SETTINGS = Identification()


@lru_cache(maxsize=4)
def plant(name: str) -> Plant:
    return PLANTS[name]()


def refusals(recording: Recording) -> str:
    outcomes = [analyse(window, SETTINGS) for window in find_windows(recording)]
    _, verdict = pool(outcomes, SETTINGS)
    return " ".join(reason.text for reason in verdict.reasons)


def changed(recording: Recording, name: str, change: Callable[[Array], Array]) -> Recording:
    values = np.array(getattr(recording, FIELDS[name]))
    spoilt: Recording = replace(recording, **{FIELDS[name]: freeze_array(change(values))})  # type: ignore[arg-type]
    return spoilt


@pytest.mark.parametrize("voltage", [True, False])
@pytest.mark.parametrize("names", [("position",), ("demand",), ("position", "demand"), ("current", "position")])
def test_dead_signals_are_named_with_what_the_speed_travels(names: tuple[str, ...], voltage: bool) -> None:
    recording = plant("bench").recording(voltage=voltage)
    for name in names:
        recording = changed(recording, name, lambda values: np.full_like(values, 400.0))
    text = refusals(recording)
    for name in names:
        assert f"{name} stays at 400" in text
    assert "the integral of speed travels 399.9 mm" in text


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("name", ["bench", "slow", "screw"])
def test_faults_of_one_and_two_signals_are_never_wrong_in_silence(name: str) -> None:
    own = plant(name)
    assert judge(own, own.recording(), Fault((), "none", {}), configured=False).result == "harmless"
    rng = np.random.default_rng(1)
    faults = [fault for fault in faults_of(own) if not fault.is_gain]
    for _ in range(6):
        one, other = rng.choice(len(faults), 2, replace=False)
        for fault in (faults[one], faults[one] & faults[other]):
            found = judge(own, own.recording(), fault, configured=False)
            assert found.result in (NAMED, "harmless"), (fault.signals, fault.way, found)


@pytest.mark.parametrize("gains", [{"voltage": 2.0}, {"current": 2**0.5}, {"current": 0.1, "voltage": 1.5}])
def test_wrong_scales_are_named_against_the_data_sheet(gains: dict[str, float]) -> None:
    own = plant("screw")
    values = {name: getattr(own.recording(), FIELDS[name]) * gain for name, gain in gains.items()}
    found = judge(own, own.recording(), Fault(tuple(gains), "scaled", values), configured=True)
    assert found.result == NAMED
    read = dict(re.findall(r"the (\w+) is read ([\d.]+) times", found.text))
    assert {name: float(gain) for name, gain in read.items()} == pytest.approx(gains, rel=0.05)


def test_current_scale_is_named_without_a_voltage() -> None:
    own = plant("screw")
    recording = own.recording(voltage=False)
    fault = Fault(("current",), "scaled", {"current": recording.current_a * 2.0})
    assert "the current is read 1.9" in judge(own, recording, fault, configured=True).text


@pytest.mark.parametrize("change", [lambda v: 0.0 * v, lambda v: v[:1].repeat(v.size), lambda v: v / 2])
def test_speed_that_hides_the_rapid_is_named(change: Callable[[Array], Array]) -> None:
    recording = plant("bench").recording()
    recording = changed(recording, "speed", change)
    reason = missing_move(recording)
    assert find_windows(recording) == []
    assert reason is not None
    assert "the position travels 400 mm" in reason.text


def test_recording_at_rest_hides_no_rapid() -> None:
    recording = plant("bench").recording()
    still = {name: freeze_array(np.full_like(getattr(recording, f), 3.0)) for name, f in FIELDS.items()}
    assert missing_move(replace(recording, speed_rad_s=0 * still["speed"], position_mm=still["position"])) is None


def _coarse(counts: int, kind: str) -> list[Window]:
    moved = real_plant.run(SLOW, shuttle(0.1, 0.126, 2.0), SLOW_LOOPS)
    sensors = Sensors(speed="difference" if kind == "difference" else "sensor", encoder_bits=np.log2(counts))
    recording = real_plant.recording(moved, SLOW, sensors, 0.126, 3)
    turn_mm = 20.0 / counts
    if kind == "rounded":
        step = 2 * np.pi / counts / moved.dt_s
        recording = replace(recording, speed_rad_s=freeze_array(np.round(moved.speed / step) * step))
    return find_windows(replace(recording, position_mm=freeze_array(np.round(moved.motor_m * 1e3 / turn_mm) * turn_mm)))


@pytest.mark.parametrize("kind", ["difference", "rounded"])
@pytest.mark.parametrize("counts", [8000, 2**17])
def test_coarse_encoder_at_constant_speed_is_not_stuck(counts: int, kind: str) -> None:
    for window in _coarse(counts, kind):
        assert analyse(window, SETTINGS).verdict.reasons == ()


def test_speed_sensor_that_sticks_while_the_axis_goes_on_is_named() -> None:
    recording = plant("slow").recording()
    (window,) = find_windows(recording)
    begin = WindowSignals(window, SETTINGS).motion_range[0] + 20
    speed = np.array(window.speed_rad_s)
    speed[begin : begin + 60] = speed[begin]
    text = " ".join(r.text for r in analyse(replace(window, speed_rad_s=freeze_array(speed)), SETTINGS).verdict.reasons)
    assert "speed" in text


def test_current_that_changes_every_tenth_of_a_second_is_named_with_its_period() -> None:
    recording = plant("bench").recording(voltage=False)
    held = changed(recording, "current", lambda values: values[np.arange(values.size) // 50 * 50])
    assert "current changes only every 50 ms" in refusals(held)


def test_slow_voltage_that_stands_still_is_named() -> None:
    (window,) = slow_windows()
    slow = window.slow_voltage
    assert slow is not None
    dead = replace(window, slow_voltage=replace(slow, voltage_v=freeze_array(0.0 * slow.voltage_v)))
    assert "voltage stays at 0 V" in analyse(dead, SETTINGS).verdict.reasons[0].text


def test_identify_names_the_speed_that_hides_a_rapid(tmp_path: Path) -> None:
    own = plant("bench")
    run = replace(own.move, speed=0.0 * own.move.speed)
    text = real_plant.as_csv(run, own.machine.mechanics, Sensors(noise=0.0), own.rapid_m_s)
    (tmp_path / "dead.csv").write_text(text)
    result = analyse_file(tmp_path / "dead.csv", SETTINGS)
    assert [reason.code for reason in result.verdict.reasons] == ["NoWindow", "Implausible"]
    assert "the position travels 400 mm" in result.verdict.reasons[1].text


@pytest.fixture(scope="module")
def at_table() -> Window:
    soft = replace(SLOW, resonance_hz=60.0)
    moved = real_plant.run(soft, shuttle(0.1, 0.2, 2.0), SLOW_LOOPS)
    recording = real_plant.recording(moved, soft, Sensors(), 0.2)
    rate = np.gradient(np.gradient(moved.table_m, moved.dt_s), moved.dt_s)
    table = freeze_array(moved.table_m * 1e3 + 7.0)
    (window,) = find_windows(replace(recording, table_mm=table, table_m_s2=freeze_array(rate)))
    return window


def test_good_table_sensors_are_used_without_a_warning(at_table: Window) -> None:
    good = analyse(at_table, SETTINGS)
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
def test_wrong_table_sensor_is_named_and_not_used(
    at_table: Window, field: str, change: Callable[[Array], Array], text: str
) -> None:
    spoilt: Window = replace(at_table, **{field: freeze_array(change(np.array(getattr(at_table, field))))})  # type: ignore[arg-type]
    without: Window = replace(at_table, **{field: None})  # type: ignore[arg-type]
    found, expected = (analyse(window, SETTINGS) for window in (spoilt, without))
    assert any(text in warning.text for warning in found.verdict.warnings)
    assert found.at_table == expected.at_table
    assert found.estimate is not None
    assert expected.estimate is not None
    assert found.estimate.names == expected.estimate.names
    assert np.array_equal(found.estimate.values, expected.estimate.values)
