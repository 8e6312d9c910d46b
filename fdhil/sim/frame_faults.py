"""Applies planned faults to the frames of a CAN bus: which frames, which direction, from which SYNC, and how. Pure.

Each fault draws from its own random source per direction, so that the same frames in the same order get the same
faults, whatever happens in the other direction.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any, Literal

from fdhil.sim.frame_types import Frame

SYNC = 0x80
_NEVER = float("inf")
Way = Literal["sent", "received"]
Passed = tuple[Frame, Any]
"""A passing frame with its sender's reference (None: injected)."""


@dataclass(frozen=True, slots=True)
class FaultValue:
    """The meaning of a fault's value, and its limits."""

    meaning: str
    low: float = -1e6
    high: float = 1e6
    whole: bool = False
    among: frozenset[int] = frozenset()

    def find_fault(self, value: float) -> str:
        """Return why a value is invalid, "" when it is valid."""
        if self.whole and value != int(value):
            return f"{value:g} is not a whole number"
        if not self.low <= value <= self.high or (self.among and value not in self.among):
            allowed = ", ".join(map(str, sorted(self.among))) or f"{self.low:g} to {self.high:g}"
            return f"{value:g} is not among {allowed}"
        return ""


VALUES: Mapping[str, FaultValue | None] = {
    "drop": None,
    "duplicate": FaultValue("additional copies of the frame", 1, 1000, whole=True),
    "reorder": FaultValue("frames of the same way that overtake it", 1, 1000, whole=True),
    "delay": FaultValue("SYNC cycles", 1, 10000, whole=True),
    "late": FaultValue("seconds", 0, 60),
    "mutate": FaultValue("bits that are flipped", 1, 64, whole=True),
    "truncate": FaultValue("remaining bytes", 0, 7, whole=True),
    "extend": FaultValue("added bytes, up to 8 in total", 1, 8, whole=True),
    "inject": FaultValue("frames at every SYNC", 1, 1e6, whole=True),
    "raise": FaultValue("error number, such as 105 (ENOBUFS) or 100 (ENETDOWN)", 1, 4095, whole=True),
}
"""The faults of frames, with the meaning of their values."""


@dataclass(frozen=True, slots=True)
class FrameFault:
    """One entry of a plan; ValueError when it is inconsistent.

    ``can_ids``: the affected identifiers, None for all (29 bit identifiers with ``frame.EXTENDED``). ``way``: frames
    that the holder of the bus ``sent`` or ``received``, None for both; an injected frame goes the named way, None: is
    received. ``from_sync``, ``until_sync``: SYNC frames on this bus, the first is number 0 (-1: from the start, before
    any SYNC). ``percent`` of the matching frames are affected, at most ``times`` of them. ``data`` (and one identifier)
    define an injected frame.
    """

    kind: str
    value: float = 1
    can_ids: Collection[int] | None = None
    way: Way | None = None
    from_sync: int = -1
    until_sync: int | None = None
    percent: float = 100.0
    times: int | None = None
    data: bytes = b""

    def __post_init__(self) -> None:
        if self.kind not in VALUES:
            raise ValueError(f"unknown fault {self.kind!r}; the faults are {', '.join(VALUES)}")
        meaning = VALUES[self.kind]
        if meaning is not None and (wrong := meaning.find_fault(self.value)):
            raise ValueError(f"the value of {self.kind} ({meaning.meaning}) is invalid: {wrong}")
        if not 0 < self.percent <= 100:
            raise ValueError(f"percent is {self.percent:g}; it must be above 0 and at most 100")
        if len(self.data) > 8:
            raise ValueError("a CAN frame has at most 8 bytes")
        if self.kind == "inject" and (self.can_ids is None or len(self.can_ids) != 1):
            raise ValueError("inject needs exactly one identifier")


