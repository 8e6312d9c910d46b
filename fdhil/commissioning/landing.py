"""Brings the drives to rest when another master is heard beside the cycle: the only thing that still leaves then."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from fdhil import cia402

OFFSET_CYCLES = 3  # in so many steps an offset goes to zero, whatever its limits: the other master does not know of it
WORD_CYCLES = 2
GUARD_LANDING_CYCLES = 500  # so long a guard's offset is waited for; the drive holds it when SYNC ends
START_CYCLES = 3000  # so long a node that the other master stopped is waited for
OFF_WORDS = (cia402.CONTROL_SWITCH_ON, cia402.CONTROL_SHUTDOWN, cia402.CONTROL_DISABLE_VOLTAGE)
"""Takes the power off, step by step."""


class Landed(Protocol):
    """A drive that is brought to rest."""

    axis: str

    @property
    def led(self) -> bool:
        """Whether set-points are sent to it."""

    @property
    def led_by_other(self) -> bool:
        """Whether another master sends its set-points, or stopped its node."""

    @property
    def stopped_by_other(self) -> bool:
        """Whether another master stopped its node and has not started it again."""

    @property
    def playing(self) -> bool:
        """Whether planned offsets still wait to be sent."""

    @property
    def zeroes_offset(self) -> bool:
        """Whether its offset is fdhil's to take to zero."""

    @property
    def offset_by_other(self) -> bool:
        """Whether another master sent its offset."""

    @property
    def held_offset(self) -> int:
        """The offset of a guard that it shows."""

    def land(self, cycles: int) -> None:
        """Take the offset to zero in so many steps and send no other one any more."""

    def switch_off(self, word: int) -> None:
        """Send this controlword from now on, and no offset."""

    def send_zero_offset(self) -> None:
        """Send an offset of zero once, at once."""


def land(drives: Sequence[Landed], braking: Callable[[], bool]) -> Iterator[bool]:
    """Yield once per cycle, whether SYNC and set-points are still needed.

    The axes brake, offsets go to zero, the drives are switched off. A drive that another master leads is left to it,
    its offset at zero: where its node was stopped it hears that when it is started again.
    """
    for drive in drives:
        drive.land(OFFSET_CYCLES)
    while braking() or any(drive.playing for drive in drives):
        yield True
    own = [drive for drive in drives if not drive.led_by_other]
    for _ in range(GUARD_LANDING_CYCLES):
        if not any(drive.held_offset for drive in own):
            break
        yield True
    for word in OFF_WORDS if own else ():
        for _ in range(WORD_CYCLES):
            for drive in drives:
                drive.switch_off(word)
            yield True
    yield from _zero_when_started([drive for drive in drives if drive.led_by_other and drive.zeroes_offset])


def _zero_when_started(drives: Sequence[Landed]) -> Iterator[bool]:
    for _ in range(START_CYCLES):
        if not any(drive.stopped_by_other for drive in drives):
            break
        yield False
    for _ in range(OFFSET_CYCLES if drives else 0):
        for drive in drives:
            drive.send_zero_offset()
        yield False


def outcome(drives: Sequence[Landed], written: set[tuple[int, int]]) -> str:
    """Return how the drives were left, as a part of a sentence; the mode is never given back, and is no news."""
    told = [_left(drive) for drive in drives]
    if objects := ", ".join(sorted({f"0x{index:04X}" for _, index in written if index != cia402.Object.MODE})):
        told.append(f"{objects} may be as fdhil wrote them: power the drives off and on again")
    return ", and ".join(told) or "nothing more was sent"


def _left(drive: Landed) -> str:
    zero = ", its offset taken to zero" if drive.zeroes_offset else ""
    others = ", and may hold an offset of that master: power it off and on again" if drive.offset_by_other else ""
    if drive.stopped_by_other:
        unknown = ", and may hold an offset: power it off and on again" if drive.zeroes_offset else others
        return f"axis {drive.axis} was left to it, which stopped its node{unknown}"
    if drive.led_by_other:
        return f"axis {drive.axis} was left to it{zero}"
    return f"axis {drive.axis} was stopped{zero} and its drive switched off{others}"
