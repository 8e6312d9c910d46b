"""The named faults of the simulated machine: what each acts on, and what its value means.

A newcomer adds a fault by one line of :data:`FAULTS`; being listed is being tested.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from fdhil.sim.drive.sensors import SIGNALS, DriveFaults
from fdhil.sim.wire.modbus_sensor import SensorFaults

if TYPE_CHECKING:
    from fdhil.sim.faults import FaultEntry


class Target(Protocol):
    """What a fault acts on: the drive and sensor of its axis, and the machine around them."""

    @property
    def drive_faults(self) -> DriveFaults:
        """The drive's fault state."""
        ...

    @property
    def sensor_faults(self) -> SensorFaults:
        """The sensor's fault state."""
        ...

    def object_fault(self, index: int, sub: int, value: int) -> str:
        """Return why an object cannot hold a value, "" when it can."""
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

    def put(self, index: int, sub: int, value: int, on: bool) -> None:
        """Write an object past all access rules, or give it its value back."""
        ...

    def remap(self, number: int, on: bool) -> None:
        """Turn the order of a TPDO's objects, or put it right again."""
        ...

    def sync(self, on: bool) -> None:
        """Let the NC's SYNC fail, or come again."""
        ...


Action = Callable[[Target, "FaultEntry", bool], None]
_MODBUS_CODES = frozenset({1, 2, 3, 4, 5, 6, 7, 8, 10, 11})


@dataclass(frozen=True, slots=True)
class FaultValue:
    """What the value of a fault means, and between which limits it lies."""

    meaning: str
    low: float = -1e6
    high: float = 1e6
    whole: bool = False
    among: frozenset[int] = frozenset()

    def fault(self, value: float) -> str:
        """Return what is wrong with a value, "" when nothing is."""
        if self.whole and value != int(value):
            return f"{value:g} is no whole number"
        if not self.low <= value <= self.high or (self.among and value not in self.among):
            allowed = ", ".join(map(str, sorted(self.among))) or f"{self.low:g} to {self.high:g}"
            return f"{value:g} is not among {allowed}"
        return ""


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A fault by name: ``apply(target, entry, on)`` starts it and ends it; a fault with a ``value`` needs one."""

    apply: Action
    value: FaultValue | None = None
    needs_axis: bool = True


def _attribute(owner: Callable[[Target], object], name: str, off: Any, value: FaultValue | None) -> FaultKind:
    """A fault that is an attribute of a fault state: set to its value (True without one), reset to ``off``."""

    def apply(target: Target, entry: FaultEntry, on: bool) -> None:
        wanted = True if value is None else int(entry.number) if value.whole else entry.number
        setattr(owner(target), name, wanted if on else off)

    return FaultKind(apply, value)


def _drive(name: str, off: Any, value: FaultValue | None = None) -> FaultKind:
    return _attribute(lambda target: target.drive_faults, name, off, value)


def _sensor(name: str, off: Any, value: FaultValue | None = None) -> FaultKind:
    return _attribute(lambda target: target.sensor_faults, name, off, value)


def _signal(signal: str, name: str, off: Any, value: FaultValue | None) -> FaultKind:
    return _attribute(lambda target: target.drive_faults.signal(signal), name, off, value)


def _drop_tpdo(target: Target, entry: FaultEntry, on: bool) -> None:
    if on:
        target.drive_faults.drop_tpdo[int(entry.number)] = -1
    else:
        target.drive_faults.drop_tpdo.pop(int(entry.number), None)


def _trip(target: Target, entry: FaultEntry, on: bool) -> None:
    if on:
        target.trip(int(entry.number))


def _reboot(target: Target, _: FaultEntry, on: bool) -> None:
    if on:
        target.reboot()


def _object(target: Target, entry: FaultEntry, on: bool) -> None:
    target.put(entry.index or 0, entry.sub, int(entry.number), on)


def _frame(target: Target, entry: FaultEntry, on: bool) -> None:
    target.inject(entry.can_id or 0, bytes.fromhex(entry.data or ""), on)


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
    "trip": FaultKind(_trip, FaultValue("error code of the EMCY, such as 0x3210", 1, 0xFFFF, whole=True)),
    "reboot": FaultKind(_reboot),
    "power_off": FaultKind(lambda target, _, on: target.power(not on)),
    "remap": FaultKind(lambda target, entry, on: target.remap(int(entry.number), on), _TPDO),
    "object": FaultKind(_object, FaultValue("number written to the object", -(2**31), 2**32 - 1, whole=True)),
    "digital_input": FaultKind(
        lambda target, entry, on: target.input(int(entry.number), on),
        FaultValue("bit of 0x60FD, 0 and 1 are the limit switches", 0, 31, whole=True),
    ),
    **{
        f"{signal}_{name}": _signal(signal, attribute, off, value)
        for signal in SIGNALS
        for name, attribute, off, value in _SIGNAL_FAULTS
    },
    "sensor_silent": _sensor("silent", False),
    "sensor_slow": _sensor("slow_s", 0.0, FaultValue("seconds by which answers are late", 0, 60)),
    "sensor_exception": _sensor(
        "exception", 0, FaultValue("Modbus exception code", 1, 11, whole=True, among=_MODBUS_CODES)
    ),
    "sensor_stuck": _sensor("stuck", False),
    "sensor_delayed": _sensor("delay_samples", 0, FaultValue("samples", 0, 10000, whole=True)),
    "sensor_gain": _sensor("gain", 1.0, _FACTOR),
    "sensor_offset": _sensor("offset_v", 0.0, FaultValue("V")),
    "sync_lost": FaultKind(lambda target, _, on: target.sync(not on), needs_axis=False),
    "frame": FaultKind(_frame, needs_axis=False),
}
