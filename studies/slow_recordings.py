"""Recordings whose voltage comes from a sensor slower than the drive: good ones, and one maker for each fault.

The drives, moves and other sensors are those of the verdicts' study; the voltage's sensor samples 100 to 500 times a
second on a grid of its own, up to half a sample later or earlier than it says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.records import Recording, SlowVoltage, VoltageSampling, frozen
from studies import drives, machine_faults, signal_faults
from studies.drives import Array, Rng, log_uniform
from studies.scenes import Rows, Scene, Sensor, demand_of, draw_scene, measured, recorded

PERIODS_S = (0.010, 0.005, 0.002)
GOOD = "good"
Maker = Callable[[Rng], tuple[Recording, float]]


def sampled(
    fine: Array, step_s: float, begin_s: npt.NDArray[np.floating], period_s: float, sampling: VoltageSampling
) -> Array:
    """Return what a sensor tells of a voltage held over steps of ``step_s``, of samples that begin at ``begin_s``."""
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

    def spoilt(self, voltage: Array) -> Sensed:
        """Return it with other samples."""
        return replace(self, voltage=voltage)

    @property
    def moving(self) -> tuple[int, int]:
        """Half-open samples of the true move."""
        a, b = (int(row * self.rows.dt_s / self.period_s) for row in self.rows.moving)
        return a, min(b, self.voltage.size)


def sense(rng: Rng, scene: Scene, load: Array | None = None, late: float | None = None) -> Sensed:
    """Return a run of a scene by a sensor of 100 to 500 Hz; ``late`` in its samples, drawn when left out."""
    demand = demand_of(scene)
    rows = measured(rng, scene, drives.run(scene.drive, demand, scene.dt_s, load))
    fine = drives.run(scene.drive, demand, drives.STEP_S, load).voltage
    period = float(rng.choice(PERIODS_S))
    delay = (rng.uniform(-0.5, 0.5) if late is None else late) * period
    begin = rng.uniform(0.0, period)
    count = int((rows.signals["speed"].size * rows.dt_s - begin) / period)
    told = sampled(fine, drives.STEP_S, begin - delay + np.arange(count) * period, period, scene.sampling)
    peak = float(np.abs(told).max())
    sensor = Sensor(told, scene.noise * 0.4 * peak, scene.steps[0] * peak)
    return Sensed(rows, sensor.read(rng), begin, period, sensor)


def scene_of(rng: Rng) -> Scene:
    """Draw a drive, a rapid and a recorder whose rows are closer than the sensor's samples."""
    scene = draw_scene(rng)
    return replace(scene, dt_s=min(scene.dt_s, 1e-3))


def told(scene: Scene, sensed: Sensed) -> Recording:
    """Return the recording."""
    slow = SlowVoltage(sensed.begin_s, sensed.period_s, 2e-4, frozen(sensed.voltage))
    return replace(recorded(scene, sensed.rows), slow_voltage=slow)


def _of_voltage(spoil: Callable[[Rng, Sensed], tuple[Sensed, float]]) -> Maker:
    def make(rng: Rng) -> tuple[Recording, float]:
        scene = scene_of(rng)
        spoilt, severity = spoil(rng, sense(rng, scene))
        return told(scene, spoilt), severity

    return make


def _of_rows(fault: signal_faults.SignalFault) -> Maker:
    """Spoil current or speed as the other studies do."""

    def make(rng: Rng) -> tuple[Recording, float]:
        scene = scene_of(rng)
        sensed = sense(rng, scene)
        while True:
            rows, severity = fault(rng, sensed.rows)
            if rows.signals["voltage"] is sensed.rows.signals["voltage"]:
                return told(scene, replace(sensed, rows=rows)), severity

    return make


def _of_machine(change: Callable[[Rng, Scene], tuple[Scene, Array | None, float]]) -> Maker:
    def make(rng: Rng) -> tuple[Recording, float]:
        scene, load, severity = change(rng, scene_of(rng))
        return told(scene, sense(rng, scene, load)), severity

    return make


