"""The rows of the history as records, decoded from what SQLite returns."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdhil.records import (
    PARAMETERS,
    Float,
    LoopEstimate,
    Notice,
    Parameters,
    ParameterSet,
    Reason,
    Skill,
    Verdict,
    freeze_array,
)
from fdhil.system_clock import SYSTEM_CLOCK, Clock


@dataclass(frozen=True, slots=True)
class TimeStamp:
    """When a row was written: wall clock (Unix, s, may be wrong), boot identifier, time since boot."""

    wall_s: float
    boot: str
    monotonic_ns: int

    @staticmethod
    def now(clock: Clock = SYSTEM_CLOCK) -> TimeStamp:
        return TimeStamp(clock.wall_s(), clock.read_boot_id(), clock.read_boot_time_ns())

    def compute_age_s(self, clock: Clock = SYSTEM_CLOCK) -> float:
        """Return the age; a negative one, of a clock that was set back, is unreliable."""
        now = TimeStamp.now(clock)
        if now.boot and self.boot == now.boot:
            return (now.monotonic_ns - self.monotonic_ns) * 1e-9
        return now.wall_s - self.wall_s

    def is_after(self, other: TimeStamp) -> bool:
        """Return whether it was written after another, as far as the clocks show."""
        if self.boot and self.boot == other.boot:
            return self.monotonic_ns > other.monotonic_ns
        return self.wall_s > other.wall_s


@dataclass(frozen=True, slots=True)
class Revision:
    """A published parameter set as stored: ``window_ids`` are the rows of the windows it was pooled from."""

    number: int
    set: ParameterSet
    window_ids: tuple[int, ...]
    stamp: TimeStamp


@dataclass(frozen=True, slots=True)
class StoredWindow:
    """An analysed window as stored; ``parameters`` maps a symbol to {"value", "std"} or {"value": None, "reason"}.

    ``friction`` is {"value", "std", "speed_rad_s"}: the friction torque at the rapid speed (N.m), load included.
    ``told`` is an accepted window's contribution to a pool: "names" and "values" (k,), the covariance (k, k) of its
    "own" noise, and the doubts (k, q) "shared" by all windows of the drive. ``nc`` is the NC's report of the move:
    "line", "program", "override" (least and greatest) and "held".
    """

    number: int
    axis: str
    file: str
    start_tick: int
    direction: int
    accepted: bool
    fit_percent: float | None
    reasons: tuple[str, ...]
    parameters: dict[str, dict[str, Any]] | None
    temperature_c: float | None
    stamp: TimeStamp
    unexplained_um: float | None = None
    warnings: tuple[str, ...] = ()
    friction: dict[str, float] | None = None
    pool_entry: dict[str, Any] | None = None
    nc: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class UsedParameters:
    """An axis' parameters as a prediction used them: ``revision`` 0 if none was published."""

    revision: int
    parameters: Parameters


@dataclass(frozen=True, slots=True)
class Comparison:
    """A prediction of a program: ``program`` is its digest, ``zones`` as in ``fdhil predict --json``."""

    program: str
    name: str
    config_digest: str
    used: Mapping[str, UsedParameters]
    rms_um: float
    zones: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """Who has acknowledged ``notices`` (their numbers), when, and with which note."""

    notices: tuple[int, ...]
    who: str
    note: str
    stamp: TimeStamp


@dataclass(frozen=True, slots=True)
class StoredNotice:
    """A notice as stored, and its acknowledgement; severity info requires none."""

    number: int
    notice: Notice
    stamp: TimeStamp
    acknowledged: Acknowledgement | None = None

    @property
    def is_open(self) -> bool:
        return self.acknowledged is None and self.notice.severity != "info"


def _decode_stamp(row: Mapping[str, Any]) -> TimeStamp:
    return TimeStamp(row["wall_s"], row["boot"], row["monotonic_ns"])


def _decode_number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _decode_revision(row: Mapping[str, Any]) -> Revision:
    parameters = Parameters.from_mapping(
        {name: row[name] for name in PARAMETERS} | json.loads(row.get("terms") or "{}")
    )
    covariance: Float = freeze_array(np.array(json.loads(row["covariance"]), dtype=np.float64))
    published = ParameterSet(
        row["axis"], row["revision"], parameters, covariance, row["windows"], row["tick"], row["temperature_c"],
        row["config_digest"], (), row.get("unexplained_um"), _decode_warnings(row),
        json.loads(row.get("loops") or "null"),
    )  # fmt: skip
    return Revision(row["id"], published, tuple(json.loads(row["window_ids"])), _decode_stamp(row))


def _decode_comparison(row: Mapping[str, Any]) -> tuple[TimeStamp, Comparison]:
    used = {
        axis: UsedParameters(
            int(u["revision"]), Parameters.from_mapping({n: v for n, v in u.items() if n != "revision"})
        )
        for axis, u in json.loads(row["parameters"]).items()
    }
    zones = tuple(json.loads(row["zones"]))
    return _decode_stamp(row), Comparison(row["program"], row["name"], row["config_digest"], used, row["rms_um"], zones)


def _decode_skill(row: Mapping[str, Any]) -> Skill:
    figures = ("rms_um", "max_um", "delay_ms", "measured_rms_um")
    return Skill(row["axis"], row["tick"], *(_decode_number(row[name]) for name in figures))


def _decode_notice(row: Mapping[str, Any]) -> StoredNotice:
    notice = Notice(*(row[name] for name in ("code", "severity", "text", "axis", "tick")))
    return StoredNotice(row["id"], notice, _decode_stamp(row))


def _decode_acknowledgement(row: Mapping[str, Any]) -> Acknowledgement:
    return Acknowledgement(tuple(map(int, json.loads(row["notices"]))), row["who"], row["note"], _decode_stamp(row))


def _decode_window(row: Mapping[str, Any]) -> StoredWindow:
    parameters = None if row["parameters"] is None else json.loads(row["parameters"])
    return StoredWindow(
        row["id"], row["axis"], row["file"], row["start_tick"], row["direction"], bool(row["accepted"]),
        row["fit_percent"], tuple(json.loads(row["reasons"])), parameters, row["temperature_c"], _decode_stamp(row),
        row.get("unexplained_um"), tuple(str(warning) for warning in _decode_warnings(row)),
        json.loads(row.get("friction") or "null"), json.loads(row.get("told") or "null"),
        json.loads(row.get("nc") or "null"),
    )  # fmt: skip


def _decode_warnings(row: Mapping[str, Any]) -> tuple[Reason, ...]:
    return tuple(Reason(*parts) for parts in json.loads(row.get("warnings") or "[]"))


def _decode_loops(row: Mapping[str, Any]) -> tuple[TimeStamp, LoopEstimate]:
    gains = json.loads(row["gains"])
    reasons = tuple(Reason(*parts) for parts in json.loads(row["reasons"]))
    verdict = Verdict(bool(row["accepted"]), None, reasons, row["unexplained_um"], _decode_warnings(row))
    covariance = freeze_array(np.array(json.loads(row["covariance"]), dtype=np.float64))
    found = LoopEstimate(
        row["axis"], row["structure"], tuple(gains), freeze_array([*gains.values()]), covariance, verdict
    )
    return _decode_stamp(row), found


# table -> decoder of its rows; an invalid row raises one of the errors that the reader catches
DECODED: Mapping[str, Callable[[Mapping[str, Any]], Any]] = {
    "windows": _decode_window,
    "revisions": _decode_revision,
    "skills": _decode_skill,
    "notices": _decode_notice,
    "comparisons": _decode_comparison,
    "loops": _decode_loops,
    "acknowledgements": _decode_acknowledgement,
}
