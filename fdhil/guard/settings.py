"""What the guard is told at start: a frozen record that goes through one JSON file in the run directory.

The file is written by ``fdhil-guard`` from the machine's config and profile; the guard reads nothing else.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from fdhil.cia402 import PdoEntry, lay_out
from fdhil.errors import ConfigError, ConfigFault
from fdhil.guard import feedforward
from fdhil.guard.limits import Limits

SCHEMA = "fdhil-guard-settings-1"
MAX_CHARS = 1024 * 1024
Layout = tuple[tuple[int, int, int, bool], ...]
"""Entries (index, sub-index, bits, signed) of a PDO, one behind the other."""


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO: its COB-ID, its layout and with every how many SYNC it comes."""

    cob_id: int
    layout: Layout
    every_sync: int = 1

    @property
    def entries(self) -> tuple[PdoEntry, ...]:
        """The placed entries."""
        return lay_out(self.layout)


@dataclass(frozen=True, slots=True)
class Feedforward:
    """What the on-line feed-forward may send: ``pdo`` maps 0x60B1 and 0x60B2, ``limits`` in the drive's counts."""

    pdo: Pdo
    limits: feedforward.Limits


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """One axis: ``target`` is the NC's RPDO with 0x607A, ``offset`` our own RPDO with 0x60B0 alone.

    ``window`` is the drive's following error window (0x6065) in increments; ``limits`` in increments per SYNC cycle.
    ``speed_count`` is one count of 0x606C in increments per SYNC cycle, ``speed_step`` by how much of that the motor's
    speed can change in one cycle; 0: not judged.
    ``travel`` are the drive's software limits (0x607D), None: it has none.
    ``heartbeat_timeout_s`` 0: the drive has no heartbeat, and its PDOs alone show that it is Operational.
    """

    name: str
    node_id: int
    target: Pdo
    offset: Pdo
    tpdos: tuple[Pdo, ...]
    increments_per_mm: float
    sign: int
    limits: Limits
    window: int
    setpoint_delay_cycles: int
    heartbeat_timeout_s: float = 0.0
    feedforward: Feedforward | None = None
    speed_count: float = 0.0
    speed_step: float = 0.0
    travel: tuple[int, int] | None = None

    @property
    def reads_back(self) -> bool:
        """Whether a TPDO shows the offset in force."""
        return any(entry[0] == 0x60B0 for pdo in self.tpdos for entry in pdo.layout)


@dataclass(frozen=True, slots=True)
class Settings:
    """The machine as the guard sees it.

    ``clock`` "sync": time is SYNC count x period (a simulated machine need not run in real time). ``token_sha256`` is
    the hash of the operator's token, empty: nothing can be armed. ``offset_synchronous``: the drive applies our RPDO
    at the next SYNC, so that without SYNC nothing can be ramped.
    """

    bus: str
    transport: Literal["can_raw", "socketcand"]
    sync_period_s: float
    clock: Literal["monotonic", "sync"]
    heartbeat_s: float
    node_id: int
    token_sha256: str
    run_directory: str
    axes: tuple[AxisSettings, ...]
    offset_synchronous: bool = True

    @property
    def silence_s(self) -> float:
        """How long the bus may be without SYNC: four periods; 5 s of wall clock where time is the SYNC count.

        A simulated machine stands still between two SYNCs, and its slowest listener may hold it up.
        """
        return 5.0 if self.clock == "sync" else 4 * self.sync_period_s

    @property
    def daemon_lost_s(self) -> float:
        """How long the daemon may say nothing while it has something armed."""
        return 5.0 if self.clock == "sync" else 0.5

    @property
    def heartbeat_cycles(self) -> int:
        """Our heartbeat comes with every so many SYNC."""
        return max(1, round(self.heartbeat_s / self.sync_period_s))

    def cycles(self, seconds: float) -> int:
        """Return a duration in whole SYNC cycles, at least one."""
        return max(1, round(seconds / self.sync_period_s))

    @property
    def sent_ids(self) -> frozenset[int]:
        """The only COB-IDs that may ever leave: our heartbeat and the configured offset RPDOs."""
        fed = [axis.feedforward.pdo.cob_id for axis in self.axes if axis.feedforward is not None]
        return frozenset([0x700 + self.node_id, *(axis.offset.cob_id for axis in self.axes), *fed])

    @property
    def feeds(self) -> tuple[Feedforward, ...]:
        """The feed-forward of every axis; empty when an axis has none."""
        found = [axis.feedforward for axis in self.axes if axis.feedforward is not None]
        return tuple(found) if len(found) == len(self.axes) else ()


