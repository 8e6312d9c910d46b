"""Determine the values of a machine: use what files and drives report, ask for the rest, propose guesses."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fdhil.commissioning.init.axis_questions import PITCH, QUESTIONS, Question
from fdhil.commissioning.init.config_draft import OPERATOR, ConfigDraft
from fdhil.commissioning.init.drive_discovery import FoundBus, FoundDrive, is_dc_link_required
from fdhil.commissioning.init.hal_pins import convert_to_current_gains, propose_axis
from fdhil.commissioning.init.linuxcnc_import import AxisScale, LinuxcncMachine
from fdhil.commissioning.init.sourced_value import SourcedValue, round_to_six_digits
from fdhil.config import Drive, HalPins, check_section, convert_key_to_degrees, convert_key_to_mm, is_second_drive
from fdhil.drivers import GENERIC_PROFILE, NO_OFFSET_ADVICE, DriveProfile, explain_missing_offset, load_profile
from fdhil.errors import ConfigError, ConfigFault, EdsError

UNITS_OF_CURRENT = {
    "drive.rated_current_a": ("permille_of_rated", "share_of_rated"),
    "drive.rated_torque_nm": ("permille_of_rated_torque",),
}
ANY_PINS = HalPins(position_command="a", position_feedback="a", current="a")
NO_OTHER_WINDOW = (0, 0xFFFFFFFF)


@dataclass(frozen=True, slots=True)
class FoundDrives:
    """The found drives; ``complete``: there are no others, since the nodes of every bus were read."""

    drives: Sequence[FoundDrive]
    complete: bool


def settle_machine(draft: ConfigDraft, buses: Sequence[FoundBus], name: str, nc: LinuxcncMachine | None) -> None:
    """Settle [machine] (its name, the SYNC period from files, answers or the bus) and how G0 is recognised."""
    draft.settle_value("machine.name", "any name", SourcedValue(name, "guessed: the file's name", guessed=True))
    for bus in buses:
        if bus.master is not None:
            draft.notes.append(
                f"bus {bus.name}: an NC runs it ({bus.master} received), so no drive was read; with the NC off init "
                "reads scales and ratings from the drives"
            )
        if bus.sync_period_s is not None:
            draft.add_source_value(
                "machine.sync_period_s", SourcedValue(_round_cycle_s(bus.sync_period_s), "measured: SYNC on the bus")
            )
    cycles = {drive.cycle_s for bus in buses for drive in bus.drives} - {None}
    usual = SourcedValue(0.001, "guessed: a usual value; it must be the NC's cycle", guessed=True)
    if len(cycles) == 1:
        usual = SourcedValue(cycles.pop(), "guessed: the drives' own cycle, 0x60C2; it must be the NC's", guessed=True)
    draft.settle_value("machine.sync_period_s", "the NC's cycle: how often it sends SYNC", usual)
    if nc is not None:
        where = "'linuxcnc' if its HAL file loads fdhil's bridge, which reports line and override; else 'inferred'"
        by_motion = "guessed: recognised by the motion; 'linuxcnc' if its HAL file loads fdhil's bridge"
        draft.settle_value("g0.source", where, SourcedValue("inferred", by_motion, guessed=True))


def _round_cycle_s(measured_s: float) -> float:
    """Return the period to which an NC is set, a multiple of a quarter of a millisecond, if one is near.

    >>> _round_cycle_s(0.000993), _round_cycle_s(0.0011)
    (0.001, 0.0011)
    """
    usual_s = max(1, round(measured_s / 0.00025)) * 0.00025
    return round_to_six_digits(usual_s if abs(measured_s - usual_s) < 0.05 * usual_s else round(measured_s, 5))


def determine_axis_names(draft: ConfigDraft, nc: LinuxcncMachine | None, drives: Sequence[FoundDrive]) -> list[str]:
    """Return the axes' letters: those of the NC and the answers, else the operator's."""
    named = [path.split(".")[1] for path in draft.values if path.startswith("axis.")]
    names = list(dict.fromkeys([*(nc.axes if nc else ()), *named]))
    if names:
        return names
    usual = "XYZUVW"[: len(drives)] or "X"
    draft.settle_value(
        "axes",
        "their letters in the NC's programs",
        SourcedValue(usual, "one for each drive", True),
        _parse_axis_letters,
    )
    letters = draft.values.pop("axes")
    return list(dict.fromkeys(letters.value))


def _parse_axis_letters(answer: str) -> str:
    letters = "".join(answer.upper().replace(",", " ").split())
    if not (letters.isascii() and letters.isalpha()):
        raise ConfigError("axes", [ConfigFault("axes", "must be letters, for example X Y Z")])
    return letters


def _require_one_of(path: str, words: Sequence[str], answer: str) -> str:
    if answer not in words:
        raise ConfigError(path, [ConfigFault(path, f"must be {' or '.join(words)}")])
    return answer


def settle_axis(
    draft: ConfigDraft, axis: str, others: Sequence[str], found: FoundDrives, nc: LinuxcncMachine | None, folder: Path
) -> None:
    """Settle [axis.X]; ``others`` are the axes before it, ``found`` the drives on the buses."""
    drive = _settle_drive(draft, axis, found)
    scale = nc.scales.get(axis) if nc else None
    if is_second_drive(axis):  # the rest is the first drive's
        if scale is not None:
            draft.add_source_value(
                f"axis.{axis}.drive.sign", SourcedValue(-1 if scale.increments_per_unit < 0 else 1, scale.source)
            )
        return
    if axis in "ABC":
        draft.settle_value(
            f"axis.{axis}.unit", "deg for a rotary table", SourcedValue("deg", f"guessed: {axis} is rotary", True)
        )
    profile = _settle_profile(draft, axis, drive, folder)
    for key, value in (drive.reported_values if drive is not None else {}).items():
        draft.add_source_value(f"axis.{axis}.{key}", value)
    _settle_scale(draft, axis, scale, others)
    for question in QUESTIONS:
        if _is_applicable(question.key, profile, _is_rotary(draft, axis)):
            _settle_key(draft, axis, question, others)
    if drive is not None:
        _add_drive_window(draft, axis, drive.window_increments)
    _settle_correction(draft, axis, profile)
    if profile is not None and not profile.voltage_objects and not draft.has_table(f"axis.{axis}.voltage"):
        draft.notes.append(
            f"axis {axis}: profile {profile.name} has no motor voltage; K, inertia and friction are "
            "identified, R and L stay as given until a sensor is connected (docs/how-to/voltage-sensor.md)"
        )


HAL_WHERE = {
    "position_feedback": "`halcmd show pin`: the encoder's position, before any offset",
    "current": "`halcmd show pin`: the drive's current (an analogue input, lcec), or in torque mode the pid's output; "
    "without any, fdhil cannot identify the axis",
}


def settle_hal_axis(
    draft: ConfigDraft, axis: str, others: Sequence[str], nc: LinuxcncMachine, running: Collection[str]
) -> None:
    """Settle [axis.X] of an axis whose drive is HAL pins; a pin that a running HAL lacks is missing."""
    here = f"axis.{axis}"
    made = propose_axis(nc.hal, axis, nc.joints.get(axis, 0), nc.unit_mm, running)
    for key in ("source", "bus", "profile"):
        draft.add_source_value(f"{here}.drive.{key}", SourcedValue("hal", "option --hal"))
    for key, value in made.proposed_values.items():
        given = f"{here}.{key}" in draft.values or (
            key.endswith("torque") and f"{here}.drive.hal.current" in draft.values
        )
        if not given:
            draft.add_source_value(f"{here}.{key}", value)
    draft.notes += made.notes
    for key, where in HAL_WHERE.items():
        if key != "current" or f"{here}.drive.hal.torque" not in draft.values:
            draft.settle_value(f"{here}.drive.hal.{key}", where)
    _settle_key(draft, axis, PITCH, others)
    _settle_pid(draft, here, nc.unit_mm)
    profile = load_profile(Drive(source="hal", hal=ANY_PINS))
    for question in QUESTIONS:
        if question.key != "drive.increments_per_rev" and _is_applicable(question.key, profile, rotary=False):
            _settle_key(draft, axis, question, others)
    for key in (*HAL_WHERE, "speed", "torque", "voltage", "enabled", "position_command"):
        pin = draft.get_value(f"{here}.drive.hal.{key}")
        if running and pin is not None and pin not in running:
            advice = "see `halcmd show pin`; load its component, or name another pin"
            draft.missing.append(ConfigFault(f"{here}.drive.hal.{key}", f"HAL has no pin {pin}", advice))
    if not draft.has_table(f"{here}.drive.hal.voltage"):
        draft.notes.append(
            f"axis {axis}: no pin of a voltage; K, R and L stay as given, inertia and friction are identified"
        )
    _settle_correction(draft, axis, profile)


def _settle_pid(draft: ConfigDraft, here: str, unit_mm: float) -> None:
    regulators = f"{here}.regulators"
    pitch = draft.get_value(f"{here}.screw_pitch_mm")
    if draft.get_value(f"{regulators}.pid_output") != "current" or not pitch:
        return
    gains = {
        path.rpartition(".")[2]: value.value for path, value in draft.values.items() if path.startswith(regulators)
    }
    per_unit = draft.get_value(f"{here}.drive.hal.current_a_per_unit") or 1.0
    try:
        found = convert_to_current_gains(gains, per_unit, unit_mm, pitch)
    except ValueError as error:
        draft.missing.append(ConfigFault(f"{regulators}.pid_output", f"cannot be 'current': {error}", "check its setp"))
        return
    for key, value in found.items():
        draft.values[f"{regulators}.{key}"] = SourcedValue(value, "LinuxCNC: HAL's pid, whose output is a current")


def _settle_drive(draft: ConfigDraft, axis: str, found: FoundDrives) -> FoundDrive | None:
    """Settle which drive moves the axis; return it if it was found on a bus."""
    path = f"axis.{axis}.drive"
    taken = _list_assigned_drives(draft, axis)
    free = [drive for drive in found.drives if (drive.bus, drive.node_id, drive.logical_axis) not in taken]
    if found.complete and not free:
        what = f"has no drive: {len(found.drives)} found, {len(taken)} assigned to other axes"
        advice = "check its supply and wiring, or remove the axis; --offline skips the bus"
        draft.missing.append(ConfigFault(path, what, advice))
        return None
    only = found.complete and len(found.drives) == 1
    first = SourcedValue(
        1 + max((place[1] for place in taken), default=0), "guessed: in the order of the axes", guessed=True
    )
    if free:
        source = "the drive on the bus" if only else "guessed: in the order on the bus"
        first = SourcedValue(free[0].node_id, source, guessed=not only)
    names = "; ".join(drive.name for drive in free)
    draft.settle_value(f"{path}.node_id", f"found: {names}" if free else "set by the drive's switches or tool", first)
    drive = _select_drive(draft, axis, free)
    if drive is not None:
        _add_bus_location(draft, path, drive)
    elif found.complete:
        what = f"is {draft.get_value(f'{path}.node_id')}, which is not on the bus"
        draft.missing.append(ConfigFault(f"{path}.node_id", what, names))
    return drive


def _list_assigned_drives(draft: ConfigDraft, axis: str) -> set[tuple[str, int, int]]:
    named = {path.split(".")[1] for path in draft.values if path.startswith("axis.") and path.endswith(".node_id")}
    return {_locate_drive(draft, other) for other in named - {axis}}


def _select_drive(draft: ConfigDraft, axis: str, free: Sequence[FoundDrive]) -> FoundDrive | None:
    _, node_id, number = _locate_drive(draft, axis)
    candidates = [drive for drive in free if drive.node_id == node_id]
    exact = [drive for drive in candidates if drive.logical_axis == number]
    given = f"axis.{axis}.drive.logical_axis" in draft.values
    return next(iter(exact if exact or given else candidates), None)


def _locate_drive(draft: ConfigDraft, axis: str) -> tuple[str, int, int]:
    path = f"axis.{axis}.drive"
    return (
        draft.get_value(f"{path}.bus") or "can0",
        draft.get_value(f"{path}.node_id") or 0,
        draft.get_value(f"{path}.logical_axis") or 1,
    )


def _add_bus_location(draft: ConfigDraft, path: str, drive: FoundDrive) -> None:
    if drive.bus != "can0":
        draft.add_source_value(f"{path}.bus", SourcedValue(drive.bus, "found on the bus"))
    if drive.logical_axis != 1:
        draft.add_source_value(f"{path}.logical_axis", SourcedValue(drive.logical_axis, "found on the bus"))


def _settle_profile(draft: ConfigDraft, axis: str, drive: FoundDrive | None, folder: Path) -> DriveProfile | None:
    """Settle the drive's profile, and its EDS if needed; return the profile, None if it is unknown.

    A profile that cannot be read, or maps too little, is asked again if there is an operator.
    """
    path = f"axis.{axis}.drive"
    if drive is not None and drive.profile is not None:
        by = f"by its EDS {drive.eds.name}" if drive.eds else "by its vendor number"
        draft.add_source_value(f"{path}.profile", SourcedValue(drive.profile, f"{by}: {drive.label}"))
    draft.settle_value(
        f"{path}.profile", "`fdhil eds` suggests one from the drive's EDS; cia402 uses what the EDS offers"
    )
    while True:
        _settle_eds(draft, path, drive, folder)
        try:
            return _load_draft_profile(draft, path, folder)
        except (ConfigError, EdsError) as error:
            if draft.ask is None:
                raise
            draft.ask_again(f"{path}.profile", str(error))
            draft.values.pop(f"{path}.eds", None)


def _settle_eds(draft: ConfigDraft, path: str, drive: FoundDrive | None, folder: Path) -> None:
    """With its EDS a profile maps exactly the drive's objects; the generic profile consists of nothing else."""
    if drive is not None and drive.eds is not None:
        draft.add_source_value(
            f"{path}.eds", SourcedValue(_make_relative(drive.eds, folder), "matches the drive on the bus")
        )
    if draft.get_value(f"{path}.profile") == GENERIC_PROFILE:
        draft.settle_value(f"{path}.eds", "from the manufacturer's web site; put it next to this file, or use --eds")


