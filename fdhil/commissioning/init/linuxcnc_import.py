"""Read axes, speeds, scales and the period from a LinuxCNC machine's own INI and HAL files.

The INI's units ([TRAJ] LINEAR_UNITS) are converted to millimetres. Programmed moves keep [AXIS_x] MAX_VELOCITY and
MAX_ACCELERATION, less the share of OFFSET_AV_RATIO, and [TRAJ] MAX_LINEAR_VELOCITY along the path; defaults are 1.
Neither [JOINT_n] nor [TRAJ] MAX_LINEAR_ACCELERATION limits them (measured on LinuxCNC 2.9). Rotary axes are in degrees;
the second joint of a gantry axis Y is the drive Y2.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from fdhil.commissioning.init.linuxcnc_text import HalNetlist, Ini, parse_finite, parse_hal, parse_ini
from fdhil.commissioning.init.sourced_value import SourcedValue, round_to_six_digits
from fdhil.config import is_second_drive
from fdhil.errors import ConfigError, ConfigFault

HAL_LIBRARY = Path("/usr/share/linuxcnc/hallib")
MAX_BYTES = 1024 * 1024
UNITS_MM = {"mm": 1.0, "metric": 1.0, "inch": 25.4, "in": 25.4, "imperial": 25.4}
ROTARY = "ABC"
UNITS_DEG = {"degree": 1.0, "deg": 1.0, "rad": math.degrees(1.0), "radian": math.degrees(1.0), "grad": 0.9, "gon": 0.9}
ALL_AXES = "XYZABCUVW"
_SCALE_PINS = ("position-scale", "pos-scale", "scale")
_SCALE_KEYS = ("SCALE", "INPUT_SCALE", "ENCODER_SCALE", "STEP_SCALE")
DEFAULT_LIMIT = 1.0  # speed or acceleration missing in the INI, in its unit
LARGEST_RATIO, REPLACED_RATIO = (
    0.9,
    0.1,
)  # of OFFSET_AV_RATIO: the largest that LinuxCNC accepts, and its replacement for larger ones
LEAST_JERK, LARGEST_JERK = 1.0, 1e9  # of MAX_LINEAR_JERK; the latter is its default
LARGEST_OFFSET_MM = 0.25  # the ceiling of [axis.X.correction]


@dataclass(frozen=True, slots=True)
class AxisScale:
    """Increments per millimetre or degree, negative if the drive counts against the axis, and the source."""

    increments_per_unit: float
    source: str


@dataclass(slots=True)
class LinuxcncMachine:
    """What the files define: values by configuration key, scales by axis, the axes' joints, HAL, remarks.

    ``loops`` are the remarks that apply to drives which close their own loops.
    """

    values: dict[str, SourcedValue] = field(default_factory=dict)
    scales: dict[str, AxisScale] = field(default_factory=dict)
    axes: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)
    joints: dict[str, int] = field(default_factory=dict)
    joint_count: int = 0
    loops: list[str] = field(default_factory=list)
    unit_mm: float = 1.0
    hal: HalNetlist = field(default_factory=HalNetlist)


def read_linuxcnc(path: Path) -> LinuxcncMachine:
    """Read a machine's INI and the HAL files it names; ConfigError if the INI describes no machine."""
    folder = path.parent
    try:
        ini = parse_ini(_read_text(path), lambda name: _read_text(folder / name))
    except (OSError, ValueError) as error:
        name = Path(getattr(error, "filename", None) or path).name
        what = f"{name} cannot be read: {getattr(error, 'strerror', None) or error}"
        raise _build_error(path, "file", what, "use the INI with which LinuxCNC is started") from None
    hal, notes = _read_hal(ini, folder)
    machine = build_machine(ini, hal, path)
    machine.notes = notes + machine.notes
    return machine


def _read_text(path: Path) -> str:
    with path.open("rb") as file:
        raw = file.read(MAX_BYTES + 1)
    if len(raw) > MAX_BYTES:
        raise ValueError("larger than 1 MiB")
    return raw.decode("utf-8", "replace")


