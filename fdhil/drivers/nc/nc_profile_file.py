"""Reads the profiles of NCs: the packaged ones of ``tables.NC_PROFILES``, and a user's own TOML file."""

import math
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fdhil import tables
from fdhil.config import read_toml
from fdhil.drivers.nc.nc_profile import Condition, NcProfile, Rule, Signal
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import MoveKind

Word = Annotated[bool | int | Annotated[float, Field(allow_inf_nan=False)] | str, Field(union_mode="left_to_right")]
Bound = Annotated[float, Field(allow_inf_nan=False)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _Signal(_Table):
    at: Annotated[str, Field(min_length=1, max_length=400)]
    scale: Annotated[float, Field(allow_inf_nan=False, gt=0)] = 1.0
    bit: Annotated[int, Field(ge=0, le=63)] | None = None
    item: Annotated[int, Field(ge=0, le=1000)] | None = None
    reads: Literal["value", "iso_block", "klartext_block"] = "value"
    optional: bool = False


class _Bounds(_Table):
    at_least: Bound | None = None
    at_most: Bound | None = None


class _Rule(_Table):
    kind: Literal["rapid", "feed", "arc", "rest", "hold"]
    when: Annotated[dict[str, list[Word] | _Bounds], Field(min_length=1)]


class _File(_Table):
    title: str
    interface: Literal["opcua", "mtconnect"]
    notes: list[str] = []
    signals: Annotated[dict[Annotated[str, Field(pattern="^[a-z][a-z0-9_]*$")], _Signal], Field(min_length=1)]
    motion: Annotated[list[_Rule], Field(min_length=1)]


def read_nc_profile(name: str, interface: str) -> NcProfile:
    """Return a packaged profile by its name, or a user's own by its path; ConfigError with every fault."""
    profile = build_nc_profile(_read_document(name), name)
    if profile.interface != interface:
        raise _make_error(name, [("interface", f"is for {profile.interface}, but is used for {interface}")])
    return profile


def _read_document(name: str) -> dict[str, Any]:
    if name in tables.NC_PROFILES:
        package, _, file = tables.NC_PROFILES[name].partition(":")
        return tomllib.loads((files(package) / file).read_text("utf-8"))
    return read_toml(Path(name), "a profile", "name a packaged profile, or a path from the configuration's folder")


def build_nc_profile(document: Mapping[str, Any], source: str) -> NcProfile:
    """Build a profile from the tables of its file; ConfigError."""
    try:
        file = _File.model_validate(document)
    except ValidationError as error:
        found = [(".".join(map(str, each["loc"])), each["msg"]) for each in error.errors(include_url=False)]
        raise _make_error(source, found) from None
    signals = {name: Signal(name, **signal.model_dump()) for name, signal in file.signals.items()}
    faults = [
        (f"motion.{place}.when.{name}", "is optional, but decides the motion" if name in signals else "is not a signal")
        for place, rule in enumerate(file.motion, 1)
        for name in rule.when
        if name not in signals or signals[name].optional
    ]
    if faults:
        raise _make_error(source, faults)
    rules = tuple(
        Rule(MoveKind(each.kind), {k: _build_condition(v) for k, v in each.when.items()}) for each in file.motion
    )
    return NcProfile(file.title, file.interface, signals, rules, tuple(file.notes))


def _build_condition(given: list[Word] | _Bounds) -> Condition:
    if isinstance(given, list):
        return Condition(tuple(given))
    least, most = given.at_least, given.at_most
    return Condition((), -math.inf if least is None else least, math.inf if most is None else most)


def _make_error(source: str, found: list[tuple[str, str]]) -> ConfigError:
    advice = f"see the packaged ones: {', '.join(tables.NC_PROFILES)}"
    return ConfigError(f"NC profile {source}", [ConfigFault(path, what, advice) for path, what in found])
