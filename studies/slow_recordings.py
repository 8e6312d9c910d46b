"""Recordings whose voltage comes from a sensor slower than the drive: good ones, and one maker for each fault.

The drives, moves and other sensors are those of the verdicts' study; the voltage's sensor samples 100 to 500 times a
second on a grid of its own, up to half a sample later or earlier than it says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.records import SlowVoltage, VoltageSampling, freeze_array
from studies import drives, faults, machine_faults, signal_faults
from studies.drives import Array, Drive, Rng, Signals, log_uniform
from studies.faults import Kind
from studies.judging import GOOD
from studies.scenes import FaultyRecording, Rows, Scene, Sensor, demand_of, draw_scene, make_recording, measure_run

PERIODS_S = (0.010, 0.005, 0.002)
TO_AND_FRO = "to and fro"
STUCK_SAMPLES = 3  # of the voltage
Maker = Callable[[Rng], FaultyRecording]


def sample_voltage(
    fine: Array, step_s: float, begin_s: npt.NDArray[np.floating], period_s: float, sampling: VoltageSampling
) -> Array:
    """Return a sensor's samples of a voltage held over steps of ``step_s``, beginning at ``begin_s``."""
    if sampling == "instant":
        return np.asarray(fine[np.clip((begin_s / step_s + 1e-6).astype(int), 0, fine.size - 1)])
    swept = np.concatenate([[0.0], np.cumsum(fine)]) * step_s
    grid = np.arange(swept.size) * step_s
    return np.asarray((np.interp(begin_s + period_s, grid, swept) - np.interp(begin_s, grid, swept)) / period_s)


@dataclass(frozen=True, slots=True)
class Sensed:
    """What a recording is made of: the rows, and the samples of a sensor with the place that it gives them."""

    rows: Rows
    voltage: Array
    begin_s: float
    period_s: float
    sensor: Sensor

    def replace_samples(self, voltage: Array) -> Sensed:
        """Return it with other samples."""
        return replace(self, voltage=voltage)

    @property
    def moving(self) -> tuple[int, int]:
        """Half-open samples of the true move."""
        a, b = (int(row * self.rows.dt_s / self.period_s) for row in self.rows.moving)
        return a, min(b, self.voltage.size)


def record_slowly(rng: Rng, scene: Scene, fine: Signals, late: float | None = None) -> Sensed:
    """Return a run by a sensor of 100 to 500 Hz; ``late`` in its samples, drawn when left out.

    ``fine`` is the run with rows every 31.25 us.
    """
    rows = measure_run(rng, scene, resample_rows(fine, scene.dt_s))
    period = float(rng.choice(PERIODS_S))
    delay = (rng.uniform(-0.5, 0.5) if late is None else late) * period
    begin = rng.uniform(0.0, period)
    count = int((rows.signals["speed"].size * rows.dt_s - begin) / period)
    reported = sample_voltage(
        fine.voltage, drives.STEP_S, begin - delay + np.arange(count) * period, period, scene.sampling
    )
    peak = float(np.abs(reported).max())
    sensor = Sensor(reported, scene.noise * 0.4 * peak, scene.steps[0] * peak)
    return Sensed(rows, sensor.read_values(rng), begin, period, sensor)


def simulate_rapid(scene: Scene, load: Array | None = None) -> Signals:
    """Return the run of a scene's rapid, rows every 31.25 us."""
    return drives.simulate_loop(scene.drive, demand_of(scene), drives.STEP_S, load)


def resample_rows(fine: Signals, dt_s: float) -> Signals:
    """Return a run in rows ``dt_s`` apart."""
    every = round(dt_s / fine.dt_s)
    n = fine.voltage.size // every
    first = {name: getattr(fine, name)[: n * every : every] for name in ("current", "speed", "position", "demand")}
    means = fine.voltage[: n * every].reshape(n, every).mean(axis=1)
    return Signals(dt_s, means, fine.voltage_instant[: n * every : every], **first)


def draw_slow_scene(rng: Rng) -> Scene:
    """Draw a drive, a rapid and a recorder whose rows are closer than the sensor's samples."""
    scene = draw_scene(rng)
    return replace(scene, dt_s=min(scene.dt_s, 1e-3))


def make_slow_recording(
    scene: Scene, sensed: Sensed, severity: float = 0.0, *, says_rapid: bool = True
) -> FaultyRecording:
    """Return the recording with the severity of its fault."""
    slow = SlowVoltage(sensed.begin_s, sensed.period_s, 2e-4, freeze_array(sensed.voltage))
    return FaultyRecording(
        replace(make_recording(scene, sensed.rows, says_rapid=says_rapid), slow_voltage=slow), severity
    )