def _read_hal(ini: Ini, folder: Path) -> tuple[HalNetlist, list[str]]:
    hal, notes = HalNetlist(), []
    for line in ini.find_all("HAL", "HALFILE"):
        name = line.split()[0] if line.split() else ""
        place = folder / name
        if name.startswith("LIB:") or not place.exists():  # LinuxCNC's search order
            place = HAL_LIBRARY / name.removeprefix("LIB:")
        if not name.endswith(".hal"):
            notes.append(f"HALFILE {name} was not read: it is not a plain HAL file; scales set there are asked for")
            continue
        try:
            parse_hal(_read_text(place), ini, lambda other: _read_text(folder / other), hal)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            notes.append(f"HALFILE {name} was not read ({reason}); scales set there are asked for")
    for line in ini.find_all("HAL", "HALCMD"):
        parse_hal(line, ini, lambda _name: "", hal)
    return hal, notes


def build_machine(ini: Ini, hal: HalNetlist, path: Path) -> LinuxcncMachine:
    """Return the machine that the parsed files describe; ConfigError if it has no linear axis."""
    if "AXIS_0" in ini.sections and "JOINT_0" not in ini.sections:
        what = "is for LinuxCNC before 2.8: it has [AXIS_0] and no [JOINT_0]"
        raise _build_error(path, "AXIS_0", what, "convert it with LinuxCNC's update_ini")
    unit_mm = _parse_linear_unit_mm(ini, path)
    machine = LinuxcncMachine(unit_mm=unit_mm, hal=hal)
    joints = machine.joints = _map_joints(ini, machine.notes)
    if not joints:
        advice = "[TRAJ] COORDINATES names the axes and [JOINT_n] describes each"
        raise _build_error(path, "TRAJ.COORDINATES", "has no linear axis with a joint", advice)
    machine.axes = tuple(joints)
    machine.joint_count = sum(section.startswith("JOINT_") for section in ini.sections)
    _add_machine_settings(ini, machine)
    _add_planner_settings(ini, joints, unit_mm, machine)
    units = {letter: _parse_axis_unit(ini, path, letter, unit_mm) for letter in joints}
    for letter, joint in joints.items():
        if is_second_drive(letter):
            scale = _find_joint_scale(ini, hal, joint, units[letter].factor)
            machine.scales |= {letter: scale} if scale is not None else {}
        else:
            _add_axis_settings(ini, hal, letter, joint, units[letter], machine)
    machine.notes += _describe_travel(ini, joints, units)
    return machine


class _AxisUnit(NamedTuple):
    """The unit that fdhil uses for an axis, and the INI's unit as a multiple of it."""

    name: str
    factor: float


def _parse_axis_unit(ini: Ini, path: Path, letter: str, unit_mm: float) -> _AxisUnit:
    if letter not in ROTARY:
        return _AxisUnit("mm", unit_mm)
    named = ini.get_text("TRAJ", "ANGULAR_UNITS").lower() or "degree"
    per_deg = parse_finite(named)
    if named not in UNITS_DEG and not (per_deg and per_deg > 0):
        raise _build_error(path, "TRAJ.ANGULAR_UNITS", f"is {named[:40]!r}", f"one of {', '.join(UNITS_DEG)}")
    return _AxisUnit("deg", 1.0 / per_deg if per_deg else UNITS_DEG[named])


def _describe_travel(ini: Ini, joints: Mapping[str, int], units: Mapping[str, _AxisUnit]) -> Iterator[str]:
    ways = []
    for letter, joint in joints.items():
        places = (f"AXIS_{letter}", f"JOINT_{joint}")
        low = [value for place in places if (value := ini.get_number(place, "MIN_LIMIT")) is not None]
        high = [value for place in places if (value := ini.get_number(place, "MAX_LIMIT")) is not None]
        if low and high:
            unit, factor = units[letter]
            ways.append(f"{letter} {max(low) * factor:g} to {min(high) * factor:g} {unit}")
    if ways:
        yield f"LinuxCNC allows {', '.join(ways)}: do not exceed that with `fdhil commission --room`"


