"""Moves axes that are held in Operation enabled; whatever ends a motion ends it by a braking ramp."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

from fdhil.cia402 import State, emcy_text
from fdhil.commissioning.cycle import Cycle
from fdhil.commissioning.master import Master
from fdhil.commissioning.set_points import Bounds, SetPoints
from fdhil.errors import DriveFault
from fdhil.records import Float

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
PATIENCE = 20.0  # times as long as the set-points take
SILENT_CYCLES = 20
EMCY_HEARTBEAT = 0x8130
LAG_CYCLES = 300  # an axis may follow so much later than its last set-point


def move(
    masters: Sequence[Master],
    bounds: Sequence[Bounds],
    rows: Float,
    each_turn: Callable[[], None] = lambda: None,
) -> None:
    """Play rows of increments (one column per master) to enabled drives of one cycle, and return when they rest there.

    DriveFault where a row would leave its bounds or an axis does not follow, ForeignMaster where another master is
    heard: the axes were braked then. Whatever else interrupts it, Ctrl-C too, the axes are braked before it is raised.
    ``each_turn`` is called while it waits.
    """
    loop = masters[0].loop
    with following(masters, bounds) as path:
        path.play(rows.tolist())
        seconds = PATIENCE * (len(rows) + LAG_CYCLES) * loop.period_s + 5.0
        masters[0].wait(lambda: _settled(masters, path, each_turn), seconds, "the set-points were not sent; check load")
    loop.check()
    if path.stopped is not None:
        raise DriveFault("the motion", f"was stopped: {path.stopped}; find the cause before anything moves again")


def _settled(masters: Sequence[Master], path: SetPoints, each_turn: Callable[[], None]) -> bool:
    watch_power(masters, path)
    each_turn()
    return path.resting


def watch_power(masters: Sequence[Master], path: SetPoints) -> None:
    """Stop all axes when one of them is not in Operation enabled any more, or is silent."""
    for master in masters:
        if master.behind > SILENT_CYCLES:
            path.stop(f"axis {master.axis}: nothing was heard of its drive for {SILENT_CYCLES} SYNC")
        if master.state() is not State.OPERATION_ENABLED:
            told = [int.from_bytes(data[:2], "little") for data in master.heard.emergencies[-1:]]
            why = f" (EMCY {told[0]:04X}: {emcy_text(told[0])})" if told and told[0] else ""
            if told and told[0] == EMCY_HEARTBEAT:
                why += f"; this PC was late by up to {master.loop.lateness.most_us / 1e3:.1f} ms: take load off it"
            path.stop(f"axis {master.axis}: its drive fell from Operation enabled to {master.state().value}{why}")


@contextlib.contextmanager
def following(masters: Sequence[Master], bounds: Sequence[Bounds]) -> Iterator[SetPoints]:
    """Have the masters' set-points come from a path that begins where they are held; at the end it is braked to rest.

    The masters are all the members of their cycle; they hold what was sent last afterwards.
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
    """Take no notice of a second Ctrl-C while the axes are braked."""
    with held_back():
        yield


@contextlib.contextmanager
def held_back() -> Iterator[list[int]]:
    """Let no Ctrl-C end what puts an axis at rest; gives the signals that came meanwhile."""
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    with handling(lambda number, _frame: came.append(number)):
        yield came


@contextlib.contextmanager
def handling(handler: Callable[[int, FrameType | None], object] | signal.Handlers) -> Iterator[None]:
    """Let ``handler`` take the signals that end a process, for as long as this lasts; of the main thread alone."""
    before = {number: signal.signal(number, handler) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _held(master: Master) -> int:
    if master.target is None:
        raise DriveFault(master.device, "nothing is held, so that nothing can be moved; enable it first")
    return master.target


def brake(loop: Cycle, path: SetPoints) -> None:
    """Wait until the path rests; a cycle that does not turn sends nothing, and the drives' own watchdogs act."""
    while not path.resting and loop.turning:
        time.sleep(loop.period_s)