def to_json(settings: Settings) -> str:
    """Return the settings as the text of their file, which ends with a digest over them."""
    document = {"schema": SCHEMA, **asdict(settings)}
    digest = hashlib.sha256(json.dumps(document).encode()).hexdigest()
    return json.dumps({**document, "digest": digest}, indent=1)


def from_json(text: str, source: str = "settings") -> Settings:
    """Read settings back; ConfigError when the text is not what ``to_json`` writes."""
    try:
        document = json.loads(text)
        if document.pop("schema") != SCHEMA:
            raise ValueError(f"schema is not {SCHEMA}")
        document.pop("digest", None)
        axes = tuple(_axis(axis) for axis in document.pop("axes"))
        settings = Settings(axes=axes, **document)
        _check(settings)
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        fault = ConfigFault("file", f"cannot be used: {str(error)[:200]}", "let fdhil-guard write it")
        raise ConfigError(source, [fault]) from None
    return settings


def load(path: Path) -> Settings:
    """Read the settings file; ConfigError when it cannot be read or used, or is not as it was written."""
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(MAX_CHARS + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), [ConfigFault("file", f"cannot be read: {error}", "run fdhil-guard")]) from None
    settings = from_json(text, str(path))
    if to_json(settings) != text:  # a bit of a limit may have flipped
        fault = ConfigFault("file", "is damaged or was changed by hand", "let fdhil-guard write it")
        raise ConfigError(str(path), [fault])
    return settings


def _pdo(document: Mapping[str, Any]) -> Pdo:
    layout = tuple((int(i), int(s), int(b), bool(signed)) for i, s, b, signed in document["layout"])
    return Pdo(int(document["cob_id"]), layout, int(document["every_sync"]))


def _axis(document: dict[str, Any]) -> AxisSettings:
    tpdos = tuple(_pdo(pdo) for pdo in document.pop("tpdos"))
    target, offset = _pdo(document.pop("target")), _pdo(document.pop("offset"))
    limits, feed = Limits(**document.pop("limits")), document.pop("feedforward")
    travel = document.pop("travel")
    if travel is not None:
        low, high = map(int, travel)
        document["travel"] = (low, high)
    if feed is not None:
        feed = Feedforward(_pdo(feed["pdo"]), feedforward.Limits(*map(int, feed["limits"])))
    return AxisSettings(target=target, offset=offset, tpdos=tpdos, limits=limits, feedforward=feed, **document)


def _check(settings: Settings) -> None:
    """Refuse what would make the guard's own arithmetic wrong; ValueError names it."""
    if not settings.axes:
        raise ValueError("no axis may be corrected (an [axis.NAME.correction] section switches writing on)")
    if not 0 < settings.sync_period_s <= 1 or not 0 < settings.heartbeat_s <= 10:
        raise ValueError("sync_period_s or heartbeat_s is out of range")
    if settings.clock not in ("monotonic", "sync") or settings.transport not in ("can_raw", "socketcand"):
        raise ValueError("unknown clock or transport")
    if len(settings.sent_ids) != 1 + len(settings.axes) + sum(a.feedforward is not None for a in settings.axes):
        raise ValueError("two of our PDOs share one COB-ID")
    for axis in settings.axes:
        _check_axis(axis)


def _check_axis(axis: AxisSettings) -> None:
    if [(entry[0], entry[1]) for entry in axis.offset.layout] != [(0x60B0, 0)]:
        raise ValueError(f"axis {axis.name}: the offset RPDO must map 0x60B0:00 and nothing else")
    feed = axis.feedforward
    if feed is not None and [entry[:2] for entry in feed.pdo.layout] != [(0x60B1, 0), (0x60B2, 0)]:
        raise ValueError(f"axis {axis.name}: the feed-forward's RPDO must map 0x60B1:00 and 0x60B2:00 and nothing else")
    if feed is not None and not (0x180 <= feed.pdo.cob_id < 0x580 and min(feed.limits) >= 1):
        raise ValueError(f"axis {axis.name}: the feed-forward has no RPDO, or a limit below 1")
    if not all(type(value) is int and value >= 1 for value in asdict(axis.limits).values()):
        raise ValueError(f"axis {axis.name}: limits must be whole increments, at least 1")
    if not 0x180 <= axis.offset.cob_id < 0x580 or type(axis.window) is not int or axis.window < 1:
        raise ValueError(
            f"axis {axis.name}: {axis.offset.cob_id:#x} is no RPDO, or the window is no number of increments"
        )
    if not 0.0 <= axis.speed_step < 2**31 or not 0.0 <= axis.speed_count < 2**31:
        raise ValueError(f"axis {axis.name}: speed_count or speed_step is out of range")
    if type(axis.setpoint_delay_cycles) is not int or not 0 <= axis.setpoint_delay_cycles <= 16:
        raise ValueError(f"axis {axis.name}: setpoint_delay_cycles is out of range")
