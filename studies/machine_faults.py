"""Faults of the machine and of the move: loads, friction, backlash, aborts, and what changes between two rapids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from studies import drives
from studies.drives import Array, Drive, Rng, Signals, log_uniform
from studies.scenes import FaultyRecording, Rows, Scene, demand_of, draw_scene, make_recording, measure_run
from studies.signal_faults import sign

SEAM_S = 0.2  # rest before the second of two joined runs


def of_machine(change: Callable[[Rng, Scene], tuple[Scene, Array | None, float]]) -> Callable[[Rng], FaultyRecording]:
    """Return the maker of rapids of a machine that ``change`` corrupts (its scene, a load torque per cycle)."""

    def make(rng: Rng) -> FaultyRecording:
        scene, load, severity = change(rng, draw_scene(rng))
        rows = measure_run(rng, scene, drives.simulate_loop(scene.drive, demand_of(scene), scene.dt_s, load))
        return FaultyRecording(make_recording(scene, rows), severity, scene)

    return make


def _peak_torque(scene: Scene) -> float:
    d = scene.drive
    per_m = 2 * np.pi / d.pitch_m
    return float(d.Jt * scene.move.acceleration * per_m + d.Cd + d.ft * scene.move.speed * per_m)


def _span(scene: Scene) -> tuple[int, int]:
    """Return the cycles in which the demand moves."""
    moving = np.flatnonzero(np.diff(demand_of(scene)))
    return int(moving[0]), int(moving[-1])


def cutting_load(rng: Rng, scene: Scene) -> tuple[Scene, Array, float]:
    """Share of the peak torque that a load takes for 60 to 300 ms within the move."""
    share = log_uniform(rng, 0.05, 0.25)
    load = np.zeros(demand_of(scene).size)
    a, b = _span(scene)
    length = int(min(rng.uniform(60, 300), 0.6 * (b - a)))
    start = int(rng.uniform(a + 0.1 * (b - a), b - length - 0.1 * (b - a)))
    load[start : start + length] = scene.move.direction * sign(rng) * share * _peak_torque(scene)
    return scene, load, share


def stiff_travel(rng: Rng, scene: Scene) -> tuple[Scene, Array, float]:
    """Share of the peak torque to which a load grows along the travel: a bent screw, a hose that pulls."""
    share = log_uniform(rng, 0.06, 0.25)
    a, b = _span(scene)
    course = np.clip((np.arange(demand_of(scene).size) - a) / (b - a), 0, 1)
    return scene, scene.move.direction * share * _peak_torque(scene) * course, share


def collision(rng: Rng, scene: Scene) -> tuple[Scene, Array, float]:
    """Share of the peak torque of a blow of 5 to 20 ms."""
    share = rng.uniform(0.4, 1.2)
    a, b = _span(scene)
    load = np.zeros(demand_of(scene).size)
    start = int(rng.uniform(a + 0.3 * (b - a), a + 0.7 * (b - a)))
    load[start : start + int(rng.uniform(5, 20))] = scene.move.direction * share * _peak_torque(scene)
    return scene, load, share


def stribeck(rng: Rng, scene: Scene) -> tuple[Scene, None, float]:
    """Share of the peak torque that friction has more at standstill, gone beyond 8 to 15 % of the rapid speed.

    A drive passes through a narrower range within a few rows, by an impulse that the speed's noise hides: of 10 % up to
    8 % of the speed, the noisiest windows at 2 ms show 7 deviations.
    """
    share = log_uniform(rng, 0.10, 0.25)
    top = scene.move.speed / scene.drive.pitch_m * 2 * np.pi
    drive = replace(
        scene.drive, stribeck=share * _peak_torque(scene), stribeck_speed=log_uniform(rng, 0.08, 0.15) * top
    )
    return replace(scene, drive=drive), None, share


def backlash(rng: Rng, scene: Scene) -> tuple[Scene, None, float]:
    """Micrometres of dead band between motor and table, which a move against the last one crosses."""
    um = log_uniform(rng, 100.0, 400.0)
    rad = um * 1e-6 / scene.drive.pitch_m * 2 * np.pi
    drive = replace(scene.drive, backlash_rad=rad, motor_share=rng.uniform(0.3, 0.7))
    return replace(scene, drive=drive, move=replace(scene.move, direction=-1)), None, um


def of_demand(shape: Callable[[Rng, Scene], tuple[Array, float]]) -> Callable[[Rng], FaultyRecording]:
    """Return the maker of rapids whose path speed (m/s) ``shape`` gives."""

    def make(rng: Rng) -> FaultyRecording:
        scene = draw_scene(rng)
        rates, severity = shape(rng, scene)
        demand = demand_of(scene, scene.move.direction * rates)
        rows = measure_run(rng, scene, drives.simulate_loop(scene.drive, demand, scene.dt_s))
        return FaultyRecording(make_recording(scene, rows), severity)

    return make


def no_plateau(rng: Rng, scene: Scene) -> tuple[Array, float]:
    """Share of the rapid speed that is reached, with less than 100 ms of plateau."""
    share = rng.uniform(0.4, 1.0)
    speed = share * scene.move.speed
    held = rng.uniform(0.0, 0.06)
    distance = speed * (speed / scene.move.acceleration + held)
    return drives.compute_path_speeds(replace(scene.move, speed=speed, distance=distance)), share


def override_changed(rng: Rng, scene: Scene) -> tuple[Array, float]:
    """Share by which the feed override falls during the rapid and stays."""
    drop = rng.uniform(0.2, 0.6)
    move = replace(scene.move, distance=scene.move.distance + 0.25 * scene.move.speed)
    t1 = move.speed / move.acceleration + rng.uniform(0.12, 0.2)

    def rate(t: Array) -> Array:
        return 1 - drop * np.clip((t - t1) / (drop * move.speed / move.acceleration), 0, 1)

    return _trimmed(drives.compute_path_speeds(move, rate)), drop


def hold_resumed(rng: Rng, scene: Scene) -> tuple[Array, float]:
    """Share by which a feed hold reduces the speed before it is released."""
    drop = rng.uniform(0.2, 0.95)
    move = replace(scene.move, distance=scene.move.distance + 0.25 * scene.move.speed)
    t1 = move.speed / move.acceleration + rng.uniform(0.12, 0.2)
    fall = drop * move.speed / move.acceleration
    held = rng.uniform(0.03, 0.4)

    def rate(t: Array) -> Array:
        return 1 - drop * np.clip(np.minimum((t - t1) / fall, (t1 + 2 * fall + held - t) / fall), 0, 1)

    return _trimmed(drives.compute_path_speeds(move, rate)), drop


def quick_stop(rng: Rng, scene: Scene) -> tuple[Array, float]:
    """How many times as hard as it accelerates an aborted rapid brakes."""
    factor = rng.uniform(2.5, 6.0)
    rates = drives.compute_path_speeds(scene.move)
    cut = int(rng.choice(np.flatnonzero(rates > 0.95 * rates.max())[-80:]))
    fall = rates[cut] - factor * scene.move.acceleration * drives.CYCLE_S * np.arange(1, 1000)
    return np.concatenate([rates[:cut], np.maximum(fall, 0.0), np.zeros(60)]), factor


def _trimmed(rates: Array) -> Array:
    return rates[: int(np.flatnonzero(rates > 0)[-1]) + 2]


def left_behind(rng: Rng) -> FaultyRecording:
    """Share of the travel at which the drive stops while the NC's demand goes on."""
    scene = draw_scene(rng)
    signals, share = stopped_short(rng, scene, scene.dt_s)
    return FaultyRecording(make_recording(scene, measure_run(rng, scene, signals)), share)


