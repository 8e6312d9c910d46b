"""Writes configurations as commented files: the whole template, or a machine's values.

The comments are the descriptions and docstrings of the models.
"""

from __future__ import annotations

import inspect
import json
import re
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from textwrap import wrap
from typing import Any

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from fdhil.config.axis_tables import convert_key_to_mm
from fdhil.config.machine_config import MachineConfig
from fdhil.config.section import Section

EXAMPLES: Mapping[str, Any] = {  # for keys without a default: the bench machine
    "machine.name": "my machine",
    "screw_pitch_mm": 20.0, "rapid_speed_mm_s": 500.0, "max_acceleration_mm_s2": 4000.0, "max_jerk_mm_s3": 160000.0,
    "resonance_hz": 80.0, "radius_mm": 100.0, "max_difference_um": 500.0,
    "R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0,
    "position_gain_per_s": 50.0, "speed_kp": 23.562, "speed_ki": 1184.35, "current_limit_a": 200.0,
    "current_kp": 12.566, "current_ki": 1256.64, "voltage_limit_v": 300.0,
    "node_id": 1, "speed_limit_mm_s": 500.0, "method": "maximum_likelihood", "tolerance_um": 2.0,
    "speed_feedforward": 0.98, "setpoint_filter_s": 0.002, "speed_filter_s": 0.0005, "current_delay_cycles": 2,
    "eds": "drive.eds", "dc_link_v": 300.0, "speed_unit": "millirpm",
    "travel_mm": [0.0, 400.0], "axis.X.setpoints.max_speed_mm_s": 100.0,
    "axis.X.setpoints.max_acceleration_mm_s2": 2000.0,
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
    "users_file": "web-users.json", "programs_directory": "/home/cnc/nc_files",
    "tls_certificate_file": "web.crt", "tls_key_file": "web.key",
    "certificate_file": "fdhil.der", "private_key_file": "fdhil.pem", "trusted_clients": "clients",
    "tls_client_ca_file": "scrapers.crt", "publish.mqtt.user": "mill-1", "tls_ca_file": "works-ca.pem",
    "publish.mqtt.password_file": "broker-password", "publish.mqtt.tls_certificate_file": "mill-1.crt",
    "publish.mqtt.tls_key_file": "mill-1.key", "uplink.user": "mill-1", "uplink.password_file": "nats-password",
    "uplink.tls_certificate_file": "mill-1.crt", "uplink.tls_key_file": "mill-1.key",
    "uplink.directory": "/var/lib/fdhil-uplink", "uplink.credentials_file": "mill-1.creds",
    "offers.directory": "/var/lib/fdhil-uplink/offers",
    "position_command": "joint.0.motor-pos-cmd", "position_feedback": "hm2_7i97.0.encoder.00.position",
    "axis.X.drive.hal.speed": "hm2_7i97.0.encoder.00.velocity", "axis.X.drive.hal.current": "pid.x.output",
    "torque": "lcec.0.x.torque", "axis.X.drive.hal.voltage": "pwmgen.0.value", "enabled": "joint.0.amp-enable-out",
    "axis.X.voltage.type": "float32", "count_address": 42, "trigger_address": 43,
}  # fmt: skip
NAMES = {"axis": "X", "bus": "can0"}  # names in the template
_OWN = ("axis.", "bus.", "sim.axis.")  # tables of named entries
WIDTH = 118


@dataclass(frozen=True)
class ConfigTable:
    """A table of the configuration file: its path, its section, whether it is optional, and its own keys."""

    path: str
    section: type[Section]
    optional: bool
    keys: tuple[tuple[str, FieldInfo], ...]

    @property
    def meaning(self) -> str:
        """The section's description, without its name in front."""
        words = re.sub(r"^\[.*?\](: )?", "", inspect.getdoc(self.section) or "")
        return words[:1].upper() + words[1:]


def list_tables(
    section: type[Section] = MachineConfig, path: str = "", optional: bool = False
) -> Iterator[ConfigTable]:
    """Yield every table of the file, outer ones first."""
    fields = [(key, field, _find_section_type(field.annotation)) for key, field in section.model_fields.items()]
    if path:
        own = tuple((key, field) for key, field, below in fields if below is None)
        yield ConfigTable(path, section, optional, own)
    for key, field, below in fields:
        if below is not None:
            named = f"{key}.{NAMES.get(key, key)}" if _is_mapping(field.annotation) else key
            absent = field.default is None or key == "sim"
            yield from list_tables(below, f"{path}.{named}" if path else named, optional or absent)


