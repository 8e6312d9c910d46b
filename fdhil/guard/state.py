"""Records what goes in and out of the guard's core, and what it remembers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from fdhil.guard.feedforward import Feed, Law, Pair
from fdhil.guard.interlocks import Alarm
from fdhil.guard.limits import Travel
from fdhil.guard.path import CorrectedPath, Place
from fdhil.guard.protocol import SENDING, FeedMode, Mode
from fdhil.guard.settings import Settings
from fdhil.guard.transitions import NEXT, Event

Shown = tuple[int | None, int | None]
"""What a drive shows of its speed and its torque offset; None where no TPDO does."""
NOT_SHOWN: Shown = (None, None)
UNDISTURBED = 1 << 30


@dataclass(frozen=True, slots=True)
class Request:
    """What the operator or the daemon asks for; all but a disarm and a stop need the operator's token.

    ``compared`` are the fingerprints, per axis, of drives that were found to be as they were commissioned, ``touched``
    how often each had been touched by what the status said before they were read.
    """

    kind: Literal["arm", "feedforward", "disarm", "adopt", "compared", "stop"]
    token_valid: bool = False
    program_digest: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)
    laws: tuple[Law, ...] = ()
    compared: Mapping[str, str] = field(default_factory=dict)
    touched: Mapping[str, int] = field(default_factory=dict)


class AxisInput(NamedTuple):
    """One axis at a SYNC: what its frames said since the SYNC before.

    ``target`` is the 0x607A that this SYNC latched, ``position`` and ``read_back`` what was sampled at the SYNC before
    (None when no frame came). Ages are infinite when never heard;
    ``feedback_age`` is that of the older of statusword and position, ``read_back_age`` that of 0x60B0, each in units of
    its own rate; ``read_back_crowded``: its TPDO came when it was not due, so that one of the last two may be another
    node's. ``demand`` is 0x6062; ``touched`` counts boot-ups, and writes to what the commissioning relies on.
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
    """What is known of the bus at a SYNC."""

    state: str = "active"
    sync_regular: bool = False
    silent: bool = True
    lost_frames: int = 0


class Inputs(NamedTuple):
    """All that one step may know. ``sync`` False: the local timer, because no SYNC came.

    ``late``: the next SYNC is already there, so that nothing sent now would be in time. ``unsent`` are the axes whose
    offset of the step before did not leave, ``unfed`` those whose speed and torque offset did not. ``alarms`` are
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
    request: Request | None = None


class AxisState(NamedTuple):
    """One axis' offset: ``offset`` in force or about to be, moving at ``rate``; ``sent`` the last values, newest first.

    ``read_back`` is what the drive last showed (None: never), in ``readings`` TPDOs in a row, by ``off_demand`` away
    from what 0x6062 says; ``zero_shown``: it showed 0 since we send 0. ``record_void``: it may not be as commissioned.
    ``strays`` grows with readings that were not what was sent, between others that were; ``foreign``: another node
    wrote what was shown last.
    ``fed_back`` is the same of speed and torque offset. ``believed`` are the last position, speed (increments per
    cycle) and tick that agreed with those before, ``implausible`` the samples since then that did not.
    """

    offset: int = 0
    rate: int = 0
    sent: tuple[int, ...] = (0,) * 4
    travel: Travel = Travel()
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


class State(NamedTuple):
    """The guard's whole memory.

    ``places`` are the rows of the path that the machine may be at, best first; ``anchor`` the last row that the
    targets agreed with. ``rest`` are the last targets heard, ``rested_for`` the cycles since they came to stand there.
    ``cause`` is why the correction went off, kept until the next arming. ``measuring`` counts the cycles in which
    nothing is sent because another node changed the offset: the ramp starts from what the drives show.
    ``unknown_for`` counts those after the start in which a drive showed an offset that could not be believed yet,
    ``undisturbed_for`` those since another node wrote an offset.
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
    places: tuple[Place, ...] = ()
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
    feed: Feed = Feed()

    @property
    def sending(self) -> bool:
        """Whether frames of ours leave."""
        return self.mode in SENDING or self.feed.mode is not FeedMode.OFF

    def after(self, event: Event, **changes: Any) -> State:
        """Return the state that ``event`` leads to, with ``changes``; KeyError where the table has no such way."""
        return self._replace(mode=NEXT[self.mode, event], **changes)


class Output(NamedTuple):
    """What to do now: the offset of each axis in increments (None: send nothing), our heartbeat, what to journal.

    ``refused`` answers a request: None when there was none, empty when it was granted. ``feed`` are speed and torque
    offset of each axis in the drive's counts.
    """

    offsets: tuple[int, ...] | None = None
    heartbeat: bool = False
    refused: tuple[Alarm, ...] | None = None
    transition: tuple[Mode, Mode, Alarm | None] | None = None
    feed: tuple[Pair, ...] | None = None
    feed_transition: tuple[FeedMode, FeedMode] | None = None


def initial(settings: Settings) -> State:
    """Return the state at start: off, nothing known."""
    axes = [
        AxisState(sent=(0,) * (axis.setpoint_delay_cycles + settings.lead + 4), record_void=axis.record_void)
        for axis in settings.axes
    ]
    return State(Mode.OFF, tuple(axes))