def _load_draft_profile(draft: ConfigDraft, path: str, folder: Path) -> DriveProfile | None:
    keys = ("profile", "eds", "logical_axis")
    given = {key: value for key in keys if (value := draft.get_value(f"{path}.{key}")) is not None}
    if "profile" not in given or (given["profile"] == GENERIC_PROFILE and "eds" not in given):
        return None
    return load_profile(check_section(Drive, given, path).resolve_paths(folder))


def _make_relative(path: Path, folder: Path) -> str:
    path, folder = path.resolve(), folder.resolve()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def _settle_scale(draft: ConfigDraft, axis: str, scale: AxisScale | None, others: Sequence[str]) -> None:
    """Of the NC's scale, the drive's increments and the pitch two give the third; all three must agree."""
    turn, pitch = f"axis.{axis}.drive.increments_per_rev", _build_key_path(draft, axis, PITCH.key)
    if scale is not None:
        per_unit = abs(scale.increments_per_unit)
        if draft.get_value(turn) and pitch not in draft.values:
            draft.add_source_value(
                pitch,
                SourcedValue(
                    round_to_six_digits(draft.get_value(turn) / per_unit), f"{scale.source}, and the drive's increments"
                ),
            )
        if scale.increments_per_unit < 0:
            draft.add_source_value(f"axis.{axis}.drive.sign", SourcedValue(-1, f"{scale.source} is negative"))
    _settle_key(draft, axis, PITCH, others)
    if scale is None or draft.get_value(pitch) is None:
        return
    if turn not in draft.values:
        draft.add_source_value(
            turn, SourcedValue(round(per_unit * draft.get_value(pitch)), f"{scale.source}, times the pitch")
        )
    found = draft.get_value(turn) / draft.get_value(pitch)
    if abs(found - per_unit) > 1e-3 * per_unit:
        unit = "deg" if _is_rotary(draft, axis) else "mm"
        draft.notes.append(
            f"axis {axis}: {scale.source} is {per_unit:g} increments/{unit}, drive and pitch give {found:g}: one of "
            "the three is wrong, or the NC's scale has another meaning; measure before anything moves"
        )


