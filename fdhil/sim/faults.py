"""The fault script: which fault happens when, to which axis, how badly and for how long.

    [[fault]]
    at_s = 2.5                 # or at_sync, counted from the first SYNC; or at_row, from a played file's first row
    axis = "X"
    fault = "load_torque"
    value = 5.0                # what it means is the fault's own affair, see FAULTS
    duration_s = 0.3           # left out: for good

A wrong entry is a ConfigError that names every fault of the script at once.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from fdhil.errors import ConfigError, ConfigFault
from fdhil.sim.modbus_sensor import SensorFaults
from fdhil.sim.sensors import SIGNALS, DriveFaults

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

    @model_validator(mode="after")
    def _whole(self) -> FaultEntry:
        kind = FAULTS[self.fault]
        if sum(at is not None for at in (self.at_s, self.at_sync, self.at_row)) > 1:
            raise ValueError("give one of at_s, at_sync and at_row")
        if kind.needs_axis and self.axis is None:
            raise ValueError(f"{self.fault} needs an axis")
        if kind.needs_value and self.value is None:
            raise ValueError(f"{self.fault} needs a value: {kind.value}")
        if self.fault == "frame" and (self.can_id is None or self.data is None):
            raise ValueError("frame needs can_id and data (hexadecimal)")
        return self


class Target(Protocol):
    """What a fault acts on: the drive and sensor of its axis, and the machine around them."""

    @property
    def drive_faults(self) -> DriveFaults:
        """The drive's fault state."""
        ...

    @property
    def sensor_faults(self) -> SensorFaults | None:
        """The sensor's fault state, None when the axis has none."""
        ...

    def trip(self, code: int) -> None:
        """Let the drive fall into fault with an error code."""
        ...

    def reboot(self) -> None:
        """Restart the drive: boot-up message, power-on values."""
        ...

    def power(self, on: bool) -> None:
        """Cut or restore the drive's supply."""
        ...

    def input(self, bit: int, on: bool) -> None:
        """Set a bit of 0x60FD."""
        ...

    def inject(self, can_id: int, data: bytes, on: bool) -> None:
        """Send a foreign frame at every SYNC while it is on."""
        ...

    def sync(self, on: bool) -> None:
        """Let the NC's SYNC fail, or come again."""
        ...


Action = Callable[[Target, FaultEntry, bool], None]


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A fault by name: ``apply(target, entry, on)`` starts it and ends it; ``value`` says what the value means."""

    apply: Action
    value: str = ""
    needs_value: bool = False
    needs_axis: bool = True


def _drive(name: str, off: Any, value: str = "") -> FaultKind:
    def apply(target: Target, entry: FaultEntry, on: bool) -> None:
        wanted = entry.value if value else True
        setattr(target.drive_faults, name, wanted if on else off)

    return FaultKind(apply, value, bool(value))


def _sensor(name: str, off: Any, value: str = "", convert: Callable[[float], Any] = float) -> FaultKind:
    def apply(target: Target, entry: FaultEntry, on: bool) -> None:
        if target.sensor_faults is not None:
            wanted = convert(entry.value or 0.0) if value else True
            setattr(target.sensor_faults, name, wanted if on else off)

    return FaultKind(apply, value, bool(value))


def _signal(signal: str, name: str, off: Any, value: str, convert: Callable[[float], Any]) -> FaultKind:
    def apply(target: Target, entry: FaultEntry, on: bool) -> None:
        wanted = convert(entry.value or 0.0) if value else True
        setattr(target.drive_faults.signal(signal), name, wanted if on else off)

    return FaultKind(apply, value, bool(value))


def _drop_tpdo(target: Target, entry: FaultEntry, on: bool) -> None:
    number = int(entry.value or 1)
    if on:
        target.drive_faults.drop_tpdo[number] = -1
    else:
        target.drive_faults.drop_tpdo.pop(number, None)


def _trip(target: Target, entry: FaultEntry, on: bool) -> None:
    if on:
        target.trip(int(entry.value or 0))


def _reboot(target: Target, _: FaultEntry, on: bool) -> None:
    if on:
        target.reboot()


_SIGNAL_FAULTS: tuple[tuple[str, str, Any, str, Callable[[float], Any]], ...] = (
    ("delayed", "delay_cycles", 0, "SYNC cycles", int),
    ("gain", "gain", 1.0, "factor", float),
    ("offset", "offset", 0.0, "in the signal's unit", float),
    ("clipped", "clip", None, "limit in the signal's unit", float),
    ("coarse", "resolution", 0.0, "resolution in the signal's unit", float),
    ("garbage", "garbage", 0.0, "amplitude in the signal's unit", float),
    ("stuck", "stuck", False, "", bool),
)

FAULTS: Mapping[str, FaultKind] = {
    "load_torque": _drive("load_torque_nm", 0.0, "N.m on the shaft"),
    "ignore_offset": _drive("ignore_offset", False),
    "offset_scale": _drive("offset_scale", 1.0, "factor on 0x60B0"),
    "not_csp": _drive("not_csp", False),
    "no_heartbeat_consumer": _drive("no_heartbeat_consumer", False),
    "drop_tpdo": FaultKind(_drop_tpdo, "number of the TPDO, 1 to 4", True),
    "trip": FaultKind(_trip, "error code of the EMCY, such as 0x3210", True),
    "reboot": FaultKind(_reboot),
    "power_off": FaultKind(lambda target, _, on: target.power(not on)),
    "digital_input": FaultKind(
        lambda target, entry, on: target.input(int(entry.value or 0), on), "bit of 0x60FD, 0 and 1 limits", True
    ),
    **{
        f"{signal}_{name}": _signal(signal, attribute, off, value, convert)
        for signal in SIGNALS
        for name, attribute, off, value, convert in _SIGNAL_FAULTS
    },
    "sensor_silent": _sensor("silent", False),
    "sensor_slow": _sensor("slow_s", 0.0, "seconds by which answers are late"),
    "sensor_exception": _sensor("exception", 0, "Modbus exception code", int),
    "sensor_stuck": _sensor("stuck", False),
    "sensor_delayed": _sensor("delay_samples", 0, "samples", int),
    "sensor_gain": _sensor("gain", 1.0, "factor"),
    "sensor_offset": _sensor("offset_v", 0.0, "V"),
    "sync_lost": FaultKind(lambda target, _, on: target.sync(not on), needs_axis=False),
    "frame": FaultKind(
        lambda target, entry, on: target.inject(entry.can_id or 0, bytes.fromhex(entry.data or ""), on),
        needs_axis=False,
    ),
}


def load(path: Path, axes: tuple[str, ...]) -> list[FaultEntry]:
    """Read a fault script for a machine with these axes; ConfigError with everything that is wrong with it."""
    try:
        raw = path.read_bytes()
        if len(raw) > MAX_SCRIPT_BYTES:
            raise ConfigError(str(path), [ConfigFault("file", "is larger than 256 KiB", "a fault script is a few kB")])
        document = tomllib.loads(raw.decode("utf-8"))
    except OSError as error:
        raise ConfigError(
            str(path), [ConfigFault("file", f"cannot be read: {error.strerror}", "check the path")]
        ) from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(path), [ConfigFault("file", f"is no TOML: {error}", "check the line it names")]) from None
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
        """Take an entry into the schedule."""
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
        axis = entry.axis if entry.axis is not None else next(iter(self._targets))
        FAULTS[entry.fault].apply(self._targets[axis], entry, on)
