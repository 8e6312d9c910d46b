"""Generate what can be generated: configs/machine-template.toml and docs/reference/ (config, commands, errors).

``python docs/generate.py`` writes them; a test fails when they are not what the code says.
"""

from __future__ import annotations

import inspect
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from fdhil import config, errors
from fdhil.cli.main import cli

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES: Mapping[str, Any] = {  # of required keys: the bench machine
    "machine.name": "my machine",
    "screw_pitch_mm": 20.0, "rapid_speed_mm_s": 500.0, "max_acceleration_mm_s2": 4000.0,
    "R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0,
    "position_gain_per_s": 50.0, "speed_kp": 23.562, "speed_ki": 1184.35, "current_limit_a": 200.0,
    "current_kp": 12.566, "current_ki": 1256.64, "voltage_limit_v": 300.0,
}  # fmt: skip
NAMES = {"axis": "X", "bus": "can0"}  # the user's own names in the template
OPTIONAL = {  # sections whose absence means something
    "axis.X.correction": "Without this section nothing is ever sent to the drive; with it, what the guard lets pass.",
    "axis.X.temperature": "Without this section the drift is told against time alone.",
}


def keys(section: type[config.Section], path: str = "") -> Iterator[tuple[str, str, FieldInfo]]:
    """Yield (section path, key, field) of every key, section by section."""
    inner: list[tuple[str, type[config.Section]]] = []
    for key, field in section.model_fields.items():
        below = _section_of(field.annotation)
        if below is None:
            yield path, key, field
        else:
            named = f"{key}.{NAMES.get(key, key)}" if _is_mapping(field.annotation) else key
            inner.append((f"{path}.{named}" if path else named, below))
    for name, below in inner:
        yield from keys(below, name)


def template() -> str:
    """Return the commented machine configuration: required keys set, the others at their defaults, commented out."""
    lines = [
        "# A machine for fdhil. What is not commented out is required; what is shows its default.",
        "# A key that fdhil does not know is refused, with a suggestion.",
    ]
    current = ""
    for path, key, field in keys(config.MachineConfig):
        if path != current:
            current = path
            lines += ["", *_heading(path)]
        value = _example(path, key, field)
        text = f"{key} = {_toml(value)}" if value is not None else f"{key} ="
        required = field.is_required() and "sim" not in path
        shown = text if required else f"# {text}"
        lines.append(f"{shown:<44} # {field.description or ''}".rstrip())
    return "\n".join(lines) + "\n"


def config_reference() -> str:
    """Return the table of every configuration key as Markdown."""
    lines = ["# Configuration keys", "", "Generated from `fdhil/config/`. Unknown keys are refused.", ""]
    current = None
    for path, key, field in keys(config.MachineConfig):
        if path != current:
            current = path
            lines += ["", f"## [{path}]", "", "| key | default | meaning |", "|---|---|---|"]
        default = "required" if field.is_required() else f"`{_toml(_default(field))}`"
        lines.append(f"| `{key}` | {default} | {field.description or ''} |")
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
            meaning = (inspect.getdoc(item) or "").splitlines()[0]
            lines.append(f"| `{name}` | {item.exit_code} | {meaning} |")
    return "\n".join(lines) + "\n"


GENERATED = {
    ROOT / "configs" / "machine-template.toml": template,
    ROOT / "docs" / "reference" / "config.md": config_reference,
    ROOT / "docs" / "reference" / "commands.md": command_reference,
    ROOT / "docs" / "reference" / "errors.md": error_reference,
}


def _heading(path: str) -> list[str]:
    if path in OPTIONAL:
        return [
            "# Without this section nothing is ever sent to the drive; with it, what the guard lets pass.",
            f"# [{path}]",
        ]
    if path.startswith("sim"):
        return [f"# [{path}]"]
    return [f"[{path}]"]


def _example(path: str, key: str, field: FieldInfo) -> Any:
    if field.is_required():
        return EXAMPLES[f"{path}.{key}" if f"{path}.{key}" in EXAMPLES else key]
    return _default(field)


def _default(field: FieldInfo) -> Any:
    default = field.get_default(call_default_factory=True, validated_data={})
    return None if default is PydanticUndefined else default


def _toml(value: Any) -> str:
    if value is None:
        return ""
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
