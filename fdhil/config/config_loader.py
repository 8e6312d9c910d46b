"""Loads and validates TOML configurations; all faults are reported at once, each with its path and a suggestion."""

from __future__ import annotations

import difflib
import logging
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from fdhil.config.axis_plausibility import find_implausibilities
from fdhil.config.axis_tables import complete_axis_tables, convert_key_to_degrees, convert_key_to_mm, find_rotary_axes
from fdhil.config.machine_config import MachineConfig
from fdhil.config.section import LARGEST, Section
from fdhil.config.sensor_sections import describe_reserved_unit
from fdhil.config.service_sections import Guard, Store
from fdhil.errors import ConfigError, ConfigFault

MAX_CONFIG_BYTES = 256 * 1024
MOST_FAULTS = 50
MOST_DOTS = 100  # in a line
FEW_KEYS = 8
SHOWN_CHARS = 60
S = TypeVar("S", bound=Section)
OUT_OF_RANGE = {"greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number"}


def load_config(path: Path) -> MachineConfig:
    """Read a machine configuration; ConfigError with every fault, its path and a suggestion.

    Possible but unlikely values are logged as warnings.
    """
    config = parse_config(read_toml(path, "a machine config"), str(path), path.parent)
    for sentence in find_unlikely_values(config):
        logging.getLogger("fdhil").warning("%s: %s", path, sentence)  # on stderr, since no other recipient may exist
    return config


def load_directories(path: Path) -> MachineConfig:
    """Read a configuration in order to remove an offset; of an invalid one the paths of sockets and store suffice.

    ConfigError where these paths do not exist either.
    """
    try:
        return load_config(path)
    except ConfigError as error:
        faults = error
    try:
        tables = read_toml(path, "a machine config")
        store = Store.model_validate(tables.get("store", {}))
        guard = Guard.model_validate(tables.get("guard", {}))
    except (ConfigError, ValidationError):
        store, guard = Store(), Guard()
    store, guard = _resolve_store_paths(store, path.parent), _resolve_guard_paths(guard, path.parent)
    run_directories = [place for place in (store.run_directory, guard.run_directory) if place is not None]
    if not path.is_file() or not any(place.exists() for place in run_directories):
        raise faults
    logging.getLogger("fdhil").warning("%s", faults)
    found: dict[str, Any] = {"store": store, "guard": guard}
    return MachineConfig.model_construct(**found)


def read_toml(path: Path, what: str, advice: str = "check the path") -> dict[str, Any]:
    """Read a TOML file, called ``what`` in errors; ConfigError when it is unreadable, too large or invalid."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_CONFIG_BYTES + 1)
    except OSError as error:
        raise ConfigError(str(path), [ConfigFault("file", f"cannot be read: {error.strerror}", advice)]) from None
    if len(raw) > MAX_CONFIG_BYTES:
        fault = ConfigFault("file", f"is larger than {MAX_CONFIG_BYTES >> 10} KiB", f"{what} is a few kB")
        raise ConfigError(str(path), [fault])
    return parse_toml(raw, str(path))


def parse_toml(raw: bytes, source: str) -> dict[str, Any]:
    """Parse TOML; ConfigError when it is invalid or nested too deeply."""
    try:
        if any(line.count(b".") > MOST_DOTS for line in raw.splitlines()):  # parsing a key of n parts takes n^2
            raise RecursionError
        return tomllib.loads(raw.decode("utf-8-sig"))
    except RecursionError:
        what = "is nested deeper than any config"
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        what = f"is not valid TOML: it is not UTF-8 text (at line {line})"
    except ValueError as error:  # invalid TOML, or a number of thousands of digits
        cause, place = _split_location(str(error))
        what = f"is not valid TOML: {_shorten_text(cause)}{place}"
    raise ConfigError(source, [ConfigFault("file", what, "check that line")])


def _split_location(message: str) -> tuple[str, str]:
    """Separate the library's message from its location, which is never shortened."""
    found = re.search(r" \(at [^()]{1,60}\)$", message)
    return (message[: found.start()], found[0]) if found else (message, "")