def _is_rotary(draft: ConfigDraft, axis: str) -> bool:
    return bool(draft.get_value(f"axis.{axis}.unit") == "deg")


def _build_key_path(draft: ConfigDraft, axis: str, key: str) -> str:
    return f"axis.{axis}.{convert_key_to_degrees(key) if _is_rotary(draft, axis) else key}"


def _is_applicable(key: str, profile: DriveProfile | None, rotary: bool) -> bool:
    if key == "radius_mm":
        return rotary
    if key in UNITS_OF_CURRENT:
        return profile is not None and profile.current_unit in UNITS_OF_CURRENT[key]
    return key != "drive.dc_link_v" or is_dc_link_required(profile)


def _settle_key(draft: ConfigDraft, axis: str, question: Question, others: Sequence[str]) -> None:
    """Settle one key; if no source and no guess has it, the value of the previous axis is proposed to the operator."""
    path = _build_key_path(draft, axis, question.key)
    proposal = _guess_value(draft, axis, question)
    if proposal is None and draft.ask is not None:
        key = path.removeprefix(f"axis.{axis}.")
        former = [(other, value) for other in others if (value := draft.values.get(f"axis.{other}.{key}"))]
        if former:
            proposal = SourcedValue(former[-1][1].value, f"guessed: as axis {former[-1][0]}", guessed=True)
    if proposal is None and question.guess is not None and question.follows and path not in draft.values:
        return  # the value it follows from is reported as missing
    draft.settle_value(path, question.where, proposal)


