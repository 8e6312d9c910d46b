"""A machine of HAL's own components for LinuxCNC: pid, an ideal-winding drive for current, motor, dry friction, screw.

The motor with its current loop is linear between two servo cycles; its exact step (matrix exponential) is a few sums.
Dry friction acts as one torque per cycle: the torque that would stop the axis, at most Cd.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy.linalg import expm

MOTOR = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
# heavier than in the data sheet, with friction by direction ("Cd_back": toward minus)
OTHERS = {
    "X": {"R": 0.6, "L": 0.006, "K": 0.76, "Jt": 0.09, "ft": 0.08, "Cd": 6.0, "Cd_back": 4.5},
    "Y": {"R": 0.45, "L": 0.0045, "K": 0.85, "Jt": 0.065, "ft": 0.03, "Cd": 3.0, "Cd_back": 4.0},
}
CURRENT_KP, CURRENT_KI = 12.566, 1256.64
PITCH_MM, PERIOD_S = 20.0, 0.001
SPEED_KP, POSITION_GAIN = 23.562, 50.0  # A.s/rad, 1/s
# states of the plant, and further inputs of its step: current demand and friction torque
CURRENT, INTEGRAL, SPEED, PLACE, VOLTAGE = range(5)
# noise of the sensors (peak values): A, rad/s, V
NOISE = {"current": 0.2, "speed": 0.03, "voltage": 0.5}
NAMES = ("current", "integral", "speed", "position", "voltage")


def compute_step(motor: Mapping[str, float]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return (5, 6) the next states of current, loop integral, speed, position and mean voltage.

    Columns: current, integral, speed, position, current demand and friction torque.
    """
    r, el, k, j, f = (motor[name] for name in ("R", "L", "K", "Jt", "ft"))
    a = np.zeros((7, 7))  # current, integral, speed, position, sum of the voltage; demand, torque
    voltage = np.array([-CURRENT_KP, CURRENT_KI, 0, 0, 0, CURRENT_KP, 0])
    a[0] = voltage / el
    a[0, 0] -= r / el
    a[0, 2] -= k / el
    a[1, [0, 5]] = -1, 1
    a[2, [0, 2, 6]] = k / j, -f / j, -1 / j
    a[3, 2] = PITCH_MM / (2 * math.pi)
    a[4] = voltage
    step = expm(a * PERIOD_S)[:5, [0, 1, 2, 3, 5, 6]]
    step[4] /= PERIOD_S
    return np.asarray(step)


class SumAllocator:
    """Allocates instances of sum2, and writes what they add."""

    def __init__(self, first: int = 0) -> None:
        self.lines: list[str] = []
        self.functions: list[str] = []
        self._count = first

    def add_sum(self, terms: Sequence[tuple[str, float]], out: str) -> None:
        """Let signal ``out`` be the sum of signals times gains, computed in the order of the thread."""
        first, *rest = terms
        rest = rest or [(first[0], 0.0)]
        for number, (signal, gain) in enumerate(rest):
            name = f"sum2.{self._count}"
            self._count += 1
            target = out if number == len(rest) - 1 else f"{out}-{number}"
            self.lines += [f"setp {name}.gain0 {first[1]:.17g}", f"setp {name}.gain1 {gain:.17g}"]
            self.lines += [f"net {first[0]} => {name}.in0", f"net {signal} => {name}.in1", f"net {target} {name}.out"]
            self.functions.append(name)
            first = (target, 1.0)


