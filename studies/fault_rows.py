"""The rows of the fault matrix that end in a ramp: how each comes about, on the wire where it can be made there.

A row's fault is made of frames wherever that is possible, so that the same lines act on the guard's decisions in this
process and on the guard's process behind a hub. ``detected`` is what its way of being noticed takes, in SYNC.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdhil.guard.offset_limits import OffsetLimits
from fdhil.sim.frame_types import Frame

Rng = np.random.Generator
Tamper = Callable[[int, Frame], list[Frame]]
"""What is heard of a frame, so many SYNC after the fault began."""
HIJACK, HEARTBEAT = 0x301, 0x764


@dataclass(frozen=True)
class Row:
    """One fault: its class, the SYNC until it can be noticed, and what happens.

    ``tamper`` is what becomes of the frames from then on, ``insert`` are frames of another node, once; ``order`` is
    what the daemon asks for or no longer vouches for. A row without any of them needs hands of its own.
    """

    code: str
    detected: int
    tamper: Callable[[Rng], Tamper] | None = None
    insert: Callable[[Rng], list[Frame]] | None = None
    order: str = ""
    process: bool = True


def _rewrite_frames(cob_id: int, change: Callable[[bytes], bytes]) -> Callable[[Rng], Tamper]:
    def tamper(_k: int, frame: Frame) -> list[Frame]:
        return [(cob_id, change(frame[1]))] if frame[0] == cob_id else [frame]

    return lambda _rng: tamper


def _change_statusword(word: int) -> Callable[[Rng], Tamper]:
    return _rewrite_frames(0x281, lambda data: struct.pack("<H", word) + data[2:])


def _move_targets(by: int) -> Callable[[Rng], Tamper]:
    """The NC's targets for X are those of another path."""
    return _rewrite_frames(0x201, lambda data: data[:2] + _add_offset(data[2:], by))


def _add_offset(number: bytes, by: int) -> bytes:
    return (int.from_bytes(number, "little", signed=True) + by).to_bytes(4, "little", signed=True)


def _drop_frames(*cob_ids: int) -> Callable[[Rng], Tamper]:
    return lambda _rng: lambda _k, frame: [] if frame[0] in cob_ids else [frame]


def _send_second_sync(rng: Rng) -> Tamper:
    jump = int(rng.integers(4, 230))
    return lambda _k, frame: [(0x080, bytes([(frame[1][0] + jump - 1) % 240 + 1]))] if frame[0] == 0x080 else [frame]


def _start_second_producer(rng: Rng) -> Tamper:
    other = struct.pack("<Hhh", 0x1237, int(rng.integers(100, 200)), 7)
    return lambda _k, frame: [frame, (0x281, other)] if frame[0] == 0x281 else [frame]


def _override_targets(rng: Rng) -> Tamper:
    """The targets go along the path at another rate: between those that were due since then."""
    rate, passed = float(rng.uniform(0.5, 0.9)), {0x201: list[int](), 0x202: list[int]()}

    def tamper(_k: int, frame: Frame) -> list[Frame]:
        cob_id, data = frame
        if cob_id not in passed:
            return [frame]
        due = passed[cob_id]
        due.append(int.from_bytes(data[2:6], "little", signed=True))
        at = rate * (len(due) - 1)
        low, part = int(at), at - int(at)
        target = due[low] + part * (due[min(low + 1, len(due) - 1)] - due[low])
        return [(cob_id, data[:2] + round(target).to_bytes(4, "little", signed=True))]

    return tamper


def _send_emergency(rng: Rng) -> list[Frame]:
    return [(0x081, struct.pack("<HB5x", 0x8130, 0x11)[: int(rng.integers(0, 9))])]


def _flood_bus(_rng: Rng) -> list[Frame]:
    return [(0x081, struct.pack("<HBI", 0x7500, 0x11, k)) for k in range(2000)]


def _write_foreign_offset(rng: Rng) -> list[Frame]:
    return [(HIJACK, int(rng.integers(-819, 820)).to_bytes(4, "little", signed=True))]