def _wrap_voltage_fault(spoil: Callable[[Rng, Sensed], tuple[Sensed, float]]) -> Maker:
    def make(rng: Rng) -> FaultyRecording:
        scene = draw_slow_scene(rng)
        return make_slow_recording(scene, *spoil(rng, record_slowly(rng, scene, simulate_rapid(scene))))

    return make


def _wrap_row_fault(fault: signal_faults.SignalFault) -> Maker:
    """Corrupt the rows as the other study does; the slow sensor continues by its own clock, whatever rows are lost."""

    def make(rng: Rng) -> FaultyRecording:
        scene = draw_slow_scene(rng)
        sensed = record_slowly(rng, scene, simulate_rapid(scene))
        whole = sensed.rows.signals
        numbered = sensed.rows.replace_signals(row=np.arange(whole["speed"].size, dtype=np.float64))
        while True:
            rows, severity = fault(rng, numbered)
            now = rows.signals
            kept = now["current"] is whole["current"] or now["speed"] is whole["speed"]
            if now["voltage"] is whole["voltage"] or not kept:  # what the rows tell of the voltage is not recorded
                break
        begin = sensed.begin_s - float(now["row"][0]) * rows.dt_s
        return make_slow_recording(scene, replace(sensed, rows=rows, begin_s=begin), severity)

    return make


def _wrap_machine_fault(change: Callable[[Rng, Scene], tuple[Scene, Array | None, float]]) -> Maker:
    def make(rng: Rng) -> FaultyRecording:
        scene, load, severity = change(rng, draw_slow_scene(rng))
        return make_slow_recording(scene, record_slowly(rng, scene, simulate_rapid(scene, load)), severity)

    return make


def _wrap_demand_fault(shape: Callable[[Rng, Scene], tuple[Array, float]]) -> Maker:
    def make(rng: Rng) -> FaultyRecording:
        scene = draw_slow_scene(rng)
        rates, severity = shape(rng, scene)
        demand = demand_of(scene, scene.move.direction * rates)
        return make_slow_recording(
            scene, record_slowly(rng, scene, drives.simulate_loop(scene.drive, demand, drives.STEP_S)), severity
        )

    return make


def _stuck(rng: Rng) -> FaultyRecording:
    """Seconds for which current or speed repeats one value while it moves; the voltage must have seen it thrice."""
    while True:
        scene = draw_slow_scene(rng)
        sensed = record_slowly(rng, scene, simulate_rapid(scene))
        rows, severity = signal_faults.stuck(rng, sensed.rows)
        if rows.signals["voltage"] is sensed.rows.signals["voltage"] and severity > STUCK_SAMPLES * sensed.period_s:
            return make_slow_recording(scene, replace(sensed, rows=rows), severity)


def _left_behind(rng: Rng) -> FaultyRecording:
    scene = draw_slow_scene(rng)
    signals, share = machine_faults.stopped_short(rng, scene, drives.STEP_S)
    return make_slow_recording(scene, record_slowly(rng, scene, signals), share)


def _moved(rng: Rng) -> FaultyRecording:
    scene = draw_slow_scene(rng)
    # a pair of windows that each tell R to the 10 % of what is published differ by chance up to 70 %
    other, amount = machine_faults.changed(rng, scene.drive, ("Jt", "K"))
    signals, _ = _simulate_both_ways(scene, other)
    return make_slow_recording(scene, record_slowly(rng, scene, signals), amount)


def _gain_between(rng: Rng) -> FaultyRecording:
    """Share by which the gain of voltage or current differs between two rapids of one recording."""
    scene, of_voltage = draw_slow_scene(rng), bool(rng.random() < 0.5)
    factor = 1 + signal_faults.sign(rng) * (amount := log_uniform(rng, 0.04, 0.2))
    signals, seam_s = _simulate_both_ways(scene, scene.drive)
    sensed = record_slowly(rng, scene, signals)
    if of_voltage:
        later = sensed.begin_s + np.arange(sensed.voltage.size) * sensed.period_s > seam_s
        return make_slow_recording(scene, sensed.replace_samples(np.where(later, factor, 1.0) * sensed.voltage), amount)
    current = sensed.rows.signals["current"]
    later = np.arange(current.size) * scene.dt_s > seam_s
    rows = sensed.rows.replace_signals(current=np.where(later, factor, 1.0) * current)
    return make_slow_recording(scene, replace(sensed, rows=rows), amount)