def write_machine_hal(axes: str, motors: Mapping[str, Mapping[str, float]]) -> str:
    """Return the HAL file of a machine with these axes, each a motor with a current-controlled drive."""
    sums = SumAllocator()
    lines = [
        f"loadrt trivkins coordinates={axes.lower()}",
        f"loadrt motmod servo_period_nsec=1000000 num_joints={len(axes)}",
        f"loadrt pid names={','.join(f'pid.{x.lower()}' for x in axes)}",
        f"loadrt limit1 count={len(axes)}",
        f"loadrt mult2 count={len(axes) * len(NOISE)}",
    ]
    wires: list[str] = []
    for joint, axis in enumerate(axes):
        wires += _write_axis(joint, axis.lower(), motors[axis], sums)
    for axis in axes:
        for name in NAMES:
            sums.add_sum([(f"{axis.lower()}-{name}-next", 1.0)], f"{axis.lower()}-{name}")
    latched = sums.functions[-len(axes) * len(NAMES) :]
    stepped = sums.functions[: -len(axes) * len(NAMES)]
    noise = SumAllocator(first=len(sums.functions))
    shown = [f"{axis.lower()}-{name}" for axis in axes for name in NOISE]
    for number, signal in enumerate(shown):
        peak = NOISE[signal.partition("-")[2]]
        _add_noise(number, signal, shown[(number + 1) % len(shown)], peak, noise)
    sums.lines += noise.lines
    order = [*latched, "motion-command-handler", "motion-controller", *(f"pid.{x.lower()}.do-pid-calcs" for x in axes)]
    order += [*_add_friction(stepped, axes), *noise.functions]
    order += [f"mult2.{number}" for number in range(len(axes) * len(NOISE))]
    lines += [f"loadrt sum2 count={len(sums.functions) + len(noise.functions)}", *sums.lines, *wires]
    lines += [f"addf {function} servo-thread" for function in order]
    lines += [
        "net stop-chain iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in",
        "net tool-prepare iocontrol.0.tool-prepare => iocontrol.0.tool-prepared",
        "net tool-change iocontrol.0.tool-change => iocontrol.0.tool-changed",
    ]
    return "\n".join(lines) + "\n"


def _add_noise(number: int, signal: str, other: str, peak: float, sums: SumAllocator) -> None:
    """Add sensor noise to a signal: of the chaotic map x' = 1 - a x^2, of two signals in turn."""
    own = f"{signal}-map"
    sums.add_sum([(f"{own}-square", -1.95 - 0.007 * number)], own)
    sums.lines += [f"setp {sums.functions[-1]}.offset 1"]
    sums.lines += [f"net {own} => mult2.{number}.in0 mult2.{number}.in1", f"net {own}-square mult2.{number}.out"]
    sums.add_sum([(signal, 1.0), (own, peak), (f"{other}-map", -peak)], f"{signal}-shown")


def _add_friction(stepped: Sequence[str], axes: str) -> Iterator[str]:
    """Put each axis' friction after the three sums that it consists of."""
    each = len(stepped) // len(axes)
    for number in range(len(axes)):
        own = stepped[number * each : (number + 1) * each]
        yield from (*own[:3], f"limit1.{number}", *own[3:])


def _write_axis(joint: int, x: str, motor: Mapping[str, float], sums: SumAllocator) -> Iterator[str]:
    step = compute_step(motor)
    states = [f"{x}-{name}" for name in NAMES]
    inputs = [states[CURRENT], states[INTEGRAL], states[SPEED], states[PLACE], f"{x}-output"]
    free = -step[SPEED] / step[SPEED, 5]
    sums.add_sum([(inputs[k], float(free[k])) for k in (0, 1, 2, 4)], f"{x}-stopping")
    yield f"net {x}-stopping => limit1.{joint}.in"
    yield f"net {x}-friction limit1.{joint}.out"
    yield f"setp limit1.{joint}.min {-motor.get('Cd_back', motor['Cd'])}"
    yield f"setp limit1.{joint}.max {motor['Cd']}"
    for state, name in enumerate(NAMES):
        if state == SPEED:
            slope = float(step[SPEED, 5])
            sums.add_sum([(f"{x}-friction", slope), (f"{x}-stopping", -slope)], f"{x}-{name}-next")
            continue
        terms = [(signal, float(step[state, k])) for k, signal in enumerate([*inputs, f"{x}-friction"])]
        sums.add_sum([(s, g) for s, g in terms if g != 0.0], f"{x}-{name}-next")
    yield f"net {x}-command joint.{joint}.motor-pos-cmd => pid.{x}.command"
    yield f"net {x}-position => joint.{joint}.motor-pos-fb pid.{x}.feedback"
    yield f"net {x}-enable joint.{joint}.amp-enable-out => pid.{x}.enable"
    yield f"net {x}-output pid.{x}.output"
    a_per_mm = SPEED_KP * 2 * math.pi / PITCH_MM
    gains = {"Pgain": a_per_mm * POSITION_GAIN, "Dgain": a_per_mm, "FF1": 0.0, "FF2": 0.0, "maxoutput": 150.0}
    gains |= {"error-previous-target": 0}
    for key, value in gains.items():
        yield f"setp pid.{x}.{key} {value:.12g}"
