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

from fdhil.config.axis_tables import angular, complete, linear, rotary_axes
from fdhil.config.machine import MachineConfig
from fdhil.config.plausible import doubts
from fdhil.config.section import LARGEST, Section
from fdhil.config.sensors import unit_remark
from fdhil.config.service import Guard, Store
from fdhil.errors import ConfigError, ConfigFault

MAX_CONFIG_BYTES = 256 * 1024
MOST_FAULTS = 50
MOST_DOTS = 100  # in a line
FEW_KEYS = 8
SHOWN_CHARS = 60
S = TypeVar("S", bound=Section)
OUT_OF_RANGE = {"greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number"}


def load(path: Path) -> MachineConfig:
    """Read a machine configuration; ConfigError with every fault, its path and a suggestion.

    Possible but unlikely values are logged as warnings.
    """
    config = parse(read_toml(path, "a machine config"), str(path), path.parent)
    for sentence in unlikely(config):
        logging.getLogger("fdhil").warning("%s: %s", path, sentence)  # on stderr, since no other recipient may exist
    return config


def load_places(path: Path) -> MachineConfig:
    """Read a configuration in order to remove an offset; of an invalid one the paths of sockets and store suffice.

    ConfigError where these paths do not exist either.
    """
    try:
        return load(path)
    except ConfigError as error:
        faults = error
    try:
        tables = read_toml(path, "a machine config")
        store = Store.model_validate(tables.get("store", {}))
        guard = Guard.model_validate(tables.get("guard", {}))
    except (ConfigError, ValidationError):
        store, guard = Store(), Guard()
    store, guard = _placed_store(store, path.parent), _placed_guard(guard, path.parent)
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
    return toml_document(raw, str(path))


def toml_document(raw: bytes, source: str) -> dict[str, Any]:
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
        cause, place = _placed(str(error))
        what = f"is not valid TOML: {_short(cause)}{place}"
    raise ConfigError(source, [ConfigFault("file", what, "check that line")])


def _placed(message: str) -> tuple[str, str]:
    """Separate the library's message from its location, which is never shortened."""
    found = re.search(r" \(at [^()]{1,60}\)$", message)
    return (message[: found.start()], found[0]) if found else (message, "")


def parse(
    document: Mapping[str, Any], source: str = "config", folder: Path = Path(), *, made_up: bool = False
) -> MachineConfig:
    """Validate a parsed TOML document; relative paths are resolved against ``folder``.

    ``made_up``: skip the plausibility checks, for machines that cannot exist.
    """
    units: list[ConfigFault] = []
    rotary = rotary_axes(document)
    if not made_up:
        document = complete(document, units)
    try:
        config = MachineConfig.model_validate(document, context={"made_up": made_up})
    except ValidationError as error:
        raise ConfigError(source, [*units, *(_as_written(fault, rotary) for fault in _faults(error))]) from None
    if units:
        raise ConfigError(source, units)
    store, guard = _placed_store(config.store, folder), _placed_guard(config.guard, folder)
    simulated = {
        name: axis.model_copy(update={"eds": folder / axis.eds if axis.eds else None})
        for name, axis in config.sim.axis.items()
    }
    sim = config.sim.model_copy(update={"axis": simulated})
    axes = {name: axis.model_copy(update={"drive": axis.drive.placed(folder)}) for name, axis in config.axis.items()}
    nc_source = config.nc_source.placed(folder)
    placed: dict[str, Any] = {"store": store, "guard": guard, "axis": axes, "sim": sim, "nc_source": nc_source}
    placed |= {"web": config.web.placed(folder), "publish": config.publish.placed(folder)}
    placed |= {"offers": config.offers.placed(folder)}
    placed |= {"uplink": config.uplink.placed(folder)} if config.uplink else {}
    return config.model_copy(update=placed)


def _placed_store(store: Store, folder: Path) -> Store:
    directory, run, key = folder / store.directory, store.run_directory, store.commissioning_key
    places = {
        "directory": directory,
        "run_directory": folder / run if run else directory / "run",
        "commissioning_key": folder / key if key else None,
    }
    return store.model_copy(update=places)


def _placed_guard(guard: Guard, folder: Path) -> Guard:
    return guard.model_copy(update={"run_directory": folder / guard.run_directory if guard.run_directory else None})


def _as_written(fault: ConfigFault, rotary: Mapping[str, float]) -> ConfigFault:
    parts = fault.path.removeprefix("sim.").split(".")
    key = angular(parts[-1])
    if parts[0] != "axis" or len(parts) < 3 or parts[1] not in rotary or not (key != parts[-1] or "_um" in key):
        return fault
    at = "" if "missing" in fault.what else f" at its radius, where 1 deg is {rotary[parts[1]]:.4g} mm"
    return replace(fault, path=f"{fault.path.removesuffix(parts[-1])}{key}", what=f"{fault.what}{at}")


def load_as(whole: type[S], path: Path, what: str) -> S:
    """Read another file than a machine's, with the tables of ``whole``; ConfigError with every fault."""
    return checked_as(whole, read_toml(path, what), str(path))


def checked_as(whole: type[S], tables: Mapping[str, Any], source: str) -> S:
    """Validate the tables of another file than a machine's; ConfigError with every fault."""
    try:
        return whole.model_validate(tables)
    except ValidationError as error:
        raise ConfigError(source, _faults(error, whole=whole)) from None


