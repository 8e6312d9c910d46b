"""Computes speed and torque offsets (0x60B1, 0x60B2) on line from the targets that the NC sends. Pure.

The law is a few integer weights per axis, which the daemon derives from the identified drive; here it is integer
arithmetic on the last targets, with limits of its own. Its state is separate from that of the position offset, and both
are never on together. Zero is always the safer value: whatever freezes a position offset sets these to zero at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdhil.guard.guard_protocol import HOLD_CYCLES, FeedMode
from fdhil.guard.interlocks import Alarm, Reaction
from fdhil.guard.offset_limits import limit_value
from fdhil.guard.state_transitions import NEXT_FEED, ZEROS, ZEROS_UNCONFIRMED, Event

SHIFT = 24
FADE_S = 0.1
KEPT = 4
"""Cycles of sent offsets that are kept to compare with what the drives show."""

Targets = tuple[int, ...]
Pair = tuple[int, int]


class FeedforwardLimits(NamedTuple):
    """Largest speed offset (increments/s), torque offset (0.1 % of the rated torque), and their change per cycle."""

    speed: int
    speed_rate: int
    torque: int
    torque_rate: int


class Law(NamedTuple):
    """One axis' weights, times 2^24, on the distances of the last targets from the newest one, newest first.

    ``pace`` yields the speed as a share of the speed at which dry friction acts in full; ``dry`` is that friction's
    torque.
    """

    speed: tuple[int, ...]
    torque: tuple[int, ...]
    pace: tuple[int, ...]
    dry: int

    @property
    def depth(self) -> int:
        """The number of targets that the law needs."""
        return 1 + max(len(self.speed), len(self.torque), len(self.pace))

    def compute_offsets(self, targets: Sequence[int]) -> Pair:
        """Return speed and torque offset for the last ``targets``, newest first."""
        newest = targets[0]
        ways = [target - newest for target in targets[1:]]
        pace = limit_value(_sum_weighted_distances(self.pace, ways), -(1 << SHIFT), 1 << SHIFT)
        return _round_fixed_point(_sum_weighted_distances(self.speed, ways)), _round_fixed_point(
            _sum_weighted_distances(self.torque, ways) + self.dry * pace
        )


def _sum_weighted_distances(weights: Sequence[int], ways: Sequence[int]) -> int:
    return sum([weight * way for weight, way in zip(weights, ways, strict=False)])


def _round_fixed_point(value: int) -> int:
    """Divide by 2^24, rounding to the nearest."""
    return (value + (1 << SHIFT - 1)) >> SHIFT


class FeedforwardState(NamedTuple):
    """State of the feed-forward: ``share`` of ``FADE_S`` faded in (cycles), the last targets per axis, newest first.

    ``sent``: the last offsets of all axes, newest first; ``held``: cycles in which an interlock failed; ``limited``:
    cycles in which a limit acted; ``unsent``: consecutive cycles whose frames did not leave. ``unconfirmed``: it went
    OFF although no zero was read back, or none was sent: an offset may still be applied.
    """

    mode: FeedMode = FeedMode.OFF
    laws: tuple[Law, ...] = ()
    share: int = 0
    targets: tuple[Targets, ...] = ()
    sent: tuple[tuple[Pair, ...], ...] = ((),)
    held: int = 0
    limited: int = 0
    zeros: int = 0
    unsent: int = 0
    unconfirmed: bool = False
    cause: Alarm | None = None

    @property
    def may_stand(self) -> bool:
        """Whether speed or torque offsets may be applied."""
        return self.mode is not FeedMode.OFF or self.unconfirmed

    @property
    def applied(self) -> tuple[Pair, ...]:
        """The offsets sent last, per axis."""
        return self.sent[0]

    def follow_event(self, event: Event, cause: Alarm | None) -> FeedforwardState:
        """Return the state that ``event`` leads to; KeyError where the table has no such transition."""
        unconfirmed = event is Event.ZERO_NOT_SHOWN
        return self._replace(mode=NEXT_FEED[self.mode, event], cause=cause, unconfirmed=unconfirmed)

    def record_sent_pairs(self, pairs: tuple[Pair, ...]) -> FeedforwardState:
        """Record the offsets that are sent now."""
        return self._replace(sent=(pairs, *self.sent)[:KEPT])

    def restore_unsent_pairs(self, axes: Sequence[int]) -> FeedforwardState:
        """Note that the last frames of some axes did not leave: the offsets before them still act, no zero counts."""
        if not axes:
            return self._replace(unsent=0)
        newest, before = (*self.sent, *self.sent)[:2]
        held = [before[k] if k in axes else pair for k, pair in enumerate(newest)]
        return self._replace(sent=(tuple(held), *self.sent[1:]), zeros=0, unsent=self.unsent + 1)


def arm_feedforward(laws: tuple[Law, ...]) -> FeedforwardState:
    """Return the state after arming: zeros are sent until enough targets were received."""
    off = FeedforwardState(laws=laws, targets=((),) * len(laws), sent=(((0, 0),) * len(laws),) * KEPT)
    return off.follow_event(Event.ARM, None)


def begin_zeroing(axes: int, cause: Alarm) -> FeedforwardState:
    """Return the state that sends zeros to drives that hold other values."""
    return FeedforwardState(sent=(((0, 0),) * axes,)).follow_event(Event.ADOPT, cause)


def begin_fade_out(feed: FeedforwardState, cause: Alarm) -> FeedforwardState:
    """Begin to fade out."""
    return feed.follow_event(Event.END, cause) if feed.mode is FeedMode.ON else feed


def react_to_alarms(feed: FeedforwardState, alarms: Sequence[Alarm]) -> FeedforwardState:
    """Zero at once on what stops a drive or the bus, fade out on other alarms; bridge a short gap."""
    if feed.mode is FeedMode.OFF:
        return feed
    worst = max(alarms, key=lambda alarm: alarm.reaction, default=None)
    if worst is None or worst.reaction is Reaction.REFUSE:
        return feed._replace(held=0)
    if worst.reaction is Reaction.FREEZE and feed.mode is not FeedMode.ZEROING:
        return feed.follow_event(Event.BLOCKED, worst)._replace(share=0, zeros=0)
    if worst.reaction is Reaction.RAMP_DOWN or feed.held >= HOLD_CYCLES:
        return begin_fade_out(feed, worst)
    return feed._replace(held=feed.held + 1)


def take_targets(feed: FeedforwardState, targets: Sequence[int | None]) -> FeedforwardState:
    """Take the targets that a SYNC latched; extrapolate a missing one from the two before it."""
    latched = []
    for law, past, target in zip(feed.laws, feed.targets, targets, strict=True):
        newest = target
        if newest is None:
            newest = 2 * past[0] - past[1] if len(past) > 1 else None
        latched.append(past if newest is None else (newest, *past)[: law.depth])
    return feed._replace(targets=tuple(latched))


def advance_feedforward(
    feed: FeedforwardState, limits: Sequence[FeedforwardLimits], fade_cycles: int, confirmed: bool = True
) -> FeedforwardState:
    """Advance one cycle: ``applied`` becomes the next offsets within their limits; OFF once enough zeros were sent.

    ``confirmed``: no drive shows anything but 0; while one does, zeros are sent for longer.
    """
    if feed.mode is FeedMode.ZEROING:
        return advance_zeroing(feed, confirmed)
    complete = all(len(past) == law.depth for law, past in zip(feed.laws, feed.targets, strict=True))
    share = feed.share + 1 if feed.mode is FeedMode.ON else feed.share - 1
    feed = feed._replace(share=limit_value(share, 0, fade_cycles) if complete else 0)
    applied, limited = [], False
    for k, (law, past, own) in enumerate(zip(feed.laws, feed.targets, limits, strict=True)):
        speed, torque = law.compute_offsets(past) if complete else (0, 0)
        limited = limited or abs(speed) > own.speed or abs(torque) > own.torque
        applied.append(_limit_pair(feed.applied[k], (speed, torque), feed.share, fade_cycles, own))
    feed = feed.record_sent_pairs(tuple(applied))._replace(limited=feed.limited + limited)
    still = feed.mode is FeedMode.ENDING and feed.share == 0 and not any(map(any, applied))
    return _finish_zeroing(feed._replace(zeros=feed.zeros + 1 if still else 0), confirmed)


def advance_zeroing(feed: FeedforwardState, confirmed: bool = True) -> FeedforwardState:
    """Advance one cycle with zeros."""
    return _finish_zeroing(
        feed.record_sent_pairs(((0, 0),) * len(feed.applied))._replace(zeros=feed.zeros + 1), confirmed
    )


def _finish_zeroing(feed: FeedforwardState, confirmed: bool) -> FeedforwardState:
    """Go OFF after enough zeros that the drives show; or after many more that are not shown or do not leave."""
    if confirmed and feed.zeros > ZEROS:
        return feed.follow_event(Event.ZERO_SHOWN, feed.cause)
    if feed.mode is FeedMode.ON or max(feed.zeros, feed.unsent) <= ZEROS_UNCONFIRMED:
        return feed
    return feed.follow_event(Event.ZERO_NOT_SHOWN, Alarm("EchoMismatch", detail="no zero was read back"))


def _limit_pair(before: Pair, wanted: Pair, share: int, fade_cycles: int, limits: FeedforwardLimits) -> Pair:
    """Fade, then limit amplitude and rate."""
    bounds = ((limits.speed, limits.speed_rate), (limits.torque, limits.torque_rate))
    values = []
    for last, goal, (largest, rate) in zip(before, wanted, bounds, strict=True):
        faded = limit_value(goal, -largest, largest) * share // fade_cycles
        values.append(limit_value(faded, last - rate, last + rate))
    return values[0], values[1]


def violates_limits(limits: FeedforwardLimits, before: Pair, after: Pair) -> bool:
    """Check what is about to be sent against the limits alone; zero is always allowed."""
    for last, value, largest, rate in zip(before, after, limits[::2], limits[1::2], strict=True):
        if type(value) is not int or not -largest <= value <= largest:
            return True
        if value != 0 and not -rate <= value - last <= rate:
            return True
    return False
