"""Propose an axis' HAL pins, and the gains of the pid component before its drive, from LinuxCNC's files.

The joint's feedback names the component that measures it; the other pins of that component are in
``build_hal_pins.toml``. If HAL runs, only existing pins are proposed. Pure.
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

from fdhil.commissioning.init.linuxcnc_text import HalNetlist, parse_finite
from fdhil.commissioning.init.sourced_value import SourcedValue, round_to_six_digits

SIGNALS = ("speed", "current", "torque", "voltage")
CONSUMERS = re.compile(r"(pid|joint|axis|halui|sampler|at_pid)\b.*|.*\.(feedback|command|in|in\d+)$")


@dataclass(slots=True)
class AxisProposal:
    """Values by their key of [axis.X], for example ``drive.hal.speed``, and remarks."""

    proposed_values: dict[str, SourcedValue] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@cache
def _load_components() -> tuple[Mapping[str, Any], ...]:
    text = files("fdhil.commissioning.init").joinpath("hal_pins.toml").read_text("utf-8")
    return tuple(tomllib.loads(text)["component"])


def propose_axis(hal: HalNetlist, axis: str, joint: int, unit_mm: float, running: Collection[str] = ()) -> AxisProposal:
    """Return the pins and gains of an axis; ``running`` are the pins of the running HAL, empty if it does not run."""
    made = AxisProposal()
    source = "LinuxCNC: HAL files"
    command, feedback = (f"joint.{joint}.motor-pos-{end}" for end in ("cmd", "fb"))
    made.proposed_values["drive.hal.position_command"] = SourcedValue(command, source)
    measured = next((pin for pin in hal.find_linked_pins(feedback) if not CONSUMERS.match(pin)), None)
    if measured is None:
        made.notes.append(
            f"axis {axis}: no component's pin is connected to {feedback}; name the pin of the measured position"
        )
    else:
        made.proposed_values["drive.hal.position_feedback"] = SourcedValue(measured, source)
        _propose_component_pins(made, axis, measured.rpartition(".")[0], unit_mm, running)
    made.proposed_values["drive.hal.enabled"] = SourcedValue(
        f"joint.{joint}.amp-enable-out", "LinuxCNC: the joint's enable"
    )
    if unit_mm != 1.0:
        made.proposed_values["drive.hal.position_mm_per_unit"] = SourcedValue(unit_mm, "LinuxCNC: [TRAJ] LINEAR_UNITS")
    for loop in hal.find_pid_loops(command)[:1]:
        made.proposed_values |= {f"regulators.{key}": gain for key, gain in _read_pid_gains(hal.given, loop, unit_mm)}
        made.notes.append(
            f"axis {axis}: HAL's {loop} closes the position loop. Its output is read as a speed in units/s; if the "
            "drive reads it as a current, set regulators.pid_output = 'current' and drive.hal.current = "
            f"'{loop}.output' (docs/how-to/hal-mesa.md has the gains for it)"
        )
    return made


def _propose_component_pins(
    made: AxisProposal, axis: str, owner: str, unit_mm: float, running: Collection[str]
) -> None:
    known = next((c for c in _load_components() if re.fullmatch(c["feedback"], owner)), None)
    if known is None:
        made.notes.append(
            f"axis {axis}: component {owner} is unknown; name its pins of speed, and of current or torque"
        )
        return
    for signal in SIGNALS:
        pins = [f"{owner}.{name}" for name in known.get(signal, ()) if not running or f"{owner}.{name}" in running]
        if signal == "torque" and "drive.hal.current" in made.proposed_values:
            continue
        if pins:
            made.proposed_values[f"drive.hal.{signal}"] = SourcedValue(
                pins[0], f"guessed: {known['title']}", guessed=True
            )
    if unit_mm != 1.0 and "drive.hal.speed" in made.proposed_values:
        made.proposed_values["drive.hal.speed_mm_s_per_unit"] = SourcedValue(unit_mm, "LinuxCNC: [TRAJ] LINEAR_UNITS")
    made.notes.append(f"axis {axis}: {known['title']}: {known['unknown']}")


def _read_pid_gains(given: Mapping[str, str], loop: str, unit_mm: float) -> Iterator[tuple[str, SourcedValue]]:
    """Yield the keys of structure linuxcnc_pid with a speed output: gains per unit are then gains per mm."""
    yield "structure", SourcedValue("linuxcnc_pid", f"LinuxCNC: HAL's {loop}")
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
        value = parse_finite(given.get(f"{loop}.{name}", "0"))
        if value is not None and (value or key == "speed_feedforward"):
            yield key, SourcedValue(round_to_six_digits(value * scale), f"LinuxCNC: {loop}.{name}")
    if parse_finite(given.get(f"{loop}.error-previous-target", "1")) == 0.0 or given.get(
        f"{loop}.error-previous-target", ""
    ).upper().startswith("F"):
        yield "error_previous_target", SourcedValue(False, f"LinuxCNC: {loop}.error-previous-target")


def convert_to_current_gains(
    gains: Mapping[str, Any], a_per_unit: float, unit_mm: float, pitch_mm: float
) -> dict[str, float]:
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
    found = {key: round_to_six_digits(float(gains[key]) / derivative) for key in scaled if key in gains}
    return found | {"speed_kp": round_to_six_digits(speed_kp), "speed_ki": 0.0, "position_derivative": 1.0}