def _guess_value(draft: ConfigDraft, axis: str, question: Question) -> SourcedValue | None:
    here = f"axis.{axis}."
    own = {path: value.value for path, value in draft.values.items() if path.startswith(here)}
    known = {
        convert_key_to_mm(path.removeprefix(here)): value for path, value in own.items()
    }  # guesses use ratios of lengths
    try:
        value: Any = question.guess(known) if question.guess is not None else None
    except (KeyError, TypeError, ZeroDivisionError):  # too little is known, or an answer is not a number
        return None
    return None if value is None else SourcedValue(round_to_six_digits(value), f"guessed: {question.how}", guessed=True)


def _add_drive_window(draft: ConfigDraft, axis: str, increments: int | None) -> None:
    turn, pitch = (
        draft.get_value(f"axis.{axis}.drive.increments_per_rev"),
        draft.get_value(_build_key_path(draft, axis, PITCH.key)),
    )
    path = _build_key_path(draft, axis, "drive.following_error_window_mm")
    if increments in (None, *NO_OTHER_WINDOW) or not turn or not pitch:
        return
    window = SourcedValue(round_to_six_digits(increments * pitch / turn), "the drive: 0x6065")
    known = draft.values.get(path)
    if known is not None and known.source.startswith("LinuxCNC"):
        del draft.values[path]
    draft.add_source_value(path, window)


def _settle_correction(draft: ConfigDraft, axis: str, profile: DriveProfile | None) -> None:
    """Correction stays off unless requested; even then nothing is sent before commissioning and arming."""
    path = f"axis.{axis}.correction"
    if not draft.has_table(path) and draft.ask is not None:
        where = "yes or no; even with yes nothing is sent before `fdhil commission` and `fdhil arm`"
        no = SourcedValue("no", "off unless requested: nothing is written to a drive", guessed=True)
        draft.settle_value(path, where, no, partial(_require_one_of, path, ("yes", "no")))
        if draft.values.pop(path).value == "yes":
            draft.values[path] = SourcedValue({}, OPERATOR)
    if draft.has_table(path) and profile is not None and not profile.can_take_offset:
        draft.notes.append(f"axis {axis}: {explain_missing_offset(profile)}; {NO_OFFSET_ADVICE}")
