"""The fault script: which fault happens when, to which axis, how badly and for how long.

    [[fault]]
    at_s = 2.5                 # or at_sync, counted from the first SYNC; or at_row, from a played file's first row
    axis = "X"
    fault = "load_torque"
    value = 5.0                # what it means depends on the fault, see fault_kinds
    duration_s = 0.3           # left out: for good

A wrong entry is a ConfigError that names every fault of the script at once.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from fdhil.config import toml_document
from fdhil.errors import ConfigError, ConfigFault
from fdhil.sim.fault_kinds import FAULTS, Target

MAX_SCRIPT_BYTES = 256 * 1024
Finite = Annotated[float, Field(allow_inf_nan=False)]
Duration = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class FaultEntry(BaseModel):
    """One entry of a script or of the operator's panel; without an ``at_`` key it happens at once."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    at_sync: Annotated[int, Field(ge=0)] | None = None
    at_row: Annotated[int, Field(ge=0)] | None = None
    axis: str | None = None
    fault: str
    value: Finite | None = None
    duration_s: Duration | None = None
    index: Annotated[int, Field(ge=0, le=0xFFFF)] | None = None
    sub: Annotated[int, Field(ge=0, le=0xFF)] = 0
    can_id: Annotated[int, Field(ge=0, le=0x7FF)] | None = None
    data: str | None = None

    @field_validator("fault")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in FAULTS:
            near = difflib.get_close_matches(name, FAULTS, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name!r} is none of {', '.join(FAULTS)}{hint}")
        return name

    @field_validator("data")
    @classmethod
    def _bytes(cls, text: str | None) -> str | None:
        if text is not None and len(bytes.fromhex(text)) > 8:
            raise ValueError("a CAN frame has at most 8 bytes")
        return text

    @property
    def number(self) -> float:
        """The value, 0 where there is none."""
        return 0.0 if self.value is None else self.value

    @model_validator(mode="after")
    def _whole(self) -> FaultEntry:
        kind = FAULTS[self.fault]
        if sum(at is not None for at in (self.at_s, self.at_sync, self.at_row)) > 1:
            raise ValueError("give one of at_s, at_sync and at_row")
        if kind.needs_axis and self.axis is None:
            raise ValueError(f"{self.fault} needs an axis")
        if kind.value is not None and self.value is None:
            raise ValueError(f"{self.fault} needs a value: {kind.value.meaning}")
        if kind.value is not None and (wrong := kind.value.fault(self.number)):
            raise ValueError(f"the value of {self.fault} is {kind.value.meaning}: {wrong}")
        if self.fault == "object" and self.index is None:
            raise ValueError("object needs the index (and sub) of what is to be overwritten")
        if self.fault == "frame" and (self.can_id is None or self.data is None):
            raise ValueError("frame needs can_id and data (hexadecimal)")
        return self


def load(path: Path, axes: tuple[str, ...]) -> list[FaultEntry]:
    """Read a fault script for a machine with these axes; ConfigError with everything that is wrong with it."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_SCRIPT_BYTES + 1)
        if len(raw) > MAX_SCRIPT_BYTES:
            raise ConfigError(str(path), [ConfigFault("file", "is larger than 256 KiB", "a fault script is a few kB")])
    except OSError as error:
        raise ConfigError(
            str(path), [ConfigFault("file", f"cannot be read: {error.strerror}", "check the path")]
        ) from None
    document = toml_document(raw, str(path))
    faults = [ConfigFault(key, "is no key of a fault script", "[[fault]] is") for key in document if key != "fault"]
    entries: list[FaultEntry] = []
    listed = document.get("fault", [])
    for place, item in enumerate(listed if isinstance(listed, list) else [listed]):
        try:
            entries.append(parse(item, axes))
        except ConfigError as error:
            faults += [ConfigFault(f"fault[{place}].{f.path}", f.what, f.suggestion) for f in error.faults]
    if faults:
        raise ConfigError(str(path), faults)
    return entries


def parse(item: object, axes: tuple[str, ...], source: str = "fault") -> FaultEntry:
    """Check one entry; ConfigError with everything that is wrong with it."""
    try:
        entry = FaultEntry.model_validate(item)
    except ValidationError as error:
        raise ConfigError(
            source,
            [
                ConfigFault(".".join(map(str, e["loc"])) or "entry", e["msg"].removeprefix("Value error, "))
                for e in error.errors()
            ],
        ) from None
    if entry.axis is not None and entry.axis not in axes:
        raise ConfigError(source, [ConfigFault("axis", f"there is no axis {entry.axis!r}", f"use {', '.join(axes)}")])
    return entry


class FaultSchedule:
    """Starts and ends faults by SYNC."""

    def __init__(self, targets: Mapping[str, Target], period_s: float) -> None:
        self._targets, self._period_s = targets, period_s
        self._waiting: list[FaultEntry] = []
        self._running: list[tuple[int, FaultEntry]] = []  # SYNC at which it ends

    def add(self, entry: FaultEntry) -> None:
        """Take an entry into the schedule; ConfigError when its object cannot hold its value."""
        if entry.fault == "object":
            wrong = self._target(entry).object_fault(entry.index or 0, entry.sub, int(entry.number))
            if wrong:
                raise ConfigError("fault", [ConfigFault("object", wrong, "the drive's EDS lists its objects")])
        self._waiting.append(entry)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to start or to end."""
        return not self._waiting and not self._running

    def step(self, tick: int, row: int | None) -> list[FaultEntry]:
        """Start and end what is due at this SYNC; return what started. ``row`` counts a played file's rows."""
        for end, entry in [item for item in self._running if item[0] <= tick]:
            self._running.remove((end, entry))
            self._apply(entry, on=False)
        due = [entry for entry in self._waiting if self._is_due(entry, tick, row)]
        for entry in due:
            self._waiting.remove(entry)
            self._apply(entry, on=True)
            if entry.duration_s is not None:
                self._running.append((tick + max(1, round(entry.duration_s / self._period_s)), entry))
        return due

    def _is_due(self, entry: FaultEntry, tick: int, row: int | None) -> bool:
        if entry.at_row is not None:
            return row is not None and row >= entry.at_row
        at = entry.at_sync if entry.at_sync is not None else round((entry.at_s or 0.0) / self._period_s)
        return tick >= at

    def _apply(self, entry: FaultEntry, *, on: bool) -> None:
        FAULTS[entry.fault].apply(self._target(entry), entry, on)

    def _target(self, entry: FaultEntry) -> Target:
        return self._targets[entry.axis if entry.axis is not None else next(iter(self._targets))]