def parse_config(
    document: Mapping[str, Any], source: str = "config", folder: Path = Path(), *, made_up: bool = False
) -> MachineConfig:
    """Validate a parsed TOML document; relative paths are resolved against ``folder``.

    ``made_up``: skip the plausibility checks, for machines that cannot exist.
    """
    units: list[ConfigFault] = []
    rotary = find_rotary_axes(document)
    if not made_up:
        document = complete_axis_tables(document, units)
    try:
        config = MachineConfig.model_validate(document, context={"made_up": made_up})
    except ValidationError as error:
        raise ConfigError(
            source, [*units, *(_restore_written_key(fault, rotary) for fault in _collect_faults(error))]
        ) from None
    if units:
        raise ConfigError(source, units)
    store, guard = _resolve_store_paths(config.store, folder), _resolve_guard_paths(config.guard, folder)
    simulated = {
        name: axis.model_copy(update={"eds": folder / axis.eds if axis.eds else None})
        for name, axis in config.sim.axis.items()
    }
    sim = config.sim.model_copy(update={"axis": simulated})
    axes = {
        name: axis.model_copy(update={"drive": axis.drive.resolve_paths(folder)}) for name, axis in config.axis.items()
    }
    nc_source = config.nc_source.resolve_paths(folder)
    placed: dict[str, Any] = {"store": store, "guard": guard, "axis": axes, "sim": sim, "nc_source": nc_source}
    placed |= {"web": config.web.resolve_paths(folder), "publish": config.publish.resolve_paths(folder)}
    placed |= {"offers": config.offers.resolve_paths(folder)}
    placed |= {"uplink": config.uplink.resolve_paths(folder)} if config.uplink else {}
    return config.model_copy(update=placed)


def _resolve_store_paths(store: Store, folder: Path) -> Store:
    directory, run, key = folder / store.directory, store.run_directory, store.commissioning_key
    places = {
        "directory": directory,
        "run_directory": folder / run if run else directory / "run",
        "commissioning_key": folder / key if key else None,
    }
    return store.model_copy(update=places)


def _resolve_guard_paths(guard: Guard, folder: Path) -> Guard:
    return guard.model_copy(update={"run_directory": folder / guard.run_directory if guard.run_directory else None})


def _restore_written_key(fault: ConfigFault, rotary: Mapping[str, float]) -> ConfigFault:
    parts = fault.path.removeprefix("sim.").split(".")
    key = convert_key_to_degrees(parts[-1])
    if parts[0] != "axis" or len(parts) < 3 or parts[1] not in rotary or not (key != parts[-1] or "_um" in key):
        return fault
    at = "" if "missing" in fault.what else f" at its radius, where 1 deg is {rotary[parts[1]]:.4g} mm"
    return replace(fault, path=f"{fault.path.removesuffix(parts[-1])}{key}", what=f"{fault.what}{at}")


def load_section_file(whole: type[S], path: Path, what: str) -> S:
    """Read another file than a machine's, with the tables of ``whole``; ConfigError with every fault."""
    return check_section_file(whole, read_toml(path, what), str(path))


def check_section_file(whole: type[S], tables: Mapping[str, Any], source: str) -> S:
    """Validate the tables of another file than a machine's; ConfigError with every fault."""
    try:
        return whole.model_validate(tables)
    except ValidationError as error:
        raise ConfigError(source, _collect_faults(error, whole=whole)) from None


def find_unlikely_values(config: MachineConfig) -> list[str]:
    """Return a sentence for each value of an axis that is possible but unlikely."""
    found = [(name, doubt) for name, axis in config.axis.items() for doubt in find_implausibilities(axis)]
    sentences = [f"axis.{name}.{doubt.key} is unlikely: {doubt.text}" for name, doubt in found]
    text = 'is only used by a rotary axis; add unit = "deg", or remove it'
    flat = [name for name, axis in config.axis.items() if axis.unit == "mm" and axis.radius_mm is not None]
    sentences += [f"axis.{name}.radius_mm {text}" for name in flat]
    sections = ("voltage", "temperature", "table")
    places = [(f"axis.{name}.{key}", getattr(axis, key)) for name, axis in config.axis.items() for key in sections]
    places.append(("nc_source.modbus_coil", config.nc_source.modbus_coil))
    return sentences + [
        remark for path, place in places if place is not None and (remark := describe_reserved_unit(path, place))
    ]


def check_section(section: type[S], values: Mapping[str, Any], path: str) -> S:
    """Validate the values of one table, ``path`` in the file, on its own; ConfigError."""
    try:
        return section.model_validate(values)
    except ValidationError as error:
        raise ConfigError(path, _collect_faults(error, tuple(path.split(".")))) from None