def _parse_linear_unit_mm(ini: Ini, path: Path) -> float:
    named = ini.get_text("TRAJ", "LINEAR_UNITS").lower() or "mm"
    per_mm = parse_finite(named)
    if named not in UNITS_MM and not (per_mm and per_mm > 0):
        raise _build_error(path, "TRAJ.LINEAR_UNITS", f"is {named[:40]!r}", f"one of {', '.join(UNITS_MM)}")
    return 1.0 / per_mm if per_mm else UNITS_MM[named]


def _map_joints(ini: Ini, notes: list[str]) -> dict[str, int]:
    kinematics = ini.get_text("KINS", "KINEMATICS").split()
    given = next((word[12:] for word in kinematics if word.lower().startswith("coordinates=")), "")
    named = "".join(ini.get_text("TRAJ", "COORDINATES").upper().split())
    letters = given.upper() or named
    numbered = list(enumerate(letters))
    if kinematics and kinematics[0] == "trivkins" and not given:
        numbered = [(joint, letter) for joint, letter in enumerate(ALL_AXES) if letter in named]
        for joint, letter in numbered:
            if f"JOINT_{joint}" not in ini.sections:
                notes.append(
                    f"axis {letter} is joint {joint} of trivkins without coordinates=, and there is no "
                    f"[JOINT_{joint}]: ignored; for another number write KINEMATICS = trivkins coordinates={named}"
                )
    if kinematics and kinematics[0] != "trivkins":
        notes.append(f"KINEMATICS {kinematics[0]}: fdhil assigns the joints to the axes in the order {letters}")
    joints: dict[str, int] = {}
    for joint, letter in numbered:
        section = f"JOINT_{joint}"
        if section not in ini.sections:
            continue
        angular = ini.get_text(section, "TYPE").upper() == "ANGULAR"
        if letter in ALL_AXES and angular != (letter in ROTARY):
            kind, other = ("rotary", "ANGULAR") if letter in ROTARY else ("linear", "LINEAR")
            text = f"axis {letter} is {kind} and ignored: correct [{section}] TYPE to {other}, or the letter"
            notes.append(text)
        elif f"{letter}2" in joints:
            notes.append(f"axis {letter} has a third joint, {joint}: ignored; a gantry axis has two drives")
        elif letter in joints:
            joints[f"{letter}2"] = joint
        elif letter.isalpha() and letter.isascii():
            joints[letter] = joint
    return joints


def _add_machine_settings(ini: Ini, machine: LinuxcncMachine) -> None:
    if name := "".join(letter for letter in ini.get_text("EMC", "MACHINE") if letter.isprintable())[:64].strip():
        machine.values["machine.name"] = SourcedValue(name, "LinuxCNC: [EMC] MACHINE")
    period_ns = ini.get_number("EMCMOT", "SERVO_PERIOD")
    if period_ns:
        machine.values["machine.sync_period_s"] = SourcedValue(
            round_to_six_digits(period_ns * 1e-9), "LinuxCNC: [EMCMOT] SERVO_PERIOD"
        )
    machine.notes += [f"[{name}] occurs twice in the INI: LinuxCNC reads only the first one" for name in ini.repeated]


