"""Lists the named faults of the simulated machine, their targets and the meaning of their values.

A new fault is one line of :data:`FAULTS`; every listed fault is tested.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from fdhil.sim.drive.drive_sensors import SIGNALS
from fdhil.sim.frame_faults import VALUES, FaultValue, FrameFault, Way
from fdhil.sim.simulated_axis import SimulatedAxis
from fdhil.sim.wire.modbus_answers import ANSWER_FAULTS

_MODBUS_CODES = frozenset({1, 2, 3, 4, 5, 6, 7, 8, 10, 11})


class FaultEntry(BaseModel):
    """One entry of a script or of the operator's panel; without an ``at_`` key it starts at once."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    at_sync: Annotated[int, Field(ge=0)] | None = None
    at_row: Annotated[int, Field(ge=0)] | None = None
    axis: str | None = None
    fault: str
    value: Annotated[float, Field(allow_inf_nan=False)] | None = None
    duration_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    index: Annotated[int, Field(ge=0, le=0xFFFF)] | None = None
    sub: Annotated[int, Field(ge=0, le=0xFF)] = 0
    can_id: Annotated[int, Field(ge=0, le=0x7FF)] | None = None
    data: str | None = None
    way: Way | None = None
    percent: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None

    @property
    def start_conditions(self) -> tuple[float | None, int | None, int | None]:
        """When it starts, by time, SYNC or row."""
        return self.at_s, self.at_sync, self.at_row

    @property
    def number(self) -> float:
        """The value, 0 by default."""
        return 0.0 if self.value is None else self.value

    @property
    def share(self) -> float:
        """Percentage of the frames or answers that it affects."""
        return 100.0 if self.percent is None else self.percent

    @field_validator("fault")
    @classmethod
    def _validate_fault_name(cls, name: str) -> str:
        if name not in FAULTS:
            raise ValueError(_describe_unknown_fault(name))
        return name

    @field_validator("data")
    @classmethod
    def _validate_data(cls, text: str | None) -> str | None:
        if text is not None and len(bytes.fromhex(text)) > 8:
            raise ValueError("a CAN frame has at most 8 bytes")
        return text

    @model_validator(mode="after")
    def _validate_entry(self) -> FaultEntry:
        kind = FAULTS[self.fault]
        if sum(at is not None for at in self.start_conditions) > 1:
            raise ValueError("give one of at_s, at_sync and at_row")
        if kind.needs_axis and self.axis is None:
            raise ValueError(f"{self.fault} needs an axis")
        if kind.value is not None and self.value is None:
            raise ValueError(f"{self.fault} needs a value: {kind.value.meaning}")
        if kind.value is not None and (wrong := kind.value.find_fault(self.number)):
            raise ValueError(f"the value of {self.fault} ({kind.value.meaning}) is invalid: {wrong}")
        if self.fault == "object" and self.index is None:
            raise ValueError("object needs the index (and sub) of the object to overwrite")
        if self.fault in ("frame", "bus_inject") and (self.can_id is None or self.data is None):
            raise ValueError(f"{self.fault} needs can_id and data (hexadecimal)")
        return self


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A fault by name: ``apply(unit, entry, on)`` starts and ends it; a fault with a ``value`` needs one."""

    apply: Callable[[SimulatedAxis, FaultEntry, bool], None]
    value: FaultValue | None = None
    needs_axis: bool = True


def _create_attribute_fault(
    owner: Callable[[SimulatedAxis], object], name: str, off: Any, value: FaultValue | None = None
) -> FaultKind:
    """Return a fault that sets an attribute of a fault state to its value (True without one), and back to ``off``."""

    def apply_attribute(unit: SimulatedAxis, entry: FaultEntry, on: bool) -> None:
        wanted = True if value is None else int(entry.number) if value.whole else entry.number
        setattr(owner(unit), name, wanted if on else off)

    return FaultKind(apply_attribute, value)


_drive = partial(_create_attribute_fault, lambda unit: unit.drive.faults)
_sensor = partial(_create_attribute_fault, lambda unit: unit.sensor.faults)
_sensor_signal = partial(_create_attribute_fault, lambda unit: unit.sensor.faults.signal)


def _create_signal_fault(signal: str, name: str, off: Any, value: FaultValue | None) -> FaultKind:
    return _create_attribute_fault(lambda unit: unit.drive.faults.get_signal_fault(signal), name, off, value)


def _drop_tpdo(unit: SimulatedAxis, entry: FaultEntry, on: bool) -> None:
    if on:
        unit.drive.faults.drop_tpdo[int(entry.number)] = -1
    else:
        unit.drive.faults.drop_tpdo.pop(int(entry.number), None)


def _trip_drive(unit: SimulatedAxis, entry: FaultEntry, on: bool) -> None:
    if on:
        unit.drive.trip_fault(int(entry.number))


def _reboot_drive(unit: SimulatedAxis, _: FaultEntry, on: bool) -> None:
    if on:
        unit.switch_power(False)
        unit.switch_power(True)


def _suppress_sync(unit: SimulatedAxis, _: FaultEntry, on: bool) -> None:
    unit.sync_on = not on


def _inject_frame(unit: SimulatedAxis, entry: FaultEntry, on: bool) -> None:
    can_id = entry.can_id or 0
    if on:
        unit.injected[can_id] = (unit.bus, bytes.fromhex(entry.data or ""))
    else:
        unit.injected.pop(can_id, None)


def _corrupt_answers(unit: SimulatedAxis, entry: FaultEntry, on: bool) -> None:
    answers, kind = unit.sensor.faults.answers, entry.fault.removeprefix("sensor_")
    if on:
        answers[kind] = entry.share
    else:
        answers.pop(kind, None)


def _build_frame_fault(unit: SimulatedAxis, entry: FaultEntry) -> FrameFault:
    """Return the frame fault of an entry: for one COB-ID, else for the axis' drive, else for all frames."""
    node = None if entry.axis is None else _list_cob_ids(unit.drive.node_id)
    can_ids = node if entry.can_id is None else frozenset({entry.can_id})
    kind = entry.fault.removeprefix("bus_")
    value = 1 if entry.value is None else entry.value
    way = entry.way or ("sent" if kind == "inject" else None)
    data = bytes.fromhex(entry.data or "")
    return FrameFault(kind, value, can_ids, way, percent=entry.share, data=data)


