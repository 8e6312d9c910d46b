"""Compares the guard's ramp-down frames while the wall clock of its process is wrong, or is set.

The clock is that of Debian's libfaketime, for the guard's process alone; its monotonic clock is unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tests.guard.simulated_bus import Frame
from tests.guard.test_guard_process import Rig

FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
EMERGENCY: Frame = (0x081, bytes.fromhex("1081000000000000"))
FAULT_ROW, FIRST_ROW = 360, 340
NEVER_SET = ("+0", "+0", "+0")
# what the clock shows at the start, while the correction is in force, and while it ramps down
CLOCKS: Mapping[str, tuple[str, str, str]] = {
    "an hour ahead": ("+3600", "+3600", "+3600"),
    "an hour behind": ("-3600", "-3600", "-3600"),
    "1970": ("-1764000000",) * 3,
    "set on an hour": ("+0", "+3600", "+7200"),
    "set back an hour": ("+0", "-3600", "-7200"),
    "set back to 1970": ("+0", "-1764000000", "+0"),
}


def ramp(folder: Path, clock: tuple[str, str, str]) -> list[tuple[int, ...]]:
    folder.mkdir(parents=True)
    shown = folder / "clock"
    shown.write_text(clock[0])
    with _environment(LD_PRELOAD=str(FAKETIME), FAKETIME_TIMESTAMP_FILE=str(shown), FAKETIME_NO_CACHE="1"):
        rig = Rig(folder)
    try:
        rig.arm()
        rig.settle()
        peer = rig.peer
        peer.slow_from = FIRST_ROW - 20
        peer.playing = True
        peer.wait(lambda: peer.row >= FIRST_ROW - 10, "the path")
        shown.write_text(clock[1])
        peer.at_row[FAULT_ROW] = EMERGENCY
        peer.wait(lambda: peer.row > FAULT_ROW + 1, "the fault")
        shown.write_text(clock[2])
        peer.wait(lambda: rig.state() in ("OFF", "FROZEN"), "the end of the ramp")
        first = next(k for k, row in peer.rows_at.items() if row == FIRST_ROW)
        sent = [dict(peer.offsets_sent(node)) for node in (1, 2)]
        # the last SYNC may have seen the frame of the first drive alone
        complete = sorted(sent[0].keys() & sent[1].keys())
        frames = [(k - first, *(offsets[k] for offsets in sent)) for k in complete if k >= first]
        rest = next(place for place, frame in enumerate(frames) if not any(frame[1:]))
        return frames[: rest + 1]
    finally:
        rig.close()


@contextmanager
def _environment(**names: str) -> Iterator[None]:
    names |= {"FAKETIME_DONT_FAKE_MONOTONIC": "1", "DONT_FAKE_MONOTONIC": "1"}
    os.environ.update(names)
    try:
        yield
    finally:
        for name in names:
            del os.environ[name]