def _add_planner_settings(ini: Ini, joints: Mapping[str, int], unit_mm: float, machine: LinuxcncMachine) -> None:
    """Select the planner: LinuxCNC's trapezoidal one, or for PLANNER_TYPE 1 of 2.10 the nearest that fdhil has."""
    values, path = machine.values, ini.get_number("TRAJ", "MAX_LINEAR_VELOCITY")
    if path is not None and path > 0:
        values["nc.max_path_speed_mm_s"] = SourcedValue(
            round_to_six_digits(path * unit_mm), "LinuxCNC: [TRAJ] MAX_LINEAR_VELOCITY"
        )
    values["nc.profile"] = SourcedValue("linuxcnc", "LinuxCNC plans the moves")
    kind, jerk = ini.get_text("TRAJ", "PLANNER_TYPE"), ini.get_number("TRAJ", "MAX_LINEAR_JERK")
    if parse_finite(kind) in (None, 0.0):
        return
    if parse_finite(kind) != 1.0:
        machine.notes.append(f"[TRAJ] PLANNER_TYPE {kind[:20]} is unknown; fdhil plans as the trapezoidal planner (0)")
        return
    jerk = LARGEST_JERK if jerk is None else jerk
    if jerk < LEAST_JERK:
        machine.notes.append(
            f"[TRAJ] PLANNER_TYPE 1 needs MAX_LINEAR_JERK of {LEAST_JERK:g} or more, and it is {jerk:g}: LinuxCNC "
            "plans with the trapezoidal planner (0), and so does fdhil"
        )
        return
    values["nc.profile"] = SourcedValue("jerk_limited", "LinuxCNC: [TRAJ] PLANNER_TYPE 1, the S-curve planner of 2.10")
    for letter in (each for each in joints if each not in ROTARY and not is_second_drive(each)):
        source = "LinuxCNC: [TRAJ] MAX_LINEAR_JERK"
        values[f"axis.{letter}.max_jerk_mm_s3"] = SourcedValue(
            round_to_six_digits(min(jerk * unit_mm, LARGEST_JERK)), source
        )
    machine.notes.append(
        "[TRAJ] PLANNER_TYPE 1: profile jerk_limited models the S-curve planner of LinuxCNC 2.10 with the same jerk, "
        "but different corner blends; assess programs by a recorded demand (fdhil record): predict reports where the "
        "planner exceeds the axes' limits"
    )


def _read_axis_limit(ini: Ini, letter: str, joint: int, name: str, machine: LinuxcncMachine) -> tuple[float, str]:
    """Return the [AXIS_x] limit of speed or acceleration for programmed moves, in the INI's unit, and its source."""
    section = f"AXIS_{letter}"
    given = ini.get_number(section, name)
    value, source = DEFAULT_LIMIT if given is None or given <= 0 else given, f"LinuxCNC: [{section}] {name}"
    if given is None:
        source = f"LinuxCNC's default: [{section}] has no {name}"
        machine.notes.append(f"axis {letter}: [{section}] has no {name}, so LinuxCNC uses {DEFAULT_LIMIT:g} unit")
    ratio = ini.get_number(section, "OFFSET_AV_RATIO") or 0.0
    if not 0.0 <= ratio <= LARGEST_RATIO:
        ratio = REPLACED_RATIO
    if ratio:
        source += f", less the share {ratio:g} of its OFFSET_AV_RATIO"
    of_joint = ini.get_number(f"JOINT_{joint}", name)
    if of_joint is not None and 0 < of_joint < value:
        machine.notes.append(
            f"axis {letter}: [JOINT_{joint}] {name} is {of_joint:g}, less than {value:g} of [{section}]: LinuxCNC "
            "ignores it in programmed moves; make both equal"
        )
    return value * (1.0 - ratio), source


def _add_axis_settings(
    ini: Ini, hal: HalNetlist, letter: str, joint: int, unit: _AxisUnit, machine: LinuxcncMachine
) -> None:
    values, here, rotary, factor = machine.values, f"axis.{letter}", unit.name == "deg", unit.factor
    if rotary:
        values[f"{here}.unit"] = SourcedValue("deg", f"LinuxCNC: axis {letter} is rotary")
        if ini.get_number(f"AXIS_{letter}", "WRAPPED_ROTARY"):
            before = values["nc.wrapped_axes"].value if "nc.wrapped_axes" in values else []
            values["nc.wrapped_axes"] = SourcedValue([*before, letter], "LinuxCNC: WRAPPED_ROTARY")
    most = f"MAX_{'ANGULAR' if rotary else 'LINEAR'}_VELOCITY"
    path = ini.get_number("TRAJ", most)
    value, source = _read_axis_limit(ini, letter, joint, "MAX_VELOCITY", machine)
    if path is not None and 0 < path < value:  # a move of this axis alone is no faster
        value, source = path, f"LinuxCNC: [TRAJ] {most}"
    values[f"{here}.rapid_speed_{unit.name}_s"] = SourcedValue(round_to_six_digits(value * factor), source)
    value, source = _read_axis_limit(ini, letter, joint, "MAX_ACCELERATION", machine)
    values[f"{here}.max_acceleration_{unit.name}_s2"] = SourcedValue(round_to_six_digits(value * factor), source)
    ferror = ini.get_number(f"JOINT_{joint}", "FERROR")
    if ferror is not None and ferror > 0:
        source = f"LinuxCNC: [JOINT_{joint}] FERROR; fdhil check compares it with the drive's 0x6065"
        values[f"{here}.drive.following_error_window_{unit.name}"] = SourcedValue(
            round_to_six_digits(ferror * factor), source
        )
    scale = _find_joint_scale(ini, hal, joint, factor)
    if scale is not None:
        machine.scales[letter] = scale
    loops = list(_describe_hal_loops(hal, letter, joint))
    machine.notes += [*_describe_own_corrections(ini, letter, joint, unit), *loops]
    machine.loops += loops