def _list_cob_ids(node_id: int) -> frozenset[int]:
    return frozenset((*range(0x80 + node_id, 0x680, 0x80), 0x700 + node_id))


def _switch_bus_fault(unit: SimulatedAxis, entry: FaultEntry, on: bool) -> None:
    act = unit.wire.add if on else unit.wire.remove
    act(_build_frame_fault(unit, entry))


def _switch_bus_down(unit: SimulatedAxis, _: FaultEntry, on: bool) -> None:
    unit.wire.down = on


_TPDO = FaultValue("number of the TPDO", 1, 4, whole=True)
_FACTOR = FaultValue("factor", -100, 100)
_SIGNAL_FAULTS: tuple[tuple[str, str, Any, FaultValue | None], ...] = (
    ("delayed", "delay_cycles", 0, FaultValue("SYNC cycles", 0, 10000, whole=True)),
    ("gain", "gain", 1.0, _FACTOR),
    ("offset", "offset", 0.0, FaultValue("in the signal's unit")),
    ("clipped", "clip", None, FaultValue("limit in the signal's unit", 0)),
    ("coarse", "resolution", 0.0, FaultValue("resolution in the signal's unit", 0)),
    ("garbage", "garbage", 0.0, FaultValue("amplitude in the signal's unit", 0)),
    ("stuck", "stuck", False, None),
)

FAULTS: Mapping[str, FaultKind] = {
    "load_torque": _drive("load_torque_nm", 0.0, FaultValue("N.m on the shaft", -1e4, 1e4)),
    "ignore_offset": _drive("ignore_offset", False),
    "offset_scale": _drive("offset_scale", 1.0, _FACTOR),
    "not_csp": _drive("not_csp", False),
    "no_heartbeat_consumer": _drive("no_heartbeat_consumer", False),
    "drop_tpdo": FaultKind(_drop_tpdo, _TPDO),
    "trip": FaultKind(_trip_drive, FaultValue("error code of the EMCY, such as 0x3210", 1, 0xFFFF, whole=True)),
    "reboot": FaultKind(_reboot_drive),
    "power_off": FaultKind(lambda unit, _, on: unit.switch_power(not on)),
    "remap": FaultKind(lambda unit, entry, _: unit.reverse_tpdo_mapping(int(entry.number)), _TPDO),
    "object": FaultKind(
        lambda unit, entry, on: unit.overwrite_object(entry.index or 0, entry.sub, int(entry.number), on),
        FaultValue("number written to the object", -(2**31), 2**32 - 1, whole=True),
    ),
    "digital_input": FaultKind(
        lambda unit, entry, on: unit.set_digital_input(int(entry.number), on),
        FaultValue("bit of 0x60FD, 0 and 1 are the limit switches", 0, 31, whole=True),
    ),
    **{
        f"{signal}_{name}": _create_signal_fault(signal, attribute, off, value)
        for signal in SIGNALS
        for name, attribute, off, value in _SIGNAL_FAULTS
    },
    "sensor_silent": _sensor("silent", False),
    "sensor_slow": _sensor("slow_s", 0.0, FaultValue("seconds by which answers are late", 0, 60)),
    "sensor_exception": _sensor(
        "exception", 0, FaultValue("Modbus exception code", 1, 11, whole=True, among=_MODBUS_CODES)
    ),
    **{f"sensor_{kind}": FaultKind(_corrupt_answers) for kind in ANSWER_FAULTS},
    "sensor_stuck": _sensor_signal("stuck", False),
    "sensor_delayed": _sensor_signal("delay_cycles", 0, FaultValue("samples", 0, 10000, whole=True)),
    "sensor_gain": _sensor_signal("gain", 1.0, _FACTOR),
    "sensor_offset": _sensor_signal("offset", 0.0, FaultValue("V")),
    **{
        f"bus_{kind}": FaultKind(_switch_bus_fault, value, needs_axis=False)
        for kind, value in VALUES.items()
        if kind != "raise"  # raise concerns the holder of a bus object only
    },
    "bus_down": FaultKind(_switch_bus_down, needs_axis=False),
    "sync_lost": FaultKind(_suppress_sync, needs_axis=False),
    "frame": FaultKind(_inject_frame, needs_axis=False),
}


@lru_cache(16)
def _describe_unknown_fault(name: str) -> str:
    """Return the message for an unknown name; cached, as a long script may repeat one mistake."""
    near = difflib.get_close_matches(name, FAULTS, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"unknown fault {name!r}{hint}; the faults are {', '.join(FAULTS)}"