def write_template() -> str:
    """Return the commented machine configuration: required keys set, everything else commented out."""
    lines = [
        "# A machine for fdhil. Lines without a leading # are required: enter your machine's values there.",
        "# A line that begins with # and no space is a setting at its default, or an example if it has none.",
        "# To change it, remove the #. The comment above each line explains it.",
        "# Unknown keys are refused, with a suggestion.",
    ]
    for table in list_tables():
        lines += ["", *_format_heading(table)]
        for key, field in table.keys:
            set_by_user = field.is_required() and not table.optional
            lines += _wrap_comment(field.description or "")
            lines.append(f"{'' if set_by_user else '#'}{key} = {format_toml(_choose_example(table.path, key, field))}")
    return "\n".join(lines) + "\n"


def write_filled_template(document: Mapping[str, Any], sources: Mapping[str, str], head: str = "") -> str:
    """Return ``document`` (nested tables of values) as a commented file, with the source of each value next to it.

    A table includes the comments and defaults of its other keys; from the second axis and bus on, only its values.
    ``sources`` has the full path of a key, as ``axis.X.nominal.R``.
    """
    lines, left = _wrap_comment(head), []
    for table, first in _name_tables(document):
        values = _find_table(document, table.path)
        if values is None:
            left += [f"[{table.path}]"] if first else []
            continue
        own = {
            convert_key_to_mm(key): (key, value)
            for key, value in values.items()
            if convert_key_to_mm(key) in dict(table.keys)
        }
        lines += ["", *(_format_heading(replace(table, optional=False)) if first else [f"[{table.path}]"])]
        for key, field in table.keys:
            if key in own:
                lines += _wrap_comment(field.description or "") if first else []
                lines += _format_line(*own[key], sources.get(f"{table.path}.{own[key][0]}", ""))
            elif first:
                lines += [
                    *_wrap_comment(field.description or ""),
                    f"#{key} = {format_toml(_choose_example(table.path, key, field))}",
                ]
    text = "\n".join(
        [*lines, "", *_wrap_comment(f"Further tables, explained in docs/reference/config.md: {', '.join(left)}")]
    )
    return text + "\n"


def _name_tables(document: Mapping[str, Any]) -> Iterator[tuple[ConfigTable, bool]]:
    """Yield the tables under the document's names, and whether to comment them (first axis and bus only)."""
    tables = list(list_tables())
    for top, of_top in groupby(tables, lambda table: next((t for t in _OWN if table.path.startswith(t)), "")):
        group = list(of_top)
        if not top:
            yield from ((table, True) for table in group)
            continue
        names = list(_find_table(document, top.rstrip(".")) or {}) or [NAMES[top.split(".")[-2]]]
        for name in names:
            for table in group:
                below = table.path.removeprefix(top).partition(".")[1:]
                yield replace(table, path=f"{top}{name}{''.join(below)}"), name == names[0]


def _find_table(document: Mapping[str, Any], path: str) -> Mapping[str, Any] | None:
    found: Any = document
    for part in path.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else None


def _format_line(key: str, value: Any, source: str) -> list[str]:
    text = f"{key} = {format_toml(value)}"
    comment = _wrap_comment(source)
    whole = "  ".join([text, *comment])
    return [whole] if len(comment) < 2 and len(whole) <= WIDTH else [*comment, text]


def _format_heading(table: ConfigTable) -> list[str]:
    return [*_wrap_comment(table.meaning), f"{'#' if table.optional else ''}[{table.path}]"]


def _wrap_comment(words: str) -> list[str]:
    words = "".join(letter if letter.isprintable() or letter.isspace() else "?" for letter in words)
    return wrap(words, WIDTH, initial_indent="# ", subsequent_indent="# ")


def _choose_example(path: str, key: str, field: FieldInfo) -> Any:
    value = get_default(field)
    if value is not None:
        return value
    named = re.sub(r"^axis\.\w+", "axis.X", path)
    return EXAMPLES[f"{named}.{key}" if f"{named}.{key}" in EXAMPLES else key]


def get_default(field: FieldInfo) -> Any:
    """Return a field's default, None where it has none."""
    value = field.get_default(call_default_factory=True, validated_data={})
    return None if value is PydanticUndefined else value


def format_toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(format_toml, value)) + "]"
    if isinstance(value, Mapping):
        pairs = ", ".join(f"{json.dumps(key)} = {format_toml(item)}" for key, item in value.items())
        return f"{{ {pairs} }}" if pairs else "{}"
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def _is_mapping(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (Mapping, dict, typing.get_origin(Mapping[str, str]))


def _find_section_type(annotation: Any) -> type[Section] | None:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    if isinstance(annotation, types.GenericAlias | types.UnionType) or typing.get_args(annotation):
        found = [_find_section_type(argument) for argument in typing.get_args(annotation)]
        return next((section for section in found if section is not None), None)
    return None