class PlannedBusError(Exception):
    """A planned error of the bus itself, by its error number."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(number)


@dataclass(slots=True)
class _ActiveFault:
    fault: FrameFault
    draws: Mapping[Way, Random]
    met: int = 0

    def applies_to(self, can_id: int, way: Way, sync: int) -> bool:
        fault = self.fault
        if (fault.way is not None and way != fault.way) or (fault.can_ids is not None and can_id not in fault.can_ids):
            return False
        if not self.is_due(sync) or (fault.times is not None and self.met >= fault.times):
            return False
        if fault.percent < 100 and self.draws[way].random() * 100 >= fault.percent:
            return False
        self.met += 1
        return True

    def is_due(self, sync: int) -> bool:
        fault = self.fault
        return fault.from_sync <= sync and (fault.until_sync is None or sync < fault.until_sync)


@dataclass(slots=True)
class _DelayedFrame:
    passed: Passed
    way: Way
    sync: float = _NEVER
    overtaken: float = _NEVER
    at_s: float = _NEVER


class FrameFaults:
    """Executes a plan. ``sync`` counts the SYNC frames; ``counted`` the applied faults, by kind and identifier.

    While it is ``down`` no frame passes.
    """

    def __init__(self, plan: Sequence[FrameFault] = (), seed: int = 0) -> None:
        self.sync = -1
        self.counted: Counter[tuple[str, int]] = Counter()
        self.down = False
        self._seed, self._made = seed, 0
        self._plan: list[_ActiveFault] = []
        self._held: list[_DelayedFrame] = []
        for fault in plan:
            self.add(fault)

    def add(self, fault: FrameFault) -> None:
        """Add a fault to the plan; it acts after the present ones."""
        ways: tuple[Way, ...] = ("sent", "received")
        draws = {way: Random(f"{self._seed}:{self._made}:{way}") for way in ways}
        self._made += 1
        self._plan.append(_ActiveFault(fault, draws))

    def remove(self, fault: FrameFault) -> None:
        """End a fault; frames that it delays are still released in time."""
        self._plan.remove(next(active for active in self._plan if active.fault == fault))

    @property
    def is_idle(self) -> bool:
        """Whether every frame passes unchanged."""
        return not self._plan and not self._held and not self.down

    def total(self, kind: str, *can_ids: int) -> int:
        """Return how many frames were affected by this kind of fault, of these identifiers or of all."""
        return sum(n for (what, i), n in self.counted.items() if what == kind and (not can_ids or i in can_ids))

    def process_frame(self, frame: Frame, way: Way, now_s: float, origin: Any = None) -> list[Passed]:
        """Return the frames that replace a frame, at once; PlannedBusError for a planned error."""
        if self.down:
            self.counted["down", frame[0]] += 1
            return []
        if frame[0] == SYNC:
            self.sync += 1
        if self.is_idle:
            return [(frame, origin)]
        passed: list[Passed] = [(frame, origin)]
        for active in self._plan:
            if active.fault.kind != "inject":
                passed = [out for each in passed for out in self._apply_fault(active, each, way, now_s)]
        if self._held and passed:
            passed += self._release_overtaken(way)
        if frame[0] == SYNC:
            self._inject_frames()
            passed += self.release_due(way, now_s)
        return passed

    def release_due(self, way: Way, now_s: float) -> list[Passed]:
        return self._release_frames(lambda held: held.way == way and (held.sync <= self.sync or held.at_s <= now_s))

    def find_next_due_s(self) -> float:
        """Return when :meth:`due` has a frame by time alone; infinite: never."""
        return min((held.at_s for held in self._held), default=_NEVER)

    def _apply_fault(self, active: _ActiveFault, passed: Passed, way: Way, now_s: float) -> list[Passed]:
        (can_id, data), origin = passed
        fault = active.fault
        swaps = fault.kind == "reorder" and any(held.way == way and held.overtaken < _NEVER for held in self._held)
        if swaps or not active.applies_to(can_id, way, self.sync):  # one reordered frame at a time
            return [passed]
        self.counted[fault.kind, can_id] += 1
        if fault.kind == "raise":
            raise PlannedBusError(int(fault.value))
        if fault.kind == "duplicate":
            return [passed] * (1 + int(fault.value))
        held = _delay_frame(fault, passed, way, self.sync, now_s)
        if held is not None:
            self._held.append(held)
            return []
        changed = _corrupt_data(fault, data, active.draws[way])
        return [] if changed is None else [((can_id, changed), origin)]

    def _release_overtaken(self, way: Way) -> list[Passed]:
        for held in self._held:
            if held.way == way:
                held.overtaken -= 1
        return self._release_frames(lambda held: held.overtaken <= 0)

    def _release_frames(self, goes: Callable[[_DelayedFrame], bool]) -> list[Passed]:
        if not self._held:
            return []
        out = [held.passed for held in self._held if goes(held)]
        if out:
            self._held = [held for held in self._held if not goes(held)]
        return out

    def _inject_frames(self) -> None:
        for active in self._plan:
            fault = active.fault
            if fault.kind != "inject" or not active.is_due(self.sync):
                continue
            (can_id,) = fault.can_ids or ()
            for _ in range(int(fault.value)):
                if fault.times is not None and active.met >= fault.times:
                    break
                active.met += 1
                self.counted["inject", can_id] += 1
                self._held.append(_DelayedFrame(((can_id, fault.data), None), fault.way or "received", sync=self.sync))


def _delay_frame(fault: FrameFault, passed: Passed, way: Way, sync: int, now_s: float) -> _DelayedFrame | None:
    """Return the delayed frame of a fault, None for a fault without delay."""
    if fault.kind == "reorder":
        return _DelayedFrame(passed, way, overtaken=fault.value)
    if fault.kind == "delay":
        return _DelayedFrame(passed, way, sync=sync + fault.value)
    return _DelayedFrame(passed, way, at_s=now_s + fault.value) if fault.kind == "late" else None


def _corrupt_data(fault: FrameFault, data: bytes, draw: Random) -> bytes | None:
    """Return the changed content of a frame, None for a dropped frame."""
    value = int(fault.value)
    if fault.kind == "mutate":
        changed = bytearray(data)
        for bit in draw.sample(range(8 * len(data)), min(value, 8 * len(data))):
            changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)
    if fault.kind == "truncate":
        return data[:value]
    return (data + draw.randbytes(value))[:8] if fault.kind == "extend" else None