def _simulate_both_ways(scene: Scene, other: Drive) -> tuple[Signals, float]:
    """Return the run of a rapid and, by the drive ``other``, of its way back, and when the second begins."""
    back = replace(
        scene, drive=other, move=drives.reverse_move(scene.move), lead_s=max(scene.lead_s, machine_faults.SEAM_S)
    )
    first, again = simulate_rapid(scene), simulate_rapid(back)
    shift = first.position[-1] - again.position[0]
    again = replace(again, position=again.position + shift, demand=again.demand + shift)
    names = ("voltage", "voltage_instant", "current", "speed", "position", "demand")
    joined = {name: np.concatenate([getattr(first, name), getattr(again, name)]) for name in names}
    return Signals(drives.STEP_S, **joined), first.voltage.size * drives.STEP_S


def _voltage_gain_step(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount, (begin, end) = log_uniform(rng, 0.03, 0.2), sensed.moving
    values = sensed.voltage.copy()
    values[int(begin + rng.uniform(0.2, 0.8) * (end - begin)) :] *= 1 + signal_faults.sign(rng) * amount
    return sensed.replace_samples(values), amount


def _voltage_gain_drift(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount, (begin, end) = log_uniform(rng, 0.04, 0.2), sensed.moving
    course = np.clip((np.arange(sensed.voltage.size) - begin) / (end - begin), 0, 1)
    return sensed.replace_samples(sensed.voltage * (1 + signal_faults.sign(rng) * amount * course)), amount


def _voltage_offset(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount = log_uniform(rng, 0.015, 0.08)
    peak = float(np.abs(sensed.voltage).max())
    return sensed.replace_samples(sensed.voltage + signal_faults.sign(rng) * amount * peak), amount


def _voltage_offset_drift(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount = log_uniform(rng, 0.03, 0.10) * signal_faults.sign(rng)
    course = np.linspace(0.0, amount * float(np.abs(sensed.voltage).max()), sensed.voltage.size)
    return sensed.replace_samples(sensed.voltage + course), abs(amount)


def _voltage_lagging(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    """Samples of the sensor's own low-pass time constant."""
    samples = rng.uniform(2.5, 10)
    values, pole = sensed.voltage.copy(), float(np.exp(-1 / samples))
    for k in range(1, values.size):
        values[k] = pole * values[k - 1] + (1 - pole) * values[k]
    return sensed.replace_samples(values), samples


def _voltage_stuck(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    """Seconds for which the sensor repeats one value while the voltage moves."""
    begin, end = sensed.moving
    while True:
        length = max(4, round(rng.uniform(0.04, 0.1) / sensed.period_s))
        start = int(rng.uniform(begin, end - length))
        values = sensed.voltage.copy()
        if sensed.sensor.is_moving_beyond(start, start + length):
            break
    values[start : start + length] = values[start]
    return sensed.replace_samples(values), length * sensed.period_s


def _voltage_clipped(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    cut = rng.uniform(0.1, 0.5)
    rail = (1 - cut) * float(np.abs(sensed.voltage).max())
    return sensed.replace_samples(np.clip(sensed.voltage, -rail, rail)), cut


def _voltage_turned(_rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    return sensed.replace_samples(-sensed.voltage), 1.0


def _voltage_late(rng: Rng) -> FaultyRecording:
    scene = draw_slow_scene(rng)
    late = signal_faults.sign(rng) * rng.uniform(1.3, 4.0)
    return make_slow_recording(scene, record_slowly(rng, scene, simulate_rapid(scene), late=late), abs(late))


def _good(rng: Rng) -> FaultyRecording:
    scene = draw_slow_scene(rng)
    return make_slow_recording(scene, record_slowly(rng, scene, simulate_rapid(scene)))


def _make_two_rapids(rng: Rng) -> FaultyRecording:
    """Return two rapids of a recording without the rapid speed in its header."""
    scene = draw_slow_scene(rng)
    signals, _ = _simulate_both_ways(scene, scene.drive)
    return make_slow_recording(scene, record_slowly(rng, scene, signals), says_rapid=False)


def _make_kind(make: Maker, named: str, unit: str, matrix: str) -> Kind:
    return Kind(make, frozenset(named.split()), unit, matrix)


def _adapt_row_fault(name: str, fault: signal_faults.SignalFault) -> Kind:
    """Return a kind of the other study, of current or speed."""
    return replace(faults.KINDS[name], make=_wrap_row_fault(fault))


def _adapt_machine_fault(name: str, change: Callable[[Rng, Scene], tuple[Scene, Array | None, float]]) -> Kind:
    return replace(faults.KINDS[name], make=_wrap_machine_fault(change))


def _adapt_demand_fault(name: str, shape: Callable[[Rng, Scene], tuple[Array, float]]) -> Kind:
    return replace(faults.KINDS[name], make=_wrap_demand_fault(shape))


KINDS: Mapping[str, Kind] = {
    "voltage gain steps": _make_kind(
        _wrap_voltage_fault(_voltage_gain_step), "CalibrationSuspect", "of the gain", "C8"
    ),
    "voltage gain drifts": _make_kind(
        _wrap_voltage_fault(_voltage_gain_drift), "CalibrationSuspect", "of the gain", "C8"
    ),
    "voltage offset": _make_kind(_wrap_voltage_fault(_voltage_offset), "CalibrationSuspect", "of the peak", "C8"),
    "voltage offset drifts": _make_kind(
        _wrap_voltage_fault(_voltage_offset_drift), "CalibrationSuspect", "of the peak", "C8"
    ),
    "voltage stuck": _make_kind(_wrap_voltage_fault(_voltage_stuck), "StuckValue", "s", "B11"),
    "voltage clipped": _make_kind(_wrap_voltage_fault(_voltage_clipped), "Saturated", "of the peak", "C1"),
    "voltage turned": _make_kind(_wrap_voltage_fault(_voltage_turned), "Unphysical CalibrationSuspect", "", "D3"),
    "voltage late": _make_kind(_voltage_late, "SampleTiming", "samples", "B12"),
    "voltage lags": _make_kind(
        _wrap_voltage_fault(_voltage_lagging), "SampleTiming ValidationFailed", "samples", "B12"
    ),
    "sensor clipped": _adapt_row_fault("sensor clipped", signal_faults.clipped),
    "not finite": _adapt_row_fault("not finite", signal_faults.not_finite),
    "late trigger": _adapt_row_fault("late trigger", signal_faults.late_trigger),
    "ends early": _adapt_row_fault("ends early", signal_faults.ends_early),
    "no plateau": _adapt_demand_fault("no plateau", machine_faults.no_plateau),
    "cutting load": _adapt_machine_fault("cutting load", machine_faults.cutting_load),
    "stiff travel": _adapt_machine_fault("stiff travel", machine_faults.stiff_travel),
    "collision": _adapt_machine_fault("collision", machine_faults.collision),
    "override changed": _adapt_demand_fault("override changed", machine_faults.override_changed),
    "feed hold": _adapt_demand_fault("feed hold", machine_faults.hold_resumed),
    "quick stop": _adapt_demand_fault("quick stop", machine_faults.quick_stop),
    "left behind": replace(faults.KINDS["left behind"], make=_left_behind),
    "gain step": _adapt_row_fault("gain step", signal_faults.gain_step),
    "gain drift": _adapt_row_fault("gain drift", signal_faults.gain_drift),
    "offset": _adapt_row_fault("offset", signal_faults.offset),
    "offset drift": _adapt_row_fault("offset drift", signal_faults.offset_drift),
    "speed scale": _adapt_row_fault("speed scale", signal_faults.speed_scale),
    "gain between rapids": replace(faults.KINDS["gain between rapids"], make=_gain_between),
    "constant speed": _adapt_row_fault("constant speed", signal_faults.constant_speed),
    "wrong sign": _adapt_row_fault("wrong sign", signal_faults.wrong_sign),
    "swapped columns": _adapt_row_fault("swapped columns", signal_faults.swapped_columns),
    "parameter moved": replace(faults.KINDS["parameter moved"], make=_moved),
    "Stribeck friction": _adapt_machine_fault("Stribeck friction", machine_faults.stribeck),
    "backlash": _adapt_machine_fault("backlash", machine_faults.backlash),
    "frames lost": _adapt_row_fault("frames lost", signal_faults.frames_lost),
    "counted gap": _adapt_row_fault("counted gap", signal_faults.counted_gap),
    "stuck value": replace(faults.KINDS["stuck value"], make=_stuck),
    "current late": replace(_adapt_row_fault("current late", signal_faults.current_late), unit="rows"),
    "lagging sensor": replace(_adapt_row_fault("lagging sensor", signal_faults.lagging_sensor), unit="rows"),
}
_GOOD: Mapping[str, Maker] = {GOOD: _good, TO_AND_FRO: _make_two_rapids}


def make_study_recording(seed: int, study: int, kind: str) -> FaultyRecording:
    """Return one recording of the study with the severity of its fault."""
    make = _GOOD[kind] if kind in _GOOD else KINDS[kind].make
    return make(np.random.default_rng([study, 1 if kind in _GOOD else 2, seed]))
