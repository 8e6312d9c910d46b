"""Random rapids as they are recorded: a drive, its move, and sensors with their noise and resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fdhil.records import Recording, VoltageSampling, freeze_array
from studies import drives
from studies.drives import Array, Drive, Move, Rng, Signals, log_uniform

SENSORS = ("voltage", "current", "speed")
MOVED = 6.0  # deviations of a reading


@dataclass(frozen=True, slots=True)
class Sensor:
    """What a sensor reads: true values (n,), its noise's standard deviation and its step, all in its unit."""

    true: Array
    noise: float
    step: float

    def read_values(self, rng: Rng) -> Array:
        """Return its readings (n,)."""
        noisy = self.true + self.noise * rng.standard_normal(self.true.size)
        readings: Array = np.round(noisy / self.step) * self.step
        return readings

    def is_moving_beyond(self, start: int, end: int) -> bool:
        """Return whether the truth moves by more over these rows than the error of a reading."""
        return float(np.ptp(self.true[start:end])) > MOVED * math.hypot(self.noise, self.step)


@dataclass(frozen=True, slots=True)
class Scene:
    """One drive, its move, and how it is recorded; sizes (voltage, current, speed) are the peaks of the good move."""

    drive: Drive
    move: Move
    dt_s: float
    sampling: VoltageSampling
    noise: float
    steps: tuple[float, float, float]
    position_step_m: float
    lead_s: float


@dataclass(frozen=True, slots=True)
class Rows:
    """What the sensors give, rows dt apart; ``moving`` and ``cruise`` are half-open rows of the true move."""

    dt_s: float
    signals: dict[str, Array]
    sensors: dict[str, Sensor]
    moving: tuple[int, int]
    cruise: tuple[int, int]

    def find_peak(self, name: str) -> float:
        """Return the largest magnitude of a signal."""
        return float(np.abs(self.signals[name]).max())

    def replace_signals(self, **signals: Array) -> Rows:
        """Return the rows with some signals replaced."""
        return replace(self, signals=self.signals | signals)


@dataclass(frozen=True, slots=True)
class FaultyRecording:
    """A recording with its fault: the severity in ``unit``, and the scene where the fault is one of the machine."""

    recording: Recording
    severity: float = 0.0
    scene: Scene | None = None


def draw_scene(rng: Rng) -> Scene:
    """Draw a drive, a rapid and a recorder."""
    move = drives.draw_move(rng)
    return Scene(
        drive=drives.draw_drive(rng, move.speed, move.acceleration),
        move=move,
        dt_s=float(rng.choice([2.5e-4, 5e-4, 1e-3, 1e-3, 1e-3, 2e-3])),
        sampling="interval_mean" if rng.random() < 0.75 else "instant",
        noise=log_uniform(rng, 0.001, 0.005),
        steps=(draw_step(rng), draw_step(rng), draw_step(rng)),
        position_step_m=float(rng.choice([1e-7, 1e-6, 1e-6, 5e-6])),
        lead_s=rng.uniform(0.05, 0.4),
    )


def draw_step(rng: Rng) -> float:
    """Draw a sensor's resolution as a share of its peak."""
    return float(rng.choice([1e-5, 1e-4, 5e-4, 2e-3]))


def demand_of(scene: Scene, *rates: Array) -> Array:
    """Return the demand of one move (or the given path speeds) between standstills."""
    moves = list(rates) or [scene.move.direction * drives.compute_path_speeds(scene.move)]
    parts = [drives.make_standstill(scene.lead_s)]
    for rate in moves:
        parts += [rate, drives.make_standstill(0.25)]
    return drives.demand_of(parts)


def measure_run(rng: Rng, scene: Scene, signals: Signals) -> Rows:
    """Return the sensors' readings of a run: noise, then resolution."""
    voltage = signals.voltage if scene.sampling == "interval_mean" else signals.voltage_instant
    sensors = {}
    sizes = (0.4, 0.4, 1.0)
    for name, true, size, step in zip(
        SENSORS, (voltage, signals.current, signals.speed), sizes, scene.steps, strict=True
    ):
        peak = float(np.abs(true).max())
        sensors[name] = Sensor(true, scene.noise * size * peak, step * peak)
    out = {name: sensor.read_values(rng) for name, sensor in sensors.items()}
    out["position"] = np.round(signals.position / scene.position_step_m) * scene.position_step_m
    out["demand"] = np.round(signals.demand / 1e-6) * 1e-6
    speed = np.abs(signals.speed)
    moving = np.flatnonzero(speed > 0.05 * speed.max())
    top = np.flatnonzero(speed > 0.95 * np.median(speed[speed > 0.7 * speed.max()]))
    return Rows(signals.dt_s, out, sensors, (int(moving[0]), int(moving[-1])), (int(top[0]), int(top[-1])))


def make_recording(scene: Scene, rows: Rows, *, says_rapid: bool = True) -> Recording:
    """Return the rows as a recording; ``says_rapid``: its header contains the rapid speed."""
    s = rows.signals
    n = s["speed"].size
    rapid = scene.move.speed / scene.drive.pitch_m * 2 * np.pi
    lost = ~np.isfinite(s["speed"]) & ~np.isfinite(s["position"])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    return Recording(
        axis="X",
        dt_s=rows.dt_s,
        time_s=freeze_array(np.arange(n) * rows.dt_s),
        voltage_v=freeze_array(s["voltage"]),
        current_a=freeze_array(s["current"]),
        speed_rad_s=freeze_array(s["speed"]),
        position_mm=freeze_array(s["position"] * 1e3),
        demand_mm=freeze_array(s["demand"] * 1e3),
        voltage_sampling=scene.sampling,
        pitch_mm=scene.drive.pitch_m * 1e3,
        rapid_speed_rad_s=rapid if says_rapid else None,
        gaps=tuple((int(a), int(b)) for a, b in edges.reshape(-1, 2)),
    )


def make_good_recording(rng: Rng) -> FaultyRecording:
    """Return a rapid, or one in each direction, without any fault."""
    scene = draw_scene(rng)
    out = drives.compute_path_speeds(scene.move)
    ways = [out, -out][: int(rng.integers(1, 3))]
    demand = demand_of(scene, *[scene.move.direction * way for way in ways])
    rows = measure_run(rng, scene, drives.simulate_loop(scene.drive, demand, scene.dt_s))
    return FaultyRecording(make_recording(scene, rows, says_rapid=bool(rng.random() < 0.8)))
