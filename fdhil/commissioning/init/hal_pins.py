"""Propose an axis' HAL pins, and the gains of the pid component before its drive, from LinuxCNC's files.

The joint's feedback names the component that measures it; the other pins of that component are in ``hal_pins.toml``. If
HAL runs, only existing pins are proposed. Pure.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

from fdhil.commissioning.init.linuxcnc_text import Hal, finite
from fdhil.commissioning.init.told import Told, rounded

SIGNALS = ("speed", "current", "torque", "voltage")
CONSUMERS = re.compile(r"(pid|joint|axis|halui|sampler|at_pid)\b.*|.*\.(feedback|command|in|in\d+)$")


@dataclass(slots=True)
class Proposal:
    """Values by their key of [axis.X], for example ``drive.hal.speed``, and remarks."""

    told: dict[str, Told] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@cache
def _components() -> tuple[Mapping[str, Any], ...]:
    text = files("fdhil.commissioning.init").joinpath("hal_pins.toml").read_text("utf-8")
    return tuple(tomllib.loads(text)["component"])


def propose_axis(hal: Hal, axis: str, joint: int, unit_mm: float, running: Collection[str] = ()) -> Proposal:
    """Return the pins and gains of an axis; ``running`` are the pins of the running HAL, empty if it does not run."""
    made = Proposal()
    source = "LinuxCNC: HAL files"
    command, feedback = (f"joint.{joint}.motor-pos-{end}" for end in ("cmd", "fb"))
    made.told["drive.hal.position_command"] = Told(command, source)
    measured = next((pin for pin in hal.joined(feedback) if not CONSUMERS.match(pin)), None)
    if measured is None:
        made.notes.append(
            f"axis {axis}: no component's pin is connected to {feedback}; name the pin of the measured position"
        )
    else:
        made.told["drive.hal.position_feedback"] = Told(measured, source)
        _of_component(made, axis, measured.rpartition(".")[0], unit_mm, running)
    made.told["drive.hal.enabled"] = Told(f"joint.{joint}.amp-enable-out", "LinuxCNC: the joint's enable")
    if unit_mm != 1.0:
        made.told["drive.hal.position_mm_per_unit"] = Told(unit_mm, "LinuxCNC: [TRAJ] LINEAR_UNITS")
    for loop in hal.loops_behind(command)[:1]:
        made.told |= {f"regulators.{key}": gain for key, gain in _gains(hal.given, loop, unit_mm)}
        made.notes.append(
            f"axis {axis}: HAL's {loop} closes the position loop. Its output is read as a speed in units/s; if the "
            "drive reads it as a current, set regulators.pid_output = 'current' and drive.hal.current = "
            f"'{loop}.output' (docs/how-to/hal-mesa.md has the gains for it)"
        )
    return made


def _of_component(made: Proposal, axis: str, owner: str, unit_mm: float, running: Collection[str]) -> None:
    known = next((c for c in _components() if re.fullmatch(c["feedback"], owner)), None)
    if known is None:
        made.notes.append(
            f"axis {axis}: component {owner} is unknown; name its pins of speed, and of current or torque"
        )
        return
    for signal in SIGNALS:
        pins = [f"{owner}.{name}" for name in known.get(signal, ()) if not running or f"{owner}.{name}" in running]
        if signal == "torque" and "drive.hal.current" in made.told:
            continue
        if pins:
            made.told[f"drive.hal.{signal}"] = Told(pins[0], f"guessed: {known['title']}", guessed=True)
    if unit_mm != 1.0 and "drive.hal.speed" in made.told:
        made.told["drive.hal.speed_mm_s_per_unit"] = Told(unit_mm, "LinuxCNC: [TRAJ] LINEAR_UNITS")
    made.notes.append(f"axis {axis}: {known['title']}: {known['unknown']}")


def _gains(given: Mapping[str, str], loop: str, unit_mm: float) -> Iterator[tuple[str, Told]]:
    """Yield the keys of structure linuxcnc_pid with a speed output: gains per unit are then gains per mm."""
    yield "structure", Told("linuxcnc_pid", f"LinuxCNC: HAL's {loop}")
    keys = {
        "position_gain_per_s": ("Pgain", 1.0),
        "position_ki_per_s2": ("Igain", 1.0),
        "position_derivative": ("Dgain", 1.0),
        "position_feedforward_per_s": ("FF0", 1.0),
        "speed_feedforward": ("FF1", 1.0),
        "acceleration_feedforward_s": ("FF2", 1.0),
        "jerk_feedforward_s2": ("FF3", 1.0),
        "deadband_mm": ("deadband", unit_mm),
        "output_limit_mm_s": ("maxoutput", unit_mm),
    }
    for key, (name, scale) in keys.items():
        value = finite(given.get(f"{loop}.{name}", "0"))
        if value is not None and (value or key == "speed_feedforward"):
            yield key, Told(rounded(value * scale), f"LinuxCNC: {loop}.{name}")
    if finite(given.get(f"{loop}.error-previous-target", "1")) == 0.0 or given.get(
        f"{loop}.error-previous-target", ""
    ).upper().startswith("F"):
        yield "error_previous_target", Told(False, f"LinuxCNC: {loop}.error-previous-target")


def current_gains(gains: Mapping[str, Any], a_per_unit: float, unit_mm: float, pitch_mm: float) -> dict[str, float]:
    """Convert the keys of a pid with a speed output to those of one whose output the drive reads as a current.

    speed_kp (A.s/rad) is the component's Dgain, by which all its other gains are divided. ValueError without a Dgain.
    """
    derivative = float(gains.get("position_derivative", 0.0))
    if derivative <= 0.0:
        raise ValueError("a pid that commands current needs a Dgain")
    speed_kp = derivative * abs(a_per_unit) / unit_mm * pitch_mm / (2 * math.pi)
    scaled: tuple[str, ...]
    scaled = ("position_gain_per_s", "position_ki_per_s2", "position_feedforward_per_s", "speed_feedforward")
    scaled += ("acceleration_feedforward_s", "jerk_feedforward_s2", "output_limit_mm_s")
    found = {key: rounded(float(gains[key]) / derivative) for key in scaled if key in gains}
    return found | {"speed_kp": rounded(speed_kp), "speed_ki": 0.0, "position_derivative": 1.0}
