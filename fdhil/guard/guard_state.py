"""Records of the guard's core: its inputs, its outputs and its state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from fdhil.guard.corrected_path import CorrectedPath, PathPosition
from fdhil.guard.feedforward_law import FeedforwardState, Law, Pair
from fdhil.guard.guard_protocol import SENDING, FeedMode, Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.interlocks import Alarm
from fdhil.guard.offset_limits import OffsetTravel
from fdhil.guard.state_transitions import NEXT, Event

Shown = tuple[int | None, int | None]
"""What a drive shows of its speed and its torque offset; None where no TPDO does."""
NOT_SHOWN: Shown = (None, None)
UNDISTURBED = 1 << 30


@dataclass(frozen=True, slots=True)
class GuardRequest:
    """A request of the operator or the daemon; all but a disarm and a stop need the operator's token.

    ``compared`` are the fingerprints, per axis, of drives that match their commissioning record; ``touched`` is how
    often each had been written to or rebooted, by the status read before the comparison.
    """

    kind: Literal["arm", "feedforward", "disarm", "adopt", "compared", "stop"]
    token_valid: bool = False
    program_digest: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)
    laws: tuple[Law, ...] = ()
    compared: Mapping[str, str] = field(default_factory=dict)
    touched: Mapping[str, int] = field(default_factory=dict)


class AxisInput(NamedTuple):
    """One axis at a SYNC: the content of its frames since the SYNC before.

    ``target`` is the 0x607A that this SYNC latched, ``position`` and ``read_back`` what was sampled at the SYNC before
    (None when no frame came). Ages are infinite when nothing was ever received; ``feedback_age`` is that of the older
    of statusword and position, ``read_back_age`` that of 0x60B0, each in units of its own period;
    ``read_back_crowded``: its TPDO came when it was not due, so that one of the last two may be another node's.
    ``demand`` is 0x6062; ``touched`` counts boot-ups, and writes to objects that the commissioning relies on.
    """

    target: int | None = None
    position: int | None = None
    read_back: int | None = None
    following_error: int | None = None
    statusword: int | None = None
    mode: int | None = None
    nmt: int | None = None
    feedback_age: float = float("inf")
    heartbeat_age_s: float = float("inf")
    short_frames: int = 0
    long_frames: int = 0
    fed_back: Shown = NOT_SHOWN
    speed: int | None = None
    read_back_age: float = float("inf")
    demand: int | None = None
    touched: int = 0
    read_back_crowded: bool = False


class BusView(NamedTuple):
    """State of the bus at a SYNC."""

    state: str = "active"
    sync_regular: bool = False
    silent: bool = True
    lost_frames: int = 0


class StepInputs(NamedTuple):
    """All inputs of one step. ``sync`` False: a step of the local timer, because no SYNC came.

    ``late``: the next SYNC has already arrived, so that nothing sent now would be in time. ``unsent`` are the axes
    whose offset of the step before did not leave, ``unfed`` those whose speed and torque offset did not. ``alarms`` are
    events since the last step (emergency, foreign frame).
    """

    sync: bool
    axes: tuple[AxisInput, ...]
    bus: BusView
    late: bool = False
    unsent: tuple[int, ...] = ()
    unfed: tuple[int, ...] = ()
    main_alive: bool = True
    alarms: tuple[Alarm, ...] = ()
    withdrawn: tuple[Alarm, ...] = ()
    path: CorrectedPath | None = None
    request: GuardRequest | None = None


class AxisState(NamedTuple):
    """One axis' offset: ``offset`` in force or about to be, moving at ``rate``; ``sent``: last values, newest first.

    ``read_back`` is what the drive last showed (None: never), in ``readings`` TPDOs in a row, ``off_demand`` away from
    what 0x6062 shows; ``zero_shown``: it showed 0 since we send 0. ``record_void``: it may differ from the commissioned
    drive. ``strays`` grows with wrong readings between correct ones; ``foreign``: another node wrote the value shown
    last. ``fed_back`` is the read-back of the speed and torque offset. ``believed`` are the last plausible position,
    speed (increments per cycle) and tick, ``implausible`` counts the implausible samples since then.
    """

    offset: int = 0
    rate: int = 0
    sent: tuple[int, ...] = (0,) * 4
    travel: OffsetTravel = OffsetTravel()
    read_back: int | None = None
    readings: int = 0
    off_demand: float = 0.0
    record_void: bool = False
    touched: int = 0
    echo_misses: int = 0
    late_echoes: int = 0
    strays: int = 0
    foreign: bool = False
    zero_shown: bool = False
    following_error: float = float("nan")
    fed_back: Shown = NOT_SHOWN
    feed_misses: int = 0
    believed: tuple[int, float, int] | None = None
    implausible: int = 0


class GuardState(NamedTuple):
    """The guard's whole state.

    ``places`` are the rows of the path that the machine may be at, best first; ``anchor`` the last row that matched the
    targets. ``rest`` are the last targets received, ``rested_for`` the cycles since they last changed. ``cause`` is why
    the correction went off, kept until the next arming. ``measuring`` counts the cycles in which nothing is sent
    because another node changed the offset: the ramp starts from what the drives show. ``unknown_for`` counts the
    cycles after the start in which a drive showed an offset that was not trusted yet, ``undisturbed_for`` those since
    another node wrote an offset.
    """

    mode: Mode
    axes: tuple[AxisState, ...]
    tick: int = 0
    targets: tuple[tuple[int, ...] | None, ...] = ()
    good_for: int = 0
    program_digest: str = ""
    start_row: int = 0
    rest: tuple[int, ...] | None = None
    rested_for: int = 0
    places: tuple[PathPosition, ...] = ()
    anchor: int = 0
    held_for: int = 0
    resuming: bool = False
    zeros_sent: int = 0
    measuring: int = 0
    unknown_for: int = 0
    undisturbed_for: int = UNDISTURBED
    adopt_checked: bool = False
    cause: Alarm | None = None
    missed: int = 0
    missed_run: int = 0
    failed_run: int = 0
    feed: FeedforwardState = FeedforwardState()

    @property
    def sending(self) -> bool:
        """Whether the guard sends frames."""
        return self.mode in SENDING or self.feed.mode is not FeedMode.OFF

    def follow_event(self, event: Event, **changes: Any) -> GuardState:
        """Return the state after ``event``, with ``changes``; KeyError where the table has no such transition."""
        return self._replace(mode=NEXT[self.mode, event], **changes)


class StepOutput(NamedTuple):
    """The output of a step: the offset of each axis in increments (None: send nothing), our heartbeat, journal entries.

    ``refused`` answers a request: None when there was none, empty when it was granted. ``feed`` are speed and torque
    offset of each axis in the drive's counts.
    """

    offsets: tuple[int, ...] | None = None
    heartbeat: bool = False
    refused: tuple[Alarm, ...] | None = None
    transition: tuple[Mode, Mode, Alarm | None] | None = None
    feed: tuple[Pair, ...] | None = None
    feed_transition: tuple[FeedMode, FeedMode] | None = None


def make_initial_state(settings: GuardSettings) -> GuardState:
    """Return the state at start: off, nothing known."""
    axes = [
        AxisState(sent=(0,) * (axis.setpoint_delay_cycles + settings.lead + 4), record_void=axis.record_void)
        for axis in settings.axes
    ]
    return GuardState(Mode.OFF, tuple(axes))