def _find_joint_scale(ini: Ini, hal: HalNetlist, joint: int, factor: float) -> AxisScale | None:
    for pin in (f"joint.{joint}.motor-pos-fb", f"joint.{joint}.motor-pos-cmd"):
        for component in hal.find_linked_components(pin):
            for name in _SCALE_PINS:
                value = parse_finite(hal.given.get(f"{component}.{name}", ""))
                if value:
                    return AxisScale(value / factor, f"LinuxCNC: {component}.{name}")
    for key in _SCALE_KEYS:
        value = ini.get_number(f"JOINT_{joint}", key)
        if value:
            return AxisScale(value / factor, f"LinuxCNC: [JOINT_{joint}] {key}")
    return None


def _describe_own_corrections(ini: Ini, letter: str, joint: int, unit: _AxisUnit) -> Iterator[str]:
    section = f"JOINT_{joint}"
    if (ini.get_number(section, "BACKLASH") or 0.0) > 0 or ini.get_text(section, "COMP_FILE"):
        yield (
            f"axis {letter}: LinuxCNC compensates backlash or screw pitch ([{section}] BACKLASH, COMP_FILE); leave "
            "that on: the demand contains it; assess programs by a recorded demand (fdhil record)"
        )
    if ini.get_number(f"AXIS_{letter}", "OFFSET_AV_RATIO"):
        yield (
            f"axis {letter}: external offsets are allowed ([AXIS_{letter}] OFFSET_AV_RATIO), and reserve their share "
            "of speed and acceleration in every program; do not use them while a correction is armed: the path "
            "would differ from the checked one, and the guard refuses it"
        )
    least = ini.get_number(section, "MIN_FERROR")
    if least is not None and 0 < least * unit.factor < 2 * LARGEST_OFFSET_MM:  # and as many degrees
        yield (
            f"axis {letter}: [{section}] MIN_FERROR is {least * unit.factor:g} {unit.name}; an offset is a following "
            f"error to LinuxCNC: keep correction.max_offset_{'mdeg' if unit.name == 'deg' else 'um'} below a quarter "
            f"of it, or raise it to {4 * LARGEST_OFFSET_MM:g} {unit.name}"
        )


def _describe_hal_loops(hal: HalNetlist, letter: str, joint: int) -> Iterator[str]:
    for loop in hal.find_pid_loops(f"joint.{joint}.motor-pos-cmd"):
        gains = _format_gains(hal.given, loop)
        yield (
            f"axis {letter}: HAL's {loop} closes the position loop ({gains}); fdhil corrects drives that receive "
            "unmodified position set-points (0x607A): connect the joint's motor-pos-cmd to the drive, remove this loop"
        )


def _format_gains(settings: Mapping[str, str], loop: str) -> str:
    found = [(name, settings.get(f"{loop}.{name}")) for name in ("Pgain", "FF1", "FF2")]
    return ", ".join(f"{name} {value}" for name, value in found if value is not None) or "gains unknown"


def _build_error(path: Path, where: str, what: str, advice: str) -> ConfigError:
    return ConfigError(str(path), [ConfigFault(where, what, advice)])
