"""Ramps to zero when the loop itself has failed: from the last sent offset, by the limits alone, at each SYNC."""

import select
from collections.abc import Sequence

from fdhil.cia402 import COB_SYNC, pack_pdo
from fdhil.guard.can_socket import BusDown, CanSocket
from fdhil.guard.event_journal import Clock
from fdhil.guard.guard_protocol import SENDING, FeedMode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import GuardState
from fdhil.guard.offset_limits import move_toward_goal

ZEROS = 5


def ramp_to_zero(
    state: GuardState, unsent: Sequence[int], settings: GuardSettings, can: CanSocket, clock: Clock
) -> tuple[int, ...]:
    """Ramp the offsets to zero; return what was sent last, increments per axis. Ends when SYNC or the bus stops.

    ``unsent``: axes whose last offset did not leave. Speed and torque offsets are set to zero at once. No interlock is
    checked and nothing is read back.
    """
    moving = [(axis.sent[1], 0) if k in unsent else (axis.offset, axis.rate) for k, axis in enumerate(state.axes)]
    feeds = () if state.feed.mode is FeedMode.OFF else settings.feeds
    zeros = 0 if state.sending else ZEROS + settings.lead
    try:
        while zeros < ZEROS + settings.lead and (counter := _wait_for_sync(can, settings.silence_s, clock)) is not None:
            if state.mode in SENDING:
                moving = _send_next_offsets(settings, can, moving, counter)
            for feed in feeds:
                can.send(feed.pdo.cob_id, pack_pdo(feed.pdo.entries, (0, 0)))
            zeros += not any(offset for offset, _ in moving)
    except BusDown:
        pass
    return tuple([offset for offset, _ in moving])


def _send_next_offsets(
    settings: GuardSettings, can: CanSocket, moving: list[tuple[int, int]], counter: int
) -> list[tuple[int, int]]:
    """Send the next offsets; return them with their rates. An axis whose frame does not leave keeps its offset."""
    stepped = []
    for axis, (offset, rate) in zip(settings.axes, moving, strict=True):
        following, entries = move_toward_goal(axis.limits, offset, rate, 0, 0), axis.offset.entries
        left = can.send(axis.offset.cob_id, pack_pdo(entries, (following, counter)[: len(entries)]))
        stepped.append((following, following - offset) if left else (offset, 0))
    return stepped


def _wait_for_sync(can: CanSocket, silence_s: float, clock: Clock) -> int | None:
    """Wait for the next SYNC; return its counter (0 where it has none), None when none comes within ``silence_s``."""
    poll = clock.new_poll()
    poll.register(can, select.POLLIN)
    end_s = clock.now_s() + silence_s
    while (left_s := end_s - clock.now_s()) > 0:
        syncs = [data for cob_id, data, _ in can.receive() if cob_id == COB_SYNC] if poll.poll(left_s * 1000) else []
        if syncs:
            return syncs[-1][0] if syncs[-1] else 0
    return None
