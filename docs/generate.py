"""Generate what can be generated: configs/machine-template.toml and docs/reference/ (config, commands, errors,
faults, guard).

``python docs/generate.py`` writes them; a test fails when they are not what the code says.
"""

from __future__ import annotations

import inspect
import re
import sys
import types
import typing
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import click
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from fdhil import config, errors
from fdhil.cli.main import cli
from fdhil.guard.core import FEED_HOLD_S, SETTLED_CYCLES
from fdhil.guard.interlocks import CATALOGUE, EFFECT
from fdhil.guard.protocol import HOLD_CYCLES
from fdhil.guard.transitions import FEED_SENT, FEED_TRANSITIONS, SENT, TRANSITIONS, Event
from fdhil.sim.fault_kinds import FAULTS

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES: Mapping[str, Any] = {  # of keys without a default: the bench machine
    "machine.name": "my machine",
    "screw_pitch_mm": 20.0, "rapid_speed_mm_s": 500.0, "max_acceleration_mm_s2": 4000.0, "max_jerk_mm_s3": 160000.0,
    "resonance_hz": 80.0,
    "R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0,
    "position_gain_per_s": 50.0, "speed_kp": 23.562, "speed_ki": 1184.35, "current_limit_a": 200.0,
    "current_kp": 12.566, "current_ki": 1256.64, "voltage_limit_v": 300.0,
    "node_id": 1, "speed_limit_mm_s": 500.0, "method": "maximum_likelihood", "tolerance_um": 2.0,
    "speed_feedforward": 0.98, "setpoint_filter_s": 0.002, "speed_filter_s": 0.0005, "current_delay_cycles": 2,
    "eds": "drive.eds", "dc_link_v": 300.0, "speed_unit": "millirpm",
    "limit_switches_mm": [-10.0, 410.0], "home_switch_mm": 50.0,
    "run_directory": "/run/fdhil",
    "guard.run_directory": "/run/fdhil-guard", "daemon_user": "fdhil",
    "commissioning_key": "/etc/fdhil/commissioning.key",
    "cob_id": 0x2A0, "axis.X.accelerometer.device": "/dev/ttyACM0",
    "nc_source.modbus_coil.hold": "1", "nc_source.modbus_coil.feed": "2", "nc_source.modbus_coil.arc": "3",
    "nc_source.modbus_coil.line": 100, "nc_source.modbus_coil.tool": 103,
    "feed_override": 101, "rapid_override": 102,
    "nc_source.opcua.user": "fdhil", "password_file": "nc-password",
    "certificate": "fdhil.der", "private_key": "fdhil.pem", "server_certificate": "nc.der",
    "axis.X.voltage.type": "float32", "count_address": 42, "trigger_address": 43,
}  # fmt: skip
NAMES = {"axis": "X", "bus": "can0"}  # the user's own names in the template


@dataclass(frozen=True)
class Table:
    """A table of the configuration file: its path, what it is, whether it may be left out, and its own keys."""

    path: str
    section: type[config.Section]
    optional: bool
    keys: tuple[tuple[str, FieldInfo], ...]

    @property
    def meaning(self) -> str:
        """The section's own words, without the name in front."""
        words = re.sub(r"^\[.*?\](: )?", "", inspect.getdoc(self.section) or "")
        return words[:1].upper() + words[1:]


def sections(section: type[config.Section], path: str = "", optional: bool = False) -> Iterator[Table]:
    """Yield every table of the file, outer ones first."""
    fields = [(key, field, _section_of(field.annotation)) for key, field in section.model_fields.items()]
    if path:
        own = tuple((key, field) for key, field, below in fields if below is None)
        yield Table(path, section, optional, own)
    for key, field, below in fields:
        if below is not None:
            named = f"{key}.{NAMES.get(key, key)}" if _is_mapping(field.annotation) else key
            absent = field.default is None or key == "sim"
            yield from sections(below, f"{path}.{named}" if path else named, optional or absent)


def template() -> str:
    """Return the commented machine configuration: required keys set, everything else commented out."""
    lines = [
        "# A machine for fdhil. The lines without a # in front are required: put your machine's values there.",
        "# A line that begins with # and no space is a setting at its default, or an example where it has none.",
        "# To change it, take the # away. The comment above each line says what it is.",
        "# A key that fdhil does not know is refused, with a suggestion.",
    ]
    for table in sections(config.MachineConfig):
        lines.append("")
        if table.meaning:
            lines += wrap(table.meaning, 118, initial_indent="# ", subsequent_indent="# ")
        lines.append(f"{'#' if table.optional else ''}[{table.path}]")
        for key, field in table.keys:
            lines += wrap(field.description or "", 118, initial_indent="# ", subsequent_indent="# ")
            set_by_user = field.is_required() and not table.optional
            lines.append(f"{'' if set_by_user else '#'}{key} = {_toml(_example(table.path, key, field))}")
    return "\n".join(lines) + "\n"


def config_reference() -> str:
    """Return the table of every configuration key as Markdown."""
    lines = ["# Configuration keys", "", "Generated from `fdhil/config/`. Unknown keys are refused."]
    for table in sections(config.MachineConfig):
        lines += ["", f"## [{table.path}]", ""]
        if table.meaning:
            lines += [table.meaning, ""]
        lines += ["| key | default | meaning |", "|---|---|---|"]
        for key, field in table.keys:
            default = _default(field)
            shown = "required" if field.is_required() else f"`{_toml(default)}`" if default is not None else "left out"
            lines.append(f"| `{key}` | {shown} | {field.description or ''} |")
    return "\n".join(lines) + "\n"


