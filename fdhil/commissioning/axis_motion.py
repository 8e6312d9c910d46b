"""Move axes that are held in Operation enabled; every motion ends in a braking ramp, whatever interrupts it."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

from fdhil.cia402 import PowerState, describe_emergency
from fdhil.commissioning.master import Master
from fdhil.commissioning.set_points import AxisBounds, SetPointGenerator
from fdhil.commissioning.sync_cycle import SyncCycle
from fdhil.errors import DriveFault
from fdhil.records import Float

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
PATIENCE = 20.0  # factor on the duration of the set-points
SILENT_CYCLES = 20
EMCY_HEARTBEAT = 0x8130
LAG_CYCLES = 300  # the following of the axis after its last set-point


def move_axes(
    masters: Sequence[Master], bounds: Sequence[AxisBounds], rows: Float, each_turn: Callable[[], None] = lambda: None
) -> None:
    """Play rows of increments (one column per master) on enabled drives of one cycle; return when they rest at the end.

    DriveFault if a row would leave its bounds or an axis does not follow, ForeignMaster if another master is detected:
    the axes have been braked then. They are also braked on any interruption, Ctrl-C included, before it is raised.
    ``each_turn`` is called while waiting.
    """
    loop = masters[0].loop
    with follow_path(masters, bounds) as path:
        path.play_rows(rows.tolist())
        seconds = PATIENCE * (len(rows) + LAG_CYCLES) * loop.period_s + 5.0
        masters[0].wait_until(
            lambda: _watch_until_settled(masters, path, each_turn),
            seconds,
            "the set-points were not sent; check its load",
        )
    loop.raise_if_failed()
    if path.stopped is not None:
        raise DriveFault("the motion", f"was stopped: {path.stopped}; find the cause before you move the axis again")


def _watch_until_settled(masters: Sequence[Master], path: SetPointGenerator, each_turn: Callable[[], None]) -> bool:
    watch_power(masters, path)
    each_turn()
    return path.is_resting


def watch_power(masters: Sequence[Master], path: SetPointGenerator) -> None:
    """Stop all axes if one of them leaves Operation enabled or is silent."""
    for master in masters:
        if master.unanswered_syncs > SILENT_CYCLES:
            path.brake_to_rest(f"axis {master.axis}: its drive has been silent for {SILENT_CYCLES} SYNC")
        if master.get_power_state() is not PowerState.OPERATION_ENABLED:
            codes = [int.from_bytes(data[:2], "little") for data in master.feedback.emergencies[-1:]]
            why = f" (EMCY {codes[0]:04X}: {describe_emergency(codes[0])})" if codes and codes[0] else ""
            if codes and codes[0] == EMCY_HEARTBEAT:
                why += f"; this PC was late by up to {master.loop.lateness.most_us / 1e3:.1f} ms: reduce its load"
            path.brake_to_rest(
                f"axis {master.axis}: its drive fell from Operation enabled to {master.get_power_state().value}{why}"
            )


@contextlib.contextmanager
def follow_path(masters: Sequence[Master], bounds: Sequence[AxisBounds]) -> Iterator[SetPointGenerator]:
    """Take the masters' set-points from a path that begins at their held positions; brake it to rest at the end.

    The masters are all the members of their cycle; afterwards they hold the last row sent.
    """
    loop = masters[0].loop
    path = SetPointGenerator(bounds, [_require_held_target(master) for master in masters])
    loop.path = path
    try:
        yield path
    finally:
        if not path.is_resting:
            path.brake_to_rest("it was interrupted")
        with ignore_interrupts():
            brake_to_rest(loop, path)
        loop.path = None


@contextlib.contextmanager
def ignore_interrupts() -> Iterator[None]:
    """Ignore a second Ctrl-C while the axes are braked."""
    with delay_interrupts():
        yield


@contextlib.contextmanager
def delay_interrupts() -> Iterator[list[int]]:
    """Delay Ctrl-C until an axis is at rest; yields the signals that arrived meanwhile."""
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    with handle_signals(lambda number, _frame: came.append(number)):
        yield came


@contextlib.contextmanager
def handle_signals(handler: Callable[[int, FrameType | None], object] | signal.Handlers) -> Iterator[None]:
    """Let ``handler`` receive the signals that end a process, while this lasts; in the main thread only."""
    before = {number: signal.signal(number, handler) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _require_held_target(master: Master) -> int:
    if master.target is None:
        raise DriveFault(master.device, "it holds no position, so it cannot be moved; enable it first")
    return master.target


def brake_to_rest(loop: SyncCycle, path: SetPointGenerator) -> None:
    """Wait until the path rests; if the cycle has ended nothing is sent, and the drives' own watchdogs act."""
    while not path.is_resting and loop.is_running:
        time.sleep(loop.period_s)