def unlikely(config: MachineConfig) -> list[str]:
    """Return a sentence for each value of an axis that is possible but unlikely."""
    found = [(name, doubt) for name, axis in config.axis.items() for doubt in doubts(axis)]
    sentences = [f"axis.{name}.{doubt.key} is unlikely: {doubt.text}" for name, doubt in found]
    text = 'is only used by a rotary axis; add unit = "deg", or remove it'
    flat = [name for name, axis in config.axis.items() if axis.unit == "mm" and axis.radius_mm is not None]
    sentences += [f"axis.{name}.radius_mm {text}" for name in flat]
    sections = ("voltage", "temperature", "table")
    places = [(f"axis.{name}.{key}", getattr(axis, key)) for name, axis in config.axis.items() for key in sections]
    places.append(("nc_source.modbus_coil", config.nc_source.modbus_coil))
    return sentences + [remark for path, place in places if place is not None and (remark := unit_remark(path, place))]


def checked(section: type[S], values: Mapping[str, Any], path: str) -> S:
    """Validate the values of one table, ``path`` in the file, on its own; ConfigError."""
    try:
        return section.model_validate(values)
    except ValidationError as error:
        raise ConfigError(path, _faults(error, tuple(path.split(".")))) from None


def checked_value(path: str, value: Any) -> Any:
    """Validate the value of one key, as ``axis.X.nominal.R``, and return it converted; ConfigError."""
    field, (*outer, key) = field_at(path), path.split(".")
    if field is None:
        near = _near_key(_section(tuple(outer)), key)
        raise ConfigError(path, [ConfigFault(path, "is not a key of this section", near)])
    kind: Any = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        raise ConfigError(path, _faults(error, tuple(path.split(".")))) from None


def _faults(
    error: ValidationError, place: tuple[str, ...] = (), whole: type[Section] = MachineConfig
) -> list[ConfigFault]:
    faults = []
    items = error.errors(include_url=False)
    for item in items[:MOST_FAULTS]:
        loc = (*place, *item["loc"])
        path = ".".join(_short(str(part)) for part in loc) or "config"
        section, key = _section(loc[:-1], whole), str(loc[-1]) if loc else ""
        field = section.model_fields.get(key)
        meaning = field.description or "" if field else ""
        if item["type"] == "extra_forbidden":
            faults.append(ConfigFault(path, "is not a key of this section", _near_key(section, key)))
        elif item["type"] == "missing":
            faults.append(ConfigFault(path, "is missing", meaning))
        elif item["type"] == "value_error" and not loc:
            for line in str(item["ctx"]["error"]).splitlines():
                where, _, what = line.partition(": ")
                faults.append(ConfigFault(where, what))
        elif item["type"] in OUT_OF_RANGE and (bounds := _bounds(section, loc)):
            kind = "a finite number " if item["type"] == "finite_number" else ""
            what = f"must be {kind}{bounds}, not {_shown(item['input'])}"
            faults.append(ConfigFault(path, what, meaning))
        else:
            shown = f", not {_shown(item['input'])}" if isinstance(item["input"], str | int | float | bool) else ""
            faults.append(ConfigFault(path, item["msg"].removeprefix("Value error, ") + shown, meaning))
    if len(items) > MOST_FAULTS:
        faults.append(ConfigFault("file", f"has {len(items) - MOST_FAULTS} more faults", "fix these first"))
    return faults


def _short(text: str) -> str:
    return text if len(text) <= SHOWN_CHARS else f"{text[:SHOWN_CHARS]}..."


def _shown(value: Any) -> str:
    try:
        return _short(repr(value))
    except ValueError:
        return "a number of thousands of digits"


def _bounds(section: type[Section], loc: tuple[int | str, ...]) -> str:
    names = [str(key) for key in loc if str(key) in section.model_fields]
    if not names:
        return ""
    field = section.model_fields[names[-1]]
    constraints = [*_constraints(field), *_constraints(field.annotation)]
    low = max((bound for item in constraints if (bound := getattr(item, "ge", None)) is not None), default=None)
    high = min((bound for item in constraints if (bound := getattr(item, "le", None)) is not None), default=LARGEST)
    return f"above 0 and at most {high:g}" if low is None else f"from {low:g} to {high:g}"


def _constraints(of: Any) -> Iterator[Any]:
    for item in (*getattr(of, "metadata", ()), *getattr(of, "__metadata__", ())):
        yield item
        yield from _constraints(item)
    for inner in getattr(of, "__args__", ()):
        yield from _constraints(inner)


def _section(loc: tuple[int | str, ...], whole: type[Section] = MachineConfig) -> type[Section]:
    section = whole
    for key in loc:
        field = section.model_fields.get(str(key))
        if field is None:  # a user's name: axis.X, bus.can0
            continue
        inner = [a for a in _arguments(field.annotation) if isinstance(a, type) and issubclass(a, Section)]
        if not inner:
            return section
        section = inner[0]
    return section


def field_at(path: str) -> FieldInfo | None:
    """Return the field of a key, as ``axis.X.nominal.R``; None where there is none."""
    *outer, key = path.split(".")
    fields = _section(tuple(outer)).model_fields
    return fields.get(key) or (fields.get(linear(key)) if outer[:1] == ["axis"] else None)


def _arguments(annotation: Any) -> list[Any]:
    arguments = getattr(annotation, "__args__", None)
    return [annotation] if not arguments else [x for a in arguments for x in _arguments(a)]


def _near_key(section: type[Section], key: str) -> str:
    if near := difflib.get_close_matches(key, section.model_fields, n=1):
        return f"did you mean {near[0]!r}?"
    few = len(section.model_fields) <= FEW_KEYS
    return f"known are {', '.join(section.model_fields)}" if few else "see configs/machine-template.toml"
