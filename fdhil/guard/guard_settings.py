"""Writes, reads and checks the guard's settings: a frozen record in one JSON file of the run directory.

``fdhil-guard`` writes the file from the machine's config and profile; the guard reads nothing else.
"""

import hashlib
import json
import os
import re
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from fdhil.cia402 import COB_HEARTBEAT, Object, PdoEntry, lay_out
from fdhil.errors import ConfigError, ConfigFault
from fdhil.guard import feedforward_law
from fdhil.guard.offset_limits import OffsetLimits, compute_limit_ceilings

SCHEMA = "fdhil-guard-settings-2"
MAX_BYTES = 1 << 20
MOST_INCREMENTS_PER_MM = 1e6
Layout = tuple[tuple[int, int, int, bool], ...]
"""Entries (index, sub-index, bits, signed) of a PDO, one behind the other."""
OFFSET_LAYOUT: Layout = ((Object.POSITION_OFFSET, 0, 32, True),)
LEAD_LAYOUT: Layout = (*OFFSET_LAYOUT, (0x0005, 0, 8, False))
"""With a lead: after the offset, in a dummy entry (CiA 301), the counter of the SYNC that it answers."""
MOST_LEAD = 200
FEED_LAYOUT: Layout = ((Object.VELOCITY_OFFSET, 0, 32, True), (Object.TORQUE_OFFSET, 0, 16, True))


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO: its COB-ID, its layout, and its period in SYNC cycles."""

    cob_id: int
    layout: Layout
    every_sync: int = 1

    @property
    def entries(self) -> tuple[PdoEntry, ...]:
        """The entries with their bit offsets."""
        return lay_out(self.layout)


@dataclass(frozen=True, slots=True)
class FeedforwardPdo:
    """The on-line feed-forward's PDO, which maps 0x60B1 and 0x60B2, and its ``limits`` in the drive's counts."""

    pdo: Pdo
    limits: feedforward_law.FeedforwardLimits


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """One axis: ``target`` is the NC's RPDO with 0x607A, ``offset`` our own RPDO with 0x60B0 alone.

    ``window`` is the drive's following error window (0x6065) in increments; ``limits`` are in increments per SYNC cycle
    and bounded by the axis' ``max_speed_mm_s`` and ``max_acceleration_mm_s2``, too. ``speed_count`` is one count of
    0x606C in increments per SYNC cycle, ``speed_step`` the largest change of the motor's speed in one cycle in that
    unit; 0: not checked. ``travel`` are the drive's software limits (0x607D), None: it has none.
    ``compute_heartbeat_timeout_s`` 0: the drive has no heartbeat, only its PDOs show that it is Operational.
    ``writers`` are
    foreign COB-IDs whose frames may change an offset of the drive. ``record`` is the fingerprint of the commissioned
    drive, empty: not commissioned; ``record_void``: an event since then voids it, ``read_void_reason`` names the event.
    """

    name: str
    node_id: int
    target: Pdo
    offset: Pdo
    tpdos: tuple[Pdo, ...]
    increments_per_mm: float
    max_speed_mm_s: float
    max_acceleration_mm_s2: float
    sign: int
    limits: OffsetLimits
    window: int
    setpoint_delay_cycles: int
    heartbeat_timeout_s: float = 0.0
    feedforward: FeedforwardPdo | None = None
    speed_count: float = 0.0
    speed_step: float = 0.0
    travel: tuple[int, int] | None = None
    writers: tuple[int, ...] = ()
    record: str = ""
    record_void: bool = False
    void_reason: str = ""

    @property
    def read_back_every(self) -> int:
        """Period, in SYNC cycles, of the TPDO that shows the offset in force; 0: there is none."""
        shown = [pdo.every_sync for pdo in self.tpdos if any(e[:2] == OFFSET_LAYOUT[0][:2] for e in pdo.layout)]
        return max(1, min(shown)) if shown else 0


@dataclass(frozen=True, slots=True)
class GuardSettings:
    """The machine as the guard sees it.

    ``clock`` "sync": time is SYNC count x period (a simulated machine need not run in real time). ``token_sha256`` is
    the hash of the operator's token, empty: nothing can be armed. ``offset_synchronous``: the drive applies our RPDO at
    the next SYNC, so that without SYNC nothing can be ramped. ``daemon_uid`` is the daemon's user where it differs from
    the guard's, ``watching`` are users who may also watch and disarm. ``lead``: an offset takes effect that many cycles
    later than at the next SYNC, because it waits in a queue (HAL's streamer).
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
    daemon_uid: int | None = None
    watching: tuple[int, ...] = ()
    lead: int = 0

    @property
    def silence_s(self) -> float:
        """Longest time without SYNC: four periods and the lead; 10 s where time is the SYNC count.

        A simulated machine stands still between two SYNCs, and its slowest participant may delay it.
        """
        return 10.0 if self.clock == "sync" else (4 + self.lead) * self.sync_period_s

    @property
    def daemon_lost_s(self) -> float:
        """Longest silence of the daemon while it has something armed."""
        return 10.0 if self.clock == "sync" else 0.5

    @property
    def heartbeat_cycles(self) -> int:
        """Period of our heartbeat in SYNC cycles."""
        return self.convert_to_cycles(self.heartbeat_s)

    def convert_to_cycles(self, seconds: float) -> int:
        """Convert a duration to whole SYNC cycles, at least one."""
        return max(1, round(seconds / self.sync_period_s))

    @property
    def sent_ids(self) -> frozenset[int]:
        """The only COB-IDs that may be sent: our heartbeat and the configured offset RPDOs."""
        fed = [axis.feedforward.pdo.cob_id for axis in self.axes if axis.feedforward is not None]
        return frozenset([0x700 + self.node_id, *(axis.offset.cob_id for axis in self.axes), *fed])

    @property
    def feeds(self) -> tuple[FeedforwardPdo, ...]:
        """The feed-forward of every axis; empty when an axis has none."""
        found = [axis.feedforward for axis in self.axes if axis.feedforward is not None]
        return tuple(found) if len(found) == len(self.axes) else ()


def encode_settings(settings: GuardSettings) -> str:
    """Return the settings as the text of their file, which ends with a digest of them."""
    document = {"schema": SCHEMA, **asdict(settings)}
    digest = hashlib.sha256(json.dumps(document).encode()).hexdigest()
    return json.dumps({**document, "digest": digest}, indent=1)


def decode_settings(text: str, source: str = "settings") -> GuardSettings:
    """Parse settings; ConfigError when the text is not what ``encode_settings`` writes, or exceeds a ceiling."""
    try:
        document = json.loads(text, parse_constant=refuse_constant)
        if document.pop("schema") != SCHEMA:
            raise ValueError(f"schema is not {SCHEMA}")
        document.pop("digest", None)
        axes = tuple(_parse_axis(axis) for axis in document.pop("axes"))
        settings = GuardSettings(axes=axes, watching=tuple(document.pop("watching")), **document)
        _check_settings(settings)
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        fault = ConfigFault("file", f"cannot be used: {str(error)[:200]}", "let fdhil-guard write it")
        raise ConfigError(source, [fault]) from None
    return settings


def load_settings(path: Path) -> GuardSettings:
    """Read the settings file; ConfigError when it is unreadable, invalid or modified since it was written.

    A file that is not a regular one is refused without blocking.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise OSError("it is not a regular file")
            text = file.read(MAX_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), [ConfigFault("file", f"cannot be read: {error}", "run fdhil-guard")]) from None
    settings = decode_settings(text, str(path))
    if encode_settings(settings) != text:  # a bit of a limit may have flipped
        fault = ConfigFault("file", "is damaged or was changed by hand", "let fdhil-guard write it")
        raise ConfigError(str(path), [fault])
    return settings


def refuse_constant(constant: str) -> None:
    """Raise ValueError: NaN and Infinity are invalid JSON."""
    raise ValueError(f"{constant} is not a number")


def _require_integer(value: object, low: int, high: int, what: str) -> int:
    if type(value) is not int or not low <= value <= high:
        raise ValueError(f"{what} is not an integer from {low} to {high}")
    return value


def _require_number(value: object, low: float, high: float, what: str) -> None:
    if type(value) not in (int, float) or not low <= value <= high:  # type: ignore[operator] # it is a number
        raise ValueError(f"{what} is not a number from {low:g} to {high:g}")


def _require_pattern(value: object, pattern: str, what: str) -> None:
    if not isinstance(value, str) or not re.fullmatch(pattern, value):
        raise ValueError(f"{what} is invalid")


def _parse_pdo(document: Mapping[str, Any]) -> Pdo:
    entries = [
        (
            _require_integer(i, 1, 0xFFFF, "index"),
            _require_integer(s, 0, 255, "sub-index"),
            _require_integer(b, 1, 64, "bits"),
            signed is True,
        )
        for i, s, b, signed in document["layout"]
    ]
    lay_out(entries)
    cob_id = _require_integer(document["cob_id"], 1, 0x7FF, "a COB-ID")
    return Pdo(cob_id, tuple(entries), _require_integer(document["every_sync"], 1, 255, "every_sync"))


def _parse_axis(document: dict[str, Any]) -> AxisSettings:
    tpdos = tuple(_parse_pdo(pdo) for pdo in document.pop("tpdos"))
    target, offset = _parse_pdo(document.pop("target")), _parse_pdo(document.pop("offset"))
    limits, feed = OffsetLimits(**document.pop("limits")), document.pop("feedforward")
    travel = document.pop("travel")
    document["writers"] = tuple(
        _require_integer(cob_id, 1, 0x7FF, "a writer's COB-ID") for cob_id in document["writers"]
    )
    if travel is not None:
        low, high = (_require_integer(end, -(2**31), 2**31 - 1, "travel") for end in travel)
        document["travel"] = (low, high)
    if feed is not None:
        most = [_require_integer(limit, 1, 2**31 - 1, "a limit of the feed-forward") for limit in feed["limits"]]
        feed = FeedforwardPdo(_parse_pdo(feed["pdo"]), feedforward_law.FeedforwardLimits(*most))
    return AxisSettings(target=target, offset=offset, tpdos=tpdos, limits=limits, feedforward=feed, **document)


def _check_settings(settings: GuardSettings) -> None:
    """Refuse settings that would make the guard's own arithmetic wrong; ValueError names the value."""
    if not settings.axes:
        raise ValueError("no axis may be corrected; an [axis.NAME.correction] section enables it")
    _require_number(settings.sync_period_s, 1e-5, 1.0, "sync_period_s")
    _require_number(settings.heartbeat_s, 1e-3, 10.0, "heartbeat_s")
    _require_integer(settings.node_id, 1, 127, "node_id")
    _require_pattern(settings.clock, "monotonic|sync", "clock")
    _require_pattern(settings.transport, "can_raw|socketcand", "transport")
    _require_pattern(settings.token_sha256, "(?:[0-9a-f]{64})?", "token_sha256")
    _require_pattern(settings.bus, ".{1,64}", "bus")
    _require_pattern(settings.run_directory, r"[^\0]{0,4096}", "run_directory")
    if type(settings.offset_synchronous) is not bool:
        raise ValueError("offset_synchronous is neither true nor false")
    if settings.daemon_uid is not None:
        _require_integer(settings.daemon_uid, 0, 2**32 - 2, "daemon_uid")
    for uid in settings.watching:
        _require_integer(uid, 0, 2**32 - 2, "watching")
    _require_integer(settings.lead, 0, MOST_LEAD, "lead")
    for axis in settings.axes:
        _check_axis(axis, LEAD_LAYOUT if settings.lead else OFFSET_LAYOUT)
        _check_limits(axis, settings.sync_period_s)
    if len(settings.sent_ids) != 1 + len(settings.axes) + sum(a.feedforward is not None for a in settings.axes):
        raise ValueError("two PDOs of the guard share one COB-ID")
    received = [pdo.cob_id for axis in settings.axes for pdo in (axis.target, *axis.tpdos)]
    if len({axis.name for axis in settings.axes}) < len(settings.axes) or len(set(received)) < len(received):
        raise ValueError("two axes share a name or a COB-ID")
    if {*settings.sent_ids, *received} & {cob_id for axis in settings.axes for cob_id in axis.writers}:
        raise ValueError("a COB-ID of the guard, the NC or a drive is listed as a foreign writer's")
    if settings.sent_ids & {*received, *(COB_HEARTBEAT + axis.node_id for axis in settings.axes)}:
        raise ValueError("a COB-ID of the guard is also used by the NC's set-points or a drive")


def _check_axis(axis: AxisSettings, layout: Layout) -> None:
    where = f"axis {axis.name}: "
    _require_pattern(axis.name, "[A-Z]2?", "an axis' name")
    _require_integer(axis.node_id, 1, 127, where + "node_id")
    _require_integer(axis.window, 1, 2**32, where + "window")
    _require_integer(axis.setpoint_delay_cycles, 0, 16, where + "setpoint_delay_cycles")
    if axis.sign not in (1, -1):
        raise ValueError(f"{where}sign is neither 1 nor -1")
    _require_number(axis.heartbeat_timeout_s, 0.0, 3600.0, where + "heartbeat_timeout_s")
    _require_number(axis.speed_step, 0.0, 2.0**31, where + "speed_step")
    _require_number(axis.speed_count, 0.0, 2.0**31, where + "speed_count")
    _require_pattern(axis.record, ".{0,200}", where + "record")
    _require_pattern(axis.void_reason, ".{0,300}", where + "void_reason")
    if type(axis.record_void) is not bool:
        raise ValueError(f"{where}record_void is neither true nor false")
    text = f"{where}the offset RPDO must map 0x60B0:00 and nothing else (with a lead, also the counter of SYNC)"
    _check_sent_pdo(axis.offset, layout, text)
    if axis.feedforward is not None:
        text = f"{where}the feed-forward's RPDO must map 0x60B1:00 and 0x60B2:00 and nothing else"
        _check_sent_pdo(axis.feedforward.pdo, FEED_LAYOUT, text)


def _check_sent_pdo(pdo: Pdo, layout: Layout, text: str) -> None:
    if pdo.layout != layout or not 0x180 <= pdo.cob_id < 0x580:
        raise ValueError(f"{text} ({pdo.cob_id:#x})")


def _check_limits(axis: AxisSettings, sync_period_s: float) -> None:
    """Refuse limits above this program's ceilings or below one increment."""
    _require_number(axis.increments_per_mm, 1.0, MOST_INCREMENTS_PER_MM, f"axis {axis.name}: increments_per_mm")
    for value in (axis.max_speed_mm_s, axis.max_acceleration_mm_s2):
        _require_number(value, 1e-3, 1e9, f"axis {axis.name}: max_speed_mm_s or max_acceleration_mm_s2")
    most = compute_limit_ceilings(
        axis.increments_per_mm, sync_period_s, axis.max_speed_mm_s, axis.max_acceleration_mm_s2
    )
    for name, ceiling in asdict(most).items():
        value = getattr(axis.limits, name)
        _require_integer(value, 1 if name != "window" else ceiling, ceiling, f"axis {axis.name}: the limit {name}")