def command_reference() -> str:
    """Return every command's help as Markdown."""
    lines = ["# Commands", "", "Generated from the command line's own help.", ""]
    top = click.Context(cli, info_name="fdhil", help_option_names=["-h", "--help"])
    for name in cli.list_commands(top):
        command = cli.get_command(top, name)
        assert command is not None
        help_text = command.get_help(click.Context(command, info_name=name, parent=top))
        lines += [f"## fdhil {name}", "", "```text", help_text, "```", ""]
    return "\n".join(lines)


def error_reference() -> str:
    """Return the error tree as Markdown."""
    lines = [
        "# Errors",
        "",
        "Generated from `fdhil/errors.py`.",
        "",
        "| class | exit code | meaning |",
        "|---|---|---|",
    ]
    for name, item in vars(errors).items():
        if inspect.isclass(item) and issubclass(item, errors.FdhilError):
            meaning = " ".join((inspect.getdoc(item) or "").partition("\n\n")[0].split())
            lines.append(f"| `{name}` | {item.exit_code} | {meaning} |")
    return "\n".join(lines) + "\n"


def fault_reference() -> str:
    """Return the faults of the simulated machine as Markdown."""
    lines = [
        "# Faults of the simulated machine",
        "",
        "Generated from `fdhil/sim/fault_kinds.py`. How to use them is in [the how-to](../how-to/simulate.md).",
        "",
        "| fault | value | axis |",
        "|---|---|---|",
    ]
    for name, kind in FAULTS.items():
        value = kind.value.meaning if kind.value else "none"
        lines.append(f"| `{name}` | {value} | {'needed' if kind.needs_axis else 'not needed'} |")
    return "\n".join(lines) + "\n"


def guard_reference() -> str:
    """Return the guard's states, what leads from one to another, and its interlocks, as Markdown."""
    lines = [
        "# The guard's states and interlocks",
        "",
        "Generated from `fdhil/guard/transitions.py` and `fdhil/guard/interlocks.py`, the tables that the guard itself",
        "goes by: no other way leads from one state to another. [Safety](../explanation/safety.md) says why.",
        *_states("States", SENT, TRANSITIONS),
        *_states("States of the on-line feed-forward", FEED_SENT, FEED_TRANSITIONS),
        "",
        "## Interlocks",
        "",
        f"All must be good for {SETTLED_CYCLES} SYNC before arming. A hold lasts {HOLD_CYCLES} SYNC at most, "
        f"a feed hold {FEED_HOLD_S:g} s.",
    ]
    for reaction, effect in sorted(EFFECT.items(), reverse=True):
        lines += ["", f"### {effect[:1].upper()}{effect[1:]}", "", "| class | cause | what to do |", "|---|---|---|"]
        lines += [
            f"| `{code}` | {cause} | {action} |" for code, (own, cause, action) in CATALOGUE.items() if own is reaction
        ]
    return "\n".join(lines) + "\n"


def _states(
    title: str, sent: Mapping[Any, str], transitions: Iterable[tuple[Event, Collection[Any], Any]]
) -> Iterator[str]:
    """Yield two tables: what is sent in each state, and every way from one to another."""
    yield from ["", f"## {title}", "", "| state | what is sent |", "|---|---|"]
    yield from [f"| {state} | {words} |" for state, words in sent.items()]
    yield from ["", "| in | when | to |", "|---|---|---|"]
    for event, states, after in transitions:
        yield f"| {', '.join(state for state in sent if state in states)} | {event.value} | {after} |"


GENERATED = {
    ROOT / "configs" / "machine-template.toml": template,
    ROOT / "docs" / "reference" / "config.md": config_reference,
    ROOT / "docs" / "reference" / "commands.md": command_reference,
    ROOT / "docs" / "reference" / "errors.md": error_reference,
    ROOT / "docs" / "reference" / "faults.md": fault_reference,
    ROOT / "docs" / "reference" / "guard.md": guard_reference,
}


def _example(path: str, key: str, field: FieldInfo) -> Any:
    """Return what the template shows; KeyError where a key has neither a default nor an example."""
    default = _default(field)
    if default is not None:
        return default
    return EXAMPLES[f"{path}.{key}" if f"{path}.{key}" in EXAMPLES else key]


def _default(field: FieldInfo) -> Any:
    default = field.get_default(call_default_factory=True, validated_data={})
    return None if default is PydanticUndefined else default


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, str | Path):
        return f'"{value}"'
    return repr(value)


def _is_mapping(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (Mapping, dict, typing.get_origin(Mapping[str, str]))


def _section_of(annotation: Any) -> type[config.Section] | None:
    if isinstance(annotation, type) and issubclass(annotation, config.Section):
        return annotation
    if isinstance(annotation, types.GenericAlias | types.UnionType) or typing.get_args(annotation):
        found = [_section_of(argument) for argument in typing.get_args(annotation)]
        return next((section for section in found if section is not None), None)
    return None


def main() -> int:
    """Write the files; with --check only tell which are stale."""
    stale = [path for path, text in GENERATED.items() if not path.is_file() or path.read_text("utf-8") != text()]
    for path in stale:
        click.echo(f"{path.relative_to(ROOT)} is stale: run python docs/generate.py")
        if "--check" not in sys.argv:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(GENERATED[path](), "utf-8")
            click.echo("  written")
    return int("--check" in sys.argv and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