def check_value(path: str, value: Any) -> Any:
    """Validate the value of one key, as ``axis.X.nominal.R``, and return it converted; ConfigError."""
    field, (*outer, key) = find_field(path), path.split(".")
    if field is None:
        near = _suggest_key(_find_section(tuple(outer)), key)
        raise ConfigError(path, [ConfigFault(path, "is not a key of this section", near)])
    kind: Any = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        raise ConfigError(path, _collect_faults(error, tuple(path.split(".")))) from None


def _collect_faults(
    error: ValidationError, place: tuple[str, ...] = (), whole: type[Section] = MachineConfig
) -> list[ConfigFault]:
    faults = []
    items = error.errors(include_url=False)
    for item in items[:MOST_FAULTS]:
        loc = (*place, *item["loc"])
        path = ".".join(_shorten_text(str(part)) for part in loc) or "config"
        section, key = _find_section(loc[:-1], whole), str(loc[-1]) if loc else ""
        field = section.model_fields.get(key)
        meaning = field.description or "" if field else ""
        if item["type"] == "extra_forbidden":
            faults.append(ConfigFault(path, "is not a key of this section", _suggest_key(section, key)))
        elif item["type"] == "missing":
            faults.append(ConfigFault(path, "is missing", meaning))
        elif item["type"] == "value_error" and not loc:
            for line in str(item["ctx"]["error"]).splitlines():
                where, _, what = line.partition(": ")
                faults.append(ConfigFault(where, what))
        elif item["type"] in OUT_OF_RANGE and (bounds := _describe_bounds(section, loc)):
            kind = "a finite number " if item["type"] == "finite_number" else ""
            what = f"must be {kind}{bounds}, not {_format_value(item['input'])}"
            faults.append(ConfigFault(path, what, meaning))
        else:
            shown = (
                f", not {_format_value(item['input'])}" if isinstance(item["input"], str | int | float | bool) else ""
            )
            faults.append(ConfigFault(path, item["msg"].removeprefix("Value error, ") + shown, meaning))
    if len(items) > MOST_FAULTS:
        faults.append(ConfigFault("file", f"has {len(items) - MOST_FAULTS} more faults", "fix these first"))
    return faults


def _shorten_text(text: str) -> str:
    return text if len(text) <= SHOWN_CHARS else f"{text[:SHOWN_CHARS]}..."


def _format_value(value: Any) -> str:
    try:
        return _shorten_text(repr(value))
    except ValueError:
        return "a number of thousands of digits"


def _describe_bounds(section: type[Section], loc: tuple[int | str, ...]) -> str:
    names = [str(key) for key in loc if str(key) in section.model_fields]
    if not names:
        return ""
    field = section.model_fields[names[-1]]
    constraints = [*_iterate_constraints(field), *_iterate_constraints(field.annotation)]
    low = max((bound for item in constraints if (bound := getattr(item, "ge", None)) is not None), default=None)
    high = min((bound for item in constraints if (bound := getattr(item, "le", None)) is not None), default=LARGEST)
    return f"above 0 and at most {high:g}" if low is None else f"from {low:g} to {high:g}"


def _iterate_constraints(of: Any) -> Iterator[Any]:
    for item in (*getattr(of, "metadata", ()), *getattr(of, "__metadata__", ())):
        yield item
        yield from _iterate_constraints(item)
    for inner in getattr(of, "__args__", ()):
        yield from _iterate_constraints(inner)


def _find_section(loc: tuple[int | str, ...], whole: type[Section] = MachineConfig) -> type[Section]:
    section = whole
    for key in loc:
        field = section.model_fields.get(str(key))
        if field is None:  # a user's name: axis.X, bus.can0
            continue
        inner = [a for a in _list_type_arguments(field.annotation) if isinstance(a, type) and issubclass(a, Section)]
        if not inner:
            return section
        section = inner[0]
    return section


def find_field(path: str) -> FieldInfo | None:
    """Return the field of a key, as ``axis.X.nominal.R``; None where there is none."""
    *outer, key = path.split(".")
    fields = _find_section(tuple(outer)).model_fields
    return fields.get(key) or (fields.get(convert_key_to_mm(key)) if outer[:1] == ["axis"] else None)


def _list_type_arguments(annotation: Any) -> list[Any]:
    arguments = getattr(annotation, "__args__", None)
    return [annotation] if not arguments else [x for a in arguments for x in _list_type_arguments(a)]


def _suggest_key(section: type[Section], key: str) -> str:
    if near := difflib.get_close_matches(key, section.model_fields, n=1):
        return f"did you mean {near[0]!r}?"
    few = len(section.model_fields) <= FEW_KEYS
    return f"known are {', '.join(section.model_fields)}" if few else "see configs/machine-template.toml"
