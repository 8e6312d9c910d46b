"""Stop the drives when another master is detected during the cycle; only this is still sent then."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from fdhil import cia402

OFFSET_CYCLES = 3  # steps to zero offset, regardless of the limits: the other master does not know of the offset
WORD_CYCLES = 2
GUARD_LANDING_CYCLES = 500  # the guard's time to zero its offset; the drive holds it when SYNC ends
START_CYCLES = 3000  # wait for a node that the other master stopped
OFF_WORDS = (cia402.CONTROL_SWITCH_ON, cia402.CONTROL_SHUTDOWN, cia402.CONTROL_DISABLE_VOLTAGE)
"""Controlwords that switch the power stage off step by step."""


class StoppableDrive(Protocol):
    """A drive that can be stopped."""

    axis: str

    @property
    def is_led(self) -> bool:
        """Whether set-points are sent to it."""

    @property
    def is_led_by_other(self) -> bool:
        """Whether another master sends its set-points or stopped its node."""

    @property
    def is_stopped_by_other(self) -> bool:
        """Whether another master stopped its node and has not started it again."""

    @property
    def has_planned_offsets(self) -> bool:
        """Whether planned offsets are still to be sent."""

    @property
    def has_own_offset(self) -> bool:
        """Whether fdhil, not a guard or another master, sends its offset."""

    @property
    def has_foreign_offset(self) -> bool:
        """Whether another master sent its offset."""

    @property
    def guard_offset(self) -> int:
        """The guard's offset that the drive reports."""

    def ramp_offset_to_zero(self, cycles: int) -> None:
        """Ramp the offset to zero in so many steps and send no other offset afterwards."""

    def switch_off(self, word: int) -> None:
        """Send this controlword from now on, and no offset."""

    def send_zero_offset(self) -> None:
        """Send one offset of zero immediately."""


def stop_drives(drives: Sequence[StoppableDrive], braking: Callable[[], bool]) -> Iterator[bool]:
    """Stop the drives; yield once per cycle whether SYNC and set-points are still needed.

    The axes brake, offsets are ramped to zero, the drives are switched off. A drive that another master controls is
    left to it with zero offset; if its node was stopped, it gets the zero after its restart.
    """
    for drive in drives:
        drive.ramp_offset_to_zero(OFFSET_CYCLES)
    while braking() or any(drive.has_planned_offsets for drive in drives):
        yield True
    own = [drive for drive in drives if not drive.is_led_by_other]
    for _ in range(GUARD_LANDING_CYCLES):
        if not any(drive.guard_offset for drive in own):
            break
        yield True
    for word in OFF_WORDS if own else ():
        for _ in range(WORD_CYCLES):
            for drive in drives:
                drive.switch_off(word)
            yield True
    yield from _zero_offsets_when_started([drive for drive in drives if drive.is_led_by_other and drive.has_own_offset])


def _zero_offsets_when_started(drives: Sequence[StoppableDrive]) -> Iterator[bool]:
    for _ in range(START_CYCLES):
        if not any(drive.is_stopped_by_other for drive in drives):
            break
        yield False
    for _ in range(OFFSET_CYCLES if drives else 0):
        for drive in drives:
            drive.send_zero_offset()
        yield False


def describe_outcome(drives: Sequence[StoppableDrive], written: set[tuple[int, int]]) -> str:
    """Describe how the drives were left, as part of a sentence. The mode is never restored and not mentioned."""
    parts = [_describe_drive(drive) for drive in drives]
    if objects := ", ".join(sorted({f"0x{index:04X}" for _, index in written if index != cia402.Object.MODE})):
        parts.append(f"{objects} may be as fdhil wrote them: power the drives off and on again")
    return ", and ".join(parts) or "nothing more was sent"


def _describe_drive(drive: StoppableDrive) -> str:
    zero = ", its offset set to zero" if drive.has_own_offset else ""
    others = ", and may hold an offset of that master: power it off and on again" if drive.has_foreign_offset else ""
    if drive.is_stopped_by_other:
        unknown = ", and may hold an offset: power it off and on again" if drive.has_own_offset else others
        return f"axis {drive.axis} was left to that master, which stopped its node{unknown}"
    if drive.is_led_by_other:
        return f"axis {drive.axis} was left to that master{zero}"
    return f"axis {drive.axis} was stopped{zero} and its drive switched off{others}"