def _voltage_gain_step(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount, (begin, end) = log_uniform(rng, 0.03, 0.2), sensed.moving
    values = sensed.voltage.copy()
    values[int(begin + rng.uniform(0.2, 0.8) * (end - begin)) :] *= 1 + signal_faults.sign(rng) * amount
    return sensed.spoilt(values), amount


def _voltage_gain_drift(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount, (begin, end) = log_uniform(rng, 0.04, 0.2), sensed.moving
    course = np.clip((np.arange(sensed.voltage.size) - begin) / (end - begin), 0, 1)
    return sensed.spoilt(sensed.voltage * (1 + signal_faults.sign(rng) * amount * course)), amount


def _voltage_offset(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount = log_uniform(rng, 0.015, 0.08)
    peak = float(np.abs(sensed.voltage).max())
    return sensed.spoilt(sensed.voltage + signal_faults.sign(rng) * amount * peak), amount


def _voltage_stuck(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    """Seconds for which the sensor repeats one value while the voltage moves."""
    begin, end = sensed.moving
    while True:
        length = max(4, round(rng.uniform(0.04, 0.1) / sensed.period_s))
        start = int(rng.uniform(begin, end - length))
        values = sensed.voltage.copy()
        if sensed.sensor.moves(start, start + length):
            break
    values[start : start + length] = values[start]
    return sensed.spoilt(values), length * sensed.period_s


def _voltage_clipped(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    cut = rng.uniform(0.1, 0.5)
    rail = (1 - cut) * float(np.abs(sensed.voltage).max())
    return sensed.spoilt(np.clip(sensed.voltage, -rail, rail)), cut


def _voltage_turned(_rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    return sensed.spoilt(-sensed.voltage), 1.0


def _voltage_late(rng: Rng) -> tuple[Recording, float]:
    scene = scene_of(rng)
    late = signal_faults.sign(rng) * rng.uniform(1.3, 4.0)
    return told(scene, sense(rng, scene, late=late)), abs(late)


def _fine(rng: Rng) -> tuple[Recording, float]:
    scene = scene_of(rng)
    return told(scene, sense(rng, scene)), 0.0


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of recording: how one is made, the codes that name its fault rightly, the severity's unit."""

    make: Maker
    named: frozenset[str]
    unit: str


def _kind(make: Maker, named: str, unit: str) -> Kind:
    return Kind(make, frozenset(named.split()), unit)


KINDS: Mapping[str, Kind] = {
    "voltage gain steps": _kind(_of_voltage(_voltage_gain_step), "CalibrationSuspect", "of the gain"),
    "voltage gain drifts": _kind(_of_voltage(_voltage_gain_drift), "CalibrationSuspect", "of the gain"),
    "voltage offset": _kind(_of_voltage(_voltage_offset), "CalibrationSuspect", "of the peak"),
    "voltage stuck": _kind(_of_voltage(_voltage_stuck), "StuckValue", "s"),
    "voltage clipped": _kind(_of_voltage(_voltage_clipped), "Saturated", "of the peak"),
    "voltage turned": _kind(_of_voltage(_voltage_turned), "Unphysical CalibrationSuspect", ""),
    "voltage late": _kind(_voltage_late, "SampleTiming", "samples"),
    "gain steps": _kind(_of_rows(signal_faults.gain_step), "CalibrationSuspect", "of the gain"),
    "gain drifts": _kind(_of_rows(signal_faults.gain_drift), "CalibrationSuspect", "of the gain"),
    "offset": _kind(_of_rows(signal_faults.offset), "CalibrationSuspect", "of the peak"),
    "stuck": _kind(_of_rows(signal_faults.stuck), "StuckValue", "s"),
    "current late": _kind(_of_rows(signal_faults.current_late), "SampleTiming", "rows"),
    "cutting load": _kind(_of_machine(machine_faults.cutting_load), "LoadDetected", "of the peak torque"),
    "stiff travel": _kind(_of_machine(machine_faults.stiff_travel), "LoadDetected", "of the peak torque"),
    "collision": _kind(_of_machine(machine_faults.collision), "LoadDetected", "of the peak torque"),
    "Stribeck friction": _kind(_of_machine(machine_faults.stribeck), "ValidationFailed", "of the peak torque"),
}


def recording_of(seed: int, study: int, kind: str) -> tuple[Recording, float]:
    """Return one recording of the study, and the severity of its fault."""
    make = _fine if kind == GOOD else KINDS[kind].make
    return make(np.random.default_rng([study, 1 if kind == GOOD else 2, seed]))