RAMPED: Mapping[str, Row] = {
    "A2": Row("ErrorPassive", 1, process=False),
    "A5": Row("TxQueueFull", 4, process=False),
    "A6": Row("RxOverflow", 1, process=False),
    "A7": Row("SyncLost", 1, process=False),
    "A8": Row("SyncJitter", 30, process=False),
    "A9": Row("SyncCollision", 1, tamper=_send_second_sync),
    "A10": Row("StaleData", 5, tamper=_drop_frames(0x181, 0x281, 0x381, 0x481)),
    "A14": Row("Implausible", 4, tamper=_rewrite_frames(0x181, lambda data: data[:4] + _add_offset(data[4:], 1 << 28))),
    "A15": Row("PdoLength", 5, tamper=_rewrite_frames(0x181, lambda data: data[:3])),
    "A18": Row("ForeignProducer", 5, tamper=_start_second_producer),
    "A19": Row("OffsetHijack", 61, insert=_write_foreign_offset),
    "A20": Row("DriveEmergency", 2, insert=_send_emergency),
    "A21": Row("DriveEmergency", 2, insert=_flood_bus),
    "A22": Row("HeartbeatLost", 102, tamper=_drop_frames(0x701), process=False),
    "E1": Row("OffsetLimit", 2, process=False),
    "E2": Row("OffsetRate", 2, process=False),
    "E4": Row("ModelStale", 2, order="model_fresh"),
    "E5": Row("ProgramMismatch", 1, process=False),
    "E6": Row("Misaligned", 13, tamper=_move_targets(1500)),
    "E9": Row("NotCsp", 12, tamper=_rewrite_frames(0x481, lambda data: data[:4] + b"\x01" + data[5:])),
    "E10": Row("DriveNotEnabled", 2, tamper=_change_statusword(0x0250)),
    "E11": Row("LimitActive", 2, tamper=_change_statusword(0x1A37)),
    "E12": Row("FollowingError", 2, tamper=_change_statusword(0x3237)),
    "E15": Row("EchoMismatch", 22, tamper=_rewrite_frames(0x381, lambda data: data[:4] + _add_offset(data[4:], 60))),
    "E17": Row("OverrideChanged", 33, tamper=_override_targets),
    "E18": Row("Disarmed", 2, order="disarm"),
    "E19": Row("PoorSkill", 2, order="skill_enough"),
    "F3": Row("ReadOnlyStore", 2, order="journal_writable"),
    "F8": Row("BusLocked", 2, insert=lambda _rng: [(HEARTBEAT, b"\x05")]),
    "F13": Row("Stopped", 2),
    "F14": Row("LoopOverrun", 13),
    "F15": Row("MainLost", 2),
    "F20": Row("InternalError", 1, process=False),
}


def time_to_safe(limits: OffsetLimits, peak: int, detected: int) -> int:
    """Return the bound on the SYNC from a fault to zero: noticing, |o|/S of way, and turning round and stopping."""
    return detected + 1 + -(-abs(peak) // limits.rate) + 3 * -(-limits.rate // limits.acceleration)


class Descent(NamedTuple):
    """How the offsets on the wire went to zero after a fault, in SYNC; ``within``: no later than the bounds allow."""

    shrinking: int
    zero: int
    within: bool


def assess_ramp_down(
    series: Sequence[tuple[int, ...]], rate: int, limits: OffsetLimits, detected: int
) -> Descent | None:
    """Judge the offsets from the last before the fault on; None while they are not at zero to stay.

    ``rate`` is the largest first difference before the fault: what moved outward must be braked before it can shrink.
    """
    if any(series[-1]):
        return None
    shrinking = zero = 0
    for column in zip(*series, strict=True):
        rises = [k for k in range(1, len(column)) if abs(column[k]) > abs(column[k - 1])]
        shrinking = max(shrinking, rises[-1] + 1 if rises else 1)
        zero = max(zero, max([k + 1 for k, offset in enumerate(column) if offset], default=0))
    peak = max(abs(offset) for column in series for offset in column)
    turned = detected + 4 + -(-rate // limits.acceleration)
    return Descent(shrinking, zero, shrinking <= turned and zero <= time_to_safe(limits, peak, detected))
