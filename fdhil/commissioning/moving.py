"""Move axes that are held in Operation enabled; every motion ends in a braking ramp, whatever interrupts it."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

from fdhil.cia402 import PowerState, describe_emergency
from fdhil.commissioning.cycle import Cycle
from fdhil.commissioning.master import Master
from fdhil.commissioning.set_points import Bounds, SetPoints
from fdhil.errors import DriveFault
from fdhil.records import Float

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
PATIENCE = 20.0  # factor on the duration of the set-points
SILENT_CYCLES = 20
EMCY_HEARTBEAT = 0x8130
LAG_CYCLES = 300  # the following of the axis after its last set-point


def move(
    masters: Sequence[Master], bounds: Sequence[Bounds], rows: Float, each_turn: Callable[[], None] = lambda: None
) -> None:
    """Play rows of increments (one column per master) on enabled drives of one cycle; return when they rest at the end.

    DriveFault if a row would leave its bounds or an axis does not follow, ForeignMaster if another master is detected:
    the axes have been braked then. They are also braked on any interruption, Ctrl-C included, before it is raised.
    ``each_turn`` is called while waiting.
    """
    loop = masters[0].loop
    with following(masters, bounds) as path:
        path.play(rows.tolist())
        seconds = PATIENCE * (len(rows) + LAG_CYCLES) * loop.period_s + 5.0
        masters[0].wait(
            lambda: _settled(masters, path, each_turn), seconds, "the set-points were not sent; check its load"
        )
    loop.check()
    if path.stopped is not None:
        raise DriveFault("the motion", f"was stopped: {path.stopped}; find the cause before you move the axis again")


def _settled(masters: Sequence[Master], path: SetPoints, each_turn: Callable[[], None]) -> bool:
    watch_power(masters, path)
    each_turn()
    return path.resting


def watch_power(masters: Sequence[Master], path: SetPoints) -> None:
    """Stop all axes if one of them leaves Operation enabled or is silent."""
    for master in masters:
        if master.behind > SILENT_CYCLES:
            path.stop(f"axis {master.axis}: its drive has been silent for {SILENT_CYCLES} SYNC")
        if master.state() is not PowerState.OPERATION_ENABLED:
            codes = [int.from_bytes(data[:2], "little") for data in master.heard.emergencies[-1:]]
            why = f" (EMCY {codes[0]:04X}: {describe_emergency(codes[0])})" if codes and codes[0] else ""
            if codes and codes[0] == EMCY_HEARTBEAT:
                why += f"; this PC was late by up to {master.loop.lateness.most_us / 1e3:.1f} ms: reduce its load"
            path.stop(f"axis {master.axis}: its drive fell from Operation enabled to {master.state().value}{why}")


@contextlib.contextmanager
def following(masters: Sequence[Master], bounds: Sequence[Bounds]) -> Iterator[SetPoints]:
    """Take the masters' set-points from a path that begins at their held positions; brake it to rest at the end.

    The masters are all the members of their cycle; afterwards they hold the last row sent.
    """
    loop = masters[0].loop
    path = SetPoints(bounds, [_held(master) for master in masters])
    loop.path = path
    try:
        yield path
    finally:
        if not path.resting:
            path.stop("it was interrupted")
        with undisturbed():
            brake(loop, path)
        loop.path = None


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore a second Ctrl-C while the axes are braked."""
    with held_back():
        yield


@contextlib.contextmanager
def held_back() -> Iterator[list[int]]:
    """Delay Ctrl-C until an axis is at rest; yields the signals that arrived meanwhile."""
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    with handling(lambda number, _frame: came.append(number)):
        yield came


@contextlib.contextmanager
def handling(handler: Callable[[int, FrameType | None], object] | signal.Handlers) -> Iterator[None]:
    """Let ``handler`` receive the signals that end a process, while this lasts; in the main thread only."""
    before = {number: signal.signal(number, handler) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _held(master: Master) -> int:
    if master.target is None:
        raise DriveFault(master.device, "it holds no position, so it cannot be moved; enable it first")
    return master.target


def brake(loop: Cycle, path: SetPoints) -> None:
    """Wait until the path rests; if the cycle has ended nothing is sent, and the drives' own watchdogs act."""
    while not path.resting and loop.turning:
        time.sleep(loop.period_s)