def stopped_short(rng: Rng, scene: Scene, dt_s: float) -> tuple[Signals, float]:
    """Return a run, rows ``dt_s`` apart, that stops at a share of the travel its demand goes on with, and the share."""
    share = rng.uniform(0.6, 0.95)
    whole = demand_of(scene)
    short = replace(scene.move, distance=share * scene.move.distance)
    stopped = demand_of(scene, short.direction * drives.compute_path_speeds(short))
    stopped = np.concatenate([stopped, np.full(max(0, whole.size - stopped.size), stopped[-1])])[: whole.size]
    signals = drives.simulate_loop(scene.drive, stopped, dt_s)
    wanted = np.interp(np.arange(signals.demand.size) * dt_s, np.arange(whole.size) * drives.CYCLE_S, whole)
    return replace(signals, demand=wanted), share


def moved(rng: Rng) -> FaultyRecording:
    """Share by which inertia, resistance or torque constant differs between two rapids of one recording."""
    scene = draw_scene(rng)
    other, amount = changed(rng, scene.drive)
    return _two(rng, scene, other, lambda rows: rows, amount)


def changed(rng: Rng, drive: Drive, names: Sequence[str] = ("Jt", "R", "K")) -> tuple[Drive, float]:
    """Return the drive with another inertia, resistance or torque constant, and the share by which it differs."""
    name = str(rng.choice(names))
    # of 286 good pairs, five standard deviations of the difference reach 8 % in R (2 ms rows), 7 % in Jt, 0.5 % in K
    amount = log_uniform(rng, 0.12, 0.5) if name == "R" else log_uniform(rng, 0.06, 0.25)
    return replace(drive, **{name: getattr(drive, name) * (1 + sign(rng) * amount)}), amount


def gain_between(rng: Rng) -> FaultyRecording:
    """Share by which a sensor's gain differs between two rapids of one recording."""
    scene = draw_scene(rng)
    name, factor = str(rng.choice(["voltage", "current"])), 1 + sign(rng) * (amount := log_uniform(rng, 0.04, 0.2))
    return _two(
        rng, scene, scene.drive, lambda rows: rows.replace_signals(**{name: rows.signals[name] * factor}), amount
    )


def _two(rng: Rng, scene: Scene, other: Drive, spoil: Callable[[Rows], Rows], severity: float) -> FaultyRecording:
    there = drives.simulate_loop(scene.drive, demand_of(scene), scene.dt_s)
    # the second run begins with no current: the seam is to lie outside the margins of the windows
    back = replace(scene, drive=other, move=drives.reverse_move(scene.move), lead_s=max(scene.lead_s, SEAM_S))
    again = spoil(measure_run(rng, back, drives.simulate_loop(other, demand_of(back), scene.dt_s)))
    first = measure_run(rng, scene, there)
    shift = float(first.signals["position"][-1] - again.signals["position"][0])
    again = again.replace_signals(position=again.signals["position"] + shift, demand=again.signals["demand"] + shift)
    joined = {name: np.concatenate([values, again.signals[name]]) for name, values in first.signals.items()}
    return FaultyRecording(make_recording(scene, first.replace_signals(**joined)), severity)
