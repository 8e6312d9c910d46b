"""Assemble a machine's configuration file: the order of the questions, the final check, and the text."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fdhil.commissioning.init.config_draft import Ask, ConfigDraft
from fdhil.commissioning.init.drive_discovery import FoundBus
from fdhil.commissioning.init.interview import (
    FoundDrives,
    determine_axis_names,
    settle_axis,
    settle_hal_axis,
    settle_machine,
)
from fdhil.commissioning.init.linuxcnc_import import ROTARY, LinuxcncMachine
from fdhil.commissioning.init.sourced_value import SourcedValue
from fdhil.config import (
    Axis,
    CanBus,
    CorrectionLimits,
    check_section,
    find_limit_faults,
    find_unlikely_values,
    is_second_drive,
    parse_config,
    parse_toml,
    write_filled_template,
)
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import PARAMETERS

Look = Callable[[str, CanBus], FoundBus]
"""Finds the drives on a bus; ConnectError."""

HAL_PORT, HAL_LEAD = 5572, 20  # of the bridge: its TCP port, and by how many cycles offsets are sent ahead
# in ascending order: coarse increments or an odd SYNC period need larger limits
LIMITS: tuple[Mapping[str, float], ...] = (
    {},
    {"max_speed_mm_s": 5.0, "max_acceleration_mm_s2": 1000.0},
    {"max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0},
    {"max_offset_um": 100.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0},
    {"max_offset_um": 250.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0},
)


def make_draft(
    file: Path,
    answers: Mapping[str, Any],
    nc: LinuxcncMachine | None = None,
    ask: Ask | None = None,
    look: Look | None = None,
    interface: SourcedValue | None = None,
    pins: Collection[str] | None = None,
) -> ConfigDraft:
    """Return a draft of the machine's configuration; ``look`` None skips the buses.

    ``interface`` is the PC's CAN interface. ``pins``: the drives are HAL pins of ``nc``, and these are the pins of the
    running HAL (empty if it does not run). ConfigError listing everything unknown if there is no operator to ask;
    ConnectError.
    """
    draft = ConfigDraft(ask)
    draft.add_answers(answers)
    if draft.missing:
        raise ConfigError(str(file), draft.missing)
    for path, value in (nc.values if nc else {}).items():
        draft.add_source_value(path, value)
    draft.notes += nc.notes if nc else []
    if nc is not None and pins is not None:
        return _make_hal_draft(draft, file, nc, pins)
    ways = list(_settle_buses(draft, interface, offline=look is None))
    buses = [look(name, settings) for name, settings in ways] if look else []
    settle_machine(draft, buses, file.stem, nc)
    drives = [drive for bus in buses for drive in bus.drives]
    complete = bool(buses) and all(bus.master is None for bus in buses)
    names = determine_axis_names(draft, nc, drives)
    for place, axis in enumerate(names):
        settle_axis(draft, axis, names[:place], FoundDrives(drives, complete), nc, file.parent)
    if draft.missing:
        raise ConfigError(str(file), draft.missing)
    for axis in names:
        _fit_limits(draft, axis)
    return draft


def _make_hal_draft(draft: ConfigDraft, file: Path, nc: LinuxcncMachine, pins: Collection[str]) -> ConfigDraft:
    draft.notes = [note for note in draft.notes if note not in nc.loops]
    bridge = {"interface": "socketcand", "channel": "hal", "port": HAL_PORT, "offset_lead_cycles": HAL_LEAD}
    for key, value in bridge.items():
        draft.add_source_value(f"bus.hal.{key}", SourcedValue(value, "of the bridge"))
    draft.add_source_value("g0.source", SourcedValue("linuxcnc", "fdhil's HAL file loads the bridge"))
    settle_machine(draft, (), file.stem, nc)
    names = [axis for axis in determine_axis_names(draft, nc, ()) if axis not in ROTARY]
    for axis in set(nc.axes) & set(ROTARY):
        draft.values = {path: value for path, value in draft.values.items() if not path.startswith(f"axis.{axis}.")}
        draft.values.pop("nc.wrapped_axes", None)
        draft.notes.append(f"axis {axis}: rotary axes are not supported on HAL pins; programs that move it are refused")
    for place, axis in enumerate(names):
        if is_second_drive(axis):
            text, advice = "is the second drive of a gantry, which HAL pins do not support", "remove the axis"
            draft.missing.append(ConfigFault(f"axis.{axis}", text, advice))
        else:
            settle_hal_axis(draft, axis, names[:place], nc, pins)
    if draft.missing:
        raise ConfigError(str(file), draft.missing)
    for axis in names:
        _fit_limits(draft, axis)
    return draft


def _settle_buses(draft: ConfigDraft, interface: SourcedValue | None, *, offline: bool) -> Iterator[tuple[str, CanBus]]:
    if not draft.has_table("bus"):
        where = "socketcan for an adapter that `ip link` lists; docs/how-to/can-adapter.md has the others"
        if interface is None and offline:
            interface = SourcedValue("can0", "guessed: the bus was skipped", guessed=True)
        way = None if interface is None else replace(interface, value="socketcan")
        draft.settle_value("bus.can0.interface", where, way)
        if draft.get_value("bus.can0.interface") == "socketcand":
            draft.settle_value("bus.can0.port", "the hub prints it when it starts, as `fdhil sim` does")
        elif "bus.can0.interface" in draft.values:
            draft.settle_value("bus.can0.channel", "the interface's name, as `ip link` lists it", interface)
    if draft.missing:
        raise ConfigError("bus", draft.missing)
    for name, settings in draft.document.get("bus", {}).items():
        yield name, check_section(CanBus, settings, f"bus.{name}")


def _fit_limits(draft: ConfigDraft, axis: str) -> None:
    """If the correction's limits were left open, use the lowest that the axis' increments can keep."""
    path = f"axis.{axis}.correction"
    if draft.get_value(path) != {}:
        return
    document = draft.document
    table = {key: value for key, value in document["axis"][axis].items() if key != "correction"}
    bare = check_section(Axis, table, f"axis.{axis}")
    for limits in LIMITS:
        tried = bare.model_copy(update={"correction": CorrectionLimits(**limits)})
        if not find_limit_faults(tried, float(draft.get_value("machine.sync_period_s"))):
            if limits:
                del draft.values[path]
            for key, value in limits.items():
                source = "guessed: the lowest that these increments can keep"
                draft.values[f"{path}.{key}"] = SourcedValue(value, source, guessed=True)
            return


def finish_draft(draft: ConfigDraft, file: Path) -> str:
    """Return the file's text. Contradictory values are asked again; ConfigError if there is no operator to ask.

    Implausible values are noted.
    """
    for axis in draft.document.get("axis", {}):
        nominal = {key: draft.values.get(f"axis.{axis}.nominal.{key}") for key in PARAMETERS}
        if unknown := [key for key, value in nominal.items() if value is not None and value.guessed]:
            draft.values[f"axis.{axis}.guessed"] = SourcedValue(unknown, "guesses are not compared with measurements")
    while True:
        text = format_config(draft, file)
        try:
            config = parse_config(parse_toml(text.encode(), str(file)), str(file), file.parent)
        except ConfigError as error:
            wrong = [fault for fault in error.faults if fault.path in draft.values]
            if draft.ask is None or not wrong:
                raise
            for fault in wrong:
                draft.ask_again(fault.path, fault.what)
        else:
            draft.notes += find_unlikely_values(config)
            return text


def format_config(draft: ConfigDraft, file: Path) -> str:
    """Return the commented file."""
    head = (
        f"{file.name}, written by fdhil init. Each value is followed by its source; {draft.guessed_count} are "
        f"guessed: check "
        "them. A line that begins with # and no space is a setting at its default."
    )
    return write_filled_template(draft.document, {path: value.source for path, value in draft.values.items()}, head)
