"""From TOML to a checked configuration: all faults at once, each with its path and a suggestion."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fdhil.config.machine import MachineConfig
from fdhil.config.section import Section
from fdhil.errors import ConfigError, ConfigFault

MAX_CONFIG_BYTES = 256 * 1024


def load(path: Path) -> MachineConfig:
    """Read a machine configuration; ConfigError with every fault, its path and a suggestion."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        fault = ConfigFault("file", f"cannot be read: {error.strerror}", "check the path")
        raise ConfigError(str(path), [fault]) from None
    if len(raw) > MAX_CONFIG_BYTES:
        raise ConfigError(str(path), [ConfigFault("file", "is larger than 256 KiB", "a machine config is a few kB")])
    try:
        document = tomllib.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(path), [ConfigFault("file", f"is no TOML: {error}", "check the line it names")]) from None
    return parse(document, str(path), path.parent)


def parse(document: Mapping[str, Any], source: str = "config", folder: Path = Path()) -> MachineConfig:
    """Check a parsed TOML document; relative directories of [store] are taken from ``folder``."""
    try:
        config = MachineConfig.model_validate(document)
    except ValidationError as error:
        raise ConfigError(source, _faults(error)) from None
    directory = folder / config.store.directory
    run, key = config.store.run_directory, config.store.commissioning_key
    store = config.store.model_copy(
        update={
            "directory": directory,
            "run_directory": folder / run if run else directory / "run",
            "commissioning_key": folder / key if key else None,
        }
    )
    guard_run = config.guard.run_directory
    guard = config.guard.model_copy(update={"run_directory": folder / guard_run if guard_run else None})
    return config.model_copy(update={"store": store, "guard": guard})


def _faults(error: ValidationError) -> list[ConfigFault]:
    faults = []
    for item in error.errors():
        path = ".".join(str(part) for part in item["loc"]) or "config"
        if item["type"] == "extra_forbidden":
            faults.append(ConfigFault(path, "is no key of this section", _near_key(item["loc"])))
        elif item["type"] == "missing":
            faults.append(ConfigFault(path, "is missing", _describe(item["loc"])))
        elif item["type"] == "value_error" and not item["loc"]:
            for line in str(item["ctx"]["error"]).splitlines():
                where, _, what = line.partition(": ")
                faults.append(ConfigFault(where, what))
        else:
            shown = f", not {item['input']!r}" if isinstance(item["input"], str | int | float | bool) else ""
            faults.append(ConfigFault(path, item["msg"].removeprefix("Value error, ") + shown, _describe(item["loc"])))
    return faults


def _section(loc: tuple[int | str, ...]) -> type[Section] | None:
    """Follow a path of keys through the models; None where it leaves them."""
    section: type[Section] = MachineConfig
    for key in loc:
        field = section.model_fields.get(str(key))
        if field is None:  # a name chosen by the user: axis.X, bus.can0
            continue
        inner = [a for a in _arguments(field.annotation) if isinstance(a, type) and issubclass(a, Section)]
        if not inner:
            return section
        section = inner[0]
    return section


def _arguments(annotation: Any) -> list[Any]:
    arguments = getattr(annotation, "__args__", None)
    return [annotation] if not arguments else [x for a in arguments for x in _arguments(a)]


def _near_key(loc: tuple[int | str, ...]) -> str:
    section = _section(loc[:-1])
    near = difflib.get_close_matches(str(loc[-1]), section.model_fields if section else [], n=1)
    return f"did you mean {near[0]!r}?" if near else "see configs/machine-template.toml"


def _describe(loc: tuple[int | str, ...]) -> str:
    section = _section(loc[:-1])
    field = section.model_fields.get(str(loc[-1])) if section else None
    return field.description or "" if field else ""
