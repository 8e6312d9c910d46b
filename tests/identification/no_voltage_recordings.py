"""Recordings without a voltage: a ball-screw axis in a P-P cascade, simulated by the studies' own plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from fdhil.identification.rapid_windows import find_windows
from fdhil.records import Recording, Window
from studies import real_plant
from studies.bench import Array
from studies.real_plant import Mechanics

# 95 kg on a 10 mm screw, 20 N dry and 204 N.s/m viscous friction, 3 N constant load
TO_TORQUE = 0.01 / (2 * np.pi)
RAPID_M_S = 0.15
SCREW = Mechanics(
    R=0.5,
    L=0.002,
    K=0.3,
    Jt=95.1 * TO_TORQUE**2,
    ft=203.5 * TO_TORQUE**2,
    Cd=20.4 * TO_TORQUE,
    pitch_m=0.01,
    static=-0.2,
    static_speed_rad_s=12.0,
    load_nm=-3.2 * TO_TORQUE,
    screw_ripple=0.02,
)
LOOPS = real_plant.Loops(
    position_gain_per_s=160.0,
    speed_feedforward=0.0,
    speed_kp=2 * np.pi * 25 * SCREW.Jt / SCREW.K,
    speed_ki=0.0,
    current_kp=2 * np.pi * 400 * SCREW.L,
    current_ki=2 * np.pi * 400 * SCREW.R,
)
SENSORS = real_plant.Sensors(noise=1e-4, speed="middle", encoder_bits=16)


# [axis.X] of that machine; its data sheet has another winding and K
SECTION: Mapping[str, Any] = {
    "screw_pitch_mm": 10.0,
    "rapid_speed_mm_s": 150.0,
    "nominal": {"R": 0.6, "L": 0.003, "K": 0.33, "Jt": 2e-4, "ft": 5e-4, "Cd": 0.03},
    "regulators": {
        "position_gain_per_s": LOOPS.position_gain_per_s,
        "speed_feedforward": 0.0,
        "speed_kp": LOOPS.speed_kp,
        "speed_ki": 0.0,
        "speed_period_s": 0.00025,
        "current_limit_a": LOOPS.current_limit_a,
        "current_kp": LOOPS.current_kp,
        "current_ki": LOOPS.current_ki,
        "current_period_s": 3.125e-5,
        "voltage_limit_v": LOOPS.voltage_limit_v,
    },
}


def build_shuttle_demand(
    moves: int, distance_m: float = 0.2, speed_m_s: float = RAPID_M_S, rate_m_s2: float = 1.0
) -> Array:
    """Return a demand (n,) of trapezoidal moves, m, with 0.35 s of rest between them."""
    ramp = np.linspace(0.0, speed_m_s, round(speed_m_s / rate_m_s2 * 1e3), endpoint=False)
    held = np.full(round((distance_m / speed_m_s - speed_m_s / rate_m_s2) * 1e3), speed_m_s)
    move = np.cumsum(np.concatenate([ramp, held, speed_m_s - ramp]))
    rest, places = np.zeros(350), [0.0]
    parts = [rest]
    for k in range(moves):
        side = 1.0 if k % 2 == 0 else -1.0
        parts.append(places[-1] + side * distance_m * move / move[-1])
        places.append(places[-1] + side * distance_m)
        parts.append(places[-1] + rest)
    return np.concatenate(parts)


@lru_cache(maxsize=4)
def simulate_screw_axis(moves: int = 4, mechanics: Mechanics = SCREW) -> real_plant.Run:
    """Simulate the ball-screw axis without noise."""
    return real_plant.simulate_axis(mechanics, build_shuttle_demand(moves), LOOPS)


def format_screw_csv(moves: int = 4, seed: int = 0) -> str:
    """Return its recording as text, with the torque constant in a header."""
    return real_plant.format_as_csv(simulate_screw_axis(moves), SCREW, SENSORS, RAPID_M_S, seed, voltage=False)


def record_screw_axis(moves: int = 4, seed: int = 0, mechanics: Mechanics = SCREW, **sensors: Any) -> Recording:
    run, reported = simulate_screw_axis(moves, mechanics), replace(SENSORS, **sensors)
    read = real_plant.make_recording(run, mechanics, reported, RAPID_M_S, seed, voltage=False)
    return replace(read, torque_constant_nm_per_a=mechanics.K)


def find_screw_windows(moves: int = 4, seed: int = 0, mechanics: Mechanics = SCREW, **sensors: Any) -> list[Window]:
    return find_windows(record_screw_axis(moves, seed, mechanics, **sensors))
