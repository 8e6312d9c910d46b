"""The guard's on-line feed-forward: mute until armed, inside its own limits, zero on whatever is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.guard.feedforward import (
    HOLD_CYCLES,
    SHIFT,
    ZEROS,
    Feed,
    FeedMode,
    Law,
    Limits,
    Pair,
    armed,
    end,
    hear,
    move,
    react,
    violates,
)
from fdhil.guard.interlocks import FEEDFORWARD_FACTS, Alarm
from fdhil.guard.requests import parse_law
from fdhil.guard.settings import Feedforward, Pdo, Settings, from_json, to_json
from fdhil.guard.state import Mode, Request
from tests.guard import machine
from tests.guard.machine import Bench, arm_request

ONE = 1 << SHIFT
LAW = Law(speed=(-200 * ONE,), torque=(2 * ONE, -ONE), pace=(-2 * ONE,), dry=30)
LIMITS = Limits(speed=40_000, speed_rate=3_000, torque=900, torque_rate=120)
FACTS = dict.fromkeys(FEEDFORWARD_FACTS, True)


def fed_settings(shown: bool = False) -> Settings:
    """The bench's settings with an RPDO for both offsets, ``shown`` with a TPDO for them as well."""
    made = machine.settings()
    layout = ((0x60B1, 0, 32, True), (0x60B2, 0, 16, True))
    axes = [
        replace(
            axis,
            feedforward=Feedforward(Pdo(0x400 + axis.node_id, layout), LIMITS),
            tpdos=(*axis.tpdos, Pdo(0x1A0 + axis.node_id, layout)) if shown else axis.tpdos,
        )
        for axis in made.axes
    ]
    return replace(made, axes=tuple(axes))


def fed_bench(shown: bool = False) -> Bench:
    """The machine with a moving demand, the guard knowing of no program."""
    bench = machine.bench()
    for drive in bench.drives:
        drive.shows_fed = shown
    return Bench(fed_settings(shown), None, bench.demand, bench.drives)


def request(**changes: Any) -> Request:
    """A granted request, or one with something changed."""
    return replace(Request("feedforward", True, "", FACTS, (LAW, LAW)), **changes)


def switched_on(shown: bool = False) -> Bench:
    """The feed-forward on, faded in, the path running."""
    bench = fed_bench(shown)
    bench.settle()
    assert bench.sync(request()).refused == ()
    bench.run(120)
    bench.play()
    bench.run(150)
    return bench


def test_it_is_mute_until_it_is_asked_for() -> None:
    """No frame leaves, whatever moves; on, both objects leave every SYNC with the heartbeat beside."""
    bench = fed_bench()
    bench.play()
    bench.settle(300)
    assert all(output.feed is None and not output.heartbeat for output in bench.outputs)
    bench = switched_on()
    assert all(output.feed is not None for output in bench.outputs[-150:])
    assert all(output.offsets is None for output in bench.outputs)
    assert any(any(pair) for pair in bench.outputs[-1].feed or ())
    assert len(bench.heartbeats) >= 13


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"token_valid": False}, "AuthRequired"),
        ({"laws": (LAW,)}, "FeedforwardOff"),
        *(({"facts": FACTS | {fact: False}}, code) for fact, code in FEEDFORWARD_FACTS.items()),
    ],
)
def test_what_forbids_it(changes: dict[str, Any], code: str) -> None:
    """Token, law of every axis, and each fact that the daemon must vouch for."""
    bench = fed_bench()
    bench.settle()
    refused = bench.sync(request(**changes)).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == [code]
    assert bench.state.feed.mode is FeedMode.OFF


def test_never_together_with_a_position_offset() -> None:
    """One is refused while the other is on."""
    bench = switched_on()
    refused = bench.sync(arm_request()).refused
    assert refused is not None
    assert "NotOff" in {alarm.code for alarm in refused}
    other = machine.bench()
    other = Bench(fed_settings(), other.path, other.demand, other.drives)
    other.settle()
    assert other.arm() == ()
    refused = other.sync(request()).refused
    assert refused is not None
    assert "NotOff" in {alarm.code for alarm in refused}


def test_without_the_section_it_cannot_be_switched_on() -> None:
    """A drive that was not set up for it has no RPDO in the settings."""
    bench = machine.bench()
    bench.settle()
    refused = bench.sync(request()).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == ["FeedforwardOff"]


def test_disarmed_it_fades_to_zero_and_stops() -> None:
    """Within the fade both offsets are 0, zeros follow, then nothing is sent."""
    bench = switched_on()
    bench.sync(Request("disarm"))
    bench.run(120)
    assert bench.state.feed.mode is FeedMode.OFF
    assert bench.outputs[-1].feed is None
    last = [output.feed for output in bench.outputs if output.feed is not None][-3:]
    assert last == [((0, 0), (0, 0))] * 3
    cause = bench.state.feed.cause
    assert cause is not None
    assert cause.code == "Disarmed"


def test_a_lost_sync_zeroes_at_once() -> None:
    """The first step of the local timer sends zeros, without any ramp."""
    bench = switched_on()
    assert bench.silence().feed == ((0, 0), (0, 0))
    for _ in range(5):
        bench.silence()
    assert bench.state.feed.mode is FeedMode.OFF
    assert bench.state.mode is Mode.OFF


@pytest.mark.parametrize("what", ["fault", "daemon", "target"])
def test_a_fault_fades_it_out(what: str) -> None:
    """A drive's fault, a daemon that is gone, targets that stay away: each with its cause."""
    bench = switched_on()
    if what == "fault":
        bench.drives[0].statusword = 0x0218
    elif what == "daemon":
        bench.main_alive = False
    for _ in range(140):
        bench.sync(nc=what != "target")
    assert bench.state.feed.mode is FeedMode.OFF
    cause = bench.state.feed.cause
    assert cause is not None
    assert cause.code == {"fault": "DriveNotEnabled", "daemon": "MainLost", "target": "TargetLost"}[what]


def test_a_lost_target_is_bridged() -> None:
    """One target that does not come is taken to go on as those before it."""
    bench = switched_on()
    bench.sync(nc=False)
    bench.run(30)
    assert bench.state.feed.mode is FeedMode.ON


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.booleans()), min_size=5, max_size=80), st.integers(1, 50)
)
def test_limits_hold_for_any_targets(heard: list[tuple[int, bool]], ending: int) -> None:
    """Amplitude and rate of both offsets, whatever the targets jump to or lack; at the end they are zero."""
    feed: Feed = armed((LAW,))
    for k, (target, lost) in enumerate(heard):
        if k == ending:
            feed = end(feed, Alarm("Disarmed"))
        before = feed.applied
        feed = move(hear(feed, [None if lost else target]), [LIMITS], 20)
        assert not violates(LIMITS, before[0], feed.applied[0])
    feed = end(feed, Alarm("Disarmed"))
    for _ in range(60):
        feed = move(feed, [LIMITS], 20)
    assert feed.applied == ((0, 0),)
    assert feed.mode is FeedMode.OFF


def test_at_rest_the_law_says_zero() -> None:
    """Weights count from the newest target: rounding of the weights cannot leave an offset on an axis at rest."""
    assert LAW.offsets([123_456] * 3) == (0, 0)
    assert LAW.offsets([10, 0, -10]) == (2000, -20 + 20 + 30)


GOOD = {"speed": [1], "torque": [1], "pace": [1], "dry": 1}


@pytest.mark.parametrize(
    "change",
    [
        {"speed": []},
        {"speed": [1.5]},
        {"pace": [True]},
        {"torque": [1] * 65},
        {"dry": 1 << 60},
        {"dry": None},
        {"pace": 3},
    ],
)
def test_only_a_whole_law_is_taken(change: dict[str, object]) -> None:
    """Integers of a bounded size, a bounded number of them."""
    assert parse_law(GOOD) == Law((1,), (1,), (1,), 1)
    assert parse_law(GOOD | change) is None
    assert parse_law([GOOD]) is None


def test_settings_keep_it() -> None:
    """Through the settings file, and its COB-IDs are among those that may leave."""
    made = fed_settings()
    assert from_json(to_json(made)) == made
    assert {0x401, 0x402} <= made.sent_ids
    assert len(made.feeds) == 2


def mode_of(bench: Bench) -> FeedMode:
    """Whether the feed-forward acts."""
    return bench.state.feed.mode


def code_of(bench: Bench) -> str | None:
    """Why the feed-forward went off."""
    cause = bench.state.feed.cause
    return None if cause is None else cause.code


def test_what_the_drives_show_is_what_was_sent() -> None:
    """Every value comes back a cycle later; frames that were late or did not leave are no mismatch."""
    bench = switched_on(shown=True)
    for k in range(200):
        bench.sync(late=k % 20 == 5)
    assert any(any(drive.fed) for drive in bench.drives)
    assert mode_of(bench) is FeedMode.ON
    assert [axis.feed_misses for axis in bench.state.axes] == [0, 0]


@pytest.mark.parametrize(
    "takes",
    [
        lambda pair: (pair[0], 0),
        lambda pair: (0, pair[1]),
        lambda pair: (pair[1], pair[0] & 0x7FF),
        lambda pair: (pair[0], -pair[1]),
        lambda pair: (pair[0], 10 * pair[1]),
    ],
    ids=["no torque", "no speed", "swapped", "sign", "scale"],
)
def test_a_drive_that_makes_something_else_of_them_ends_it(takes: Callable[[Pair], Pair]) -> None:
    """Two readings that are none of the last values sent fade both offsets out, as for a position offset."""
    bench = switched_on(shown=True)
    bench.drives[1].takes_fed = takes
    bench.run(4)
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.ENDING, "EchoMismatch")
    bench.run(200)
    assert mode_of(bench) is FeedMode.OFF
    assert bench.drives[0].fed == (0, 0)


def test_one_wrong_reading_is_none() -> None:
    bench = switched_on(shown=True)
    bench.drives[0].takes_fed = lambda pair: (pair[0] + 7, pair[1])
    bench.sync()
    bench.drives[0].takes_fed = lambda pair: pair
    bench.run(50)
    assert mode_of(bench) is FeedMode.ON


def test_a_drive_that_keeps_its_torque_is_told() -> None:
    """Zeros go on for as long as they may help; then the guard gives up and says so, and refuses the next arming."""
    bench = switched_on(shown=True)
    bench.drives[0].takes_fed = lambda _pair: (0, 40)
    bench.run(140)
    assert mode_of(bench) is FeedMode.ENDING
    assert bench.outputs[-1].feed == ((0, 0), (0, 0))
    bench.run(80)
    assert mode_of(bench) is FeedMode.OFF
    assert bench.state.feed.cause == Alarm("EchoMismatch", detail="no zero was read back")
    for wanted in (request(), arm_request()):
        refused = bench.sync(wanted).refused
        assert refused is not None
        assert "StaleOffset" in {alarm.code for alarm in refused}
    bench.drives[0].takes_fed = lambda pair: pair
    assert bench.sync(Request("adopt", True)).refused == ()
    bench.run(20)
    assert bench.drives[0].fed == (0, 0)
    assert (bench.mode, bench.state.feed.mode) == (Mode.OFF, FeedMode.OFF)


def test_a_drive_that_holds_a_torque_at_start_gets_zeros() -> None:
    """A guard that comes back finds what another left behind; nothing else is sent."""
    bench = fed_bench(shown=True)
    bench.drives[1].fed = (0, -25)
    bench.settle()
    assert bench.drives[1].fed == (0, 0)
    assert {output.feed for output in bench.outputs} == {None, ((0, 0), (0, 0))}
    assert (bench.mode, bench.state.feed.mode) == (Mode.OFF, FeedMode.OFF)
    assert bench.sync(request()).refused == ()


def test_one_mapped_object_is_enough_to_compare() -> None:
    """A TPDO with the torque alone: the speed says nothing."""
    bench = fed_bench(shown=True)
    layout = ((0x2000, 0, 32, True), (0x60B2, 0, 16, True))
    axes = [replace(a, tpdos=(*a.tpdos[:-1], Pdo(0x1A0 + a.node_id, layout))) for a in bench.settings.axes]
    bench = Bench(replace(bench.settings, axes=tuple(axes)), None, bench.demand, bench.drives)
    bench.settle()
    assert bench.sync(request()).refused == ()
    bench.play()
    bench.run(200)
    assert mode_of(bench) is FeedMode.ON
    bench.drives[0].takes_fed = lambda pair: (pair[0], pair[1] + 1)
    bench.run(4)
    assert code_of(bench) == "EchoMismatch"


def test_a_feed_hold_takes_them_to_zero() -> None:
    """Targets that stand leave neither speed nor torque: the offsets go to zero within the limits, and stay there."""
    bench = switched_on()
    bench.rest = bench.targets()
    bench.run(60)
    assert bench.outputs[-1].feed == ((0, 0), (0, 0))
    sent = [output.feed for output in bench.outputs if output.feed is not None]
    for before, after in pairwise(sent):
        assert not any(violates(LIMITS, *way) for way in zip(before, after, strict=True))
    assert mode_of(bench) is FeedMode.ON


@pytest.mark.parametrize("what", ["bus off", "reboot", "not operational"])
def test_what_stops_the_bus_or_a_drive_zeroes_at_once(what: str) -> None:
    """No fade: the very next frames are zeros, and nothing follows them."""
    bench = switched_on()
    if what == "bus off":
        bench.listener.error("off")
    elif what == "reboot":
        bench.hear(0x701, b"\0")
    else:
        bench.hear(0x701, b"\x7f")
    assert bench.sync().feed == ((0, 0), (0, 0))
    bench.run(10)
    assert bench.outputs[-1].feed is None
    code = {"bus off": "BusOff", "reboot": "NodeRebooted", "not operational": "NmtStateWrong"}[what]
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.OFF, code)


def test_beyond_its_limits_it_is_limited_and_counted() -> None:
    """A demand faster than the largest speed offset: what is sent stays at the limit, and the count says so."""
    bench = fed_bench()
    bench.settle()
    assert bench.sync(request()).refused == ()
    bench.run(120)
    assert bench.state.feed.limited == 0
    bench.play()
    bench.run(150)
    assert bench.state.feed.limited > 10
    sent = [output.feed for output in bench.outputs if output.feed is not None]
    assert max(abs(pair[0]) for pairs in sent for pair in pairs) == LIMITS.speed


def test_a_corrupt_state_sends_zeros() -> None:
    """Whatever breaks the limits is checked by other formulas than made it: InternalError, zeros, off."""
    bench = switched_on()
    broken = bench.state.feed._replace(sent=(((LIMITS.speed + 5_000, 0), (0, 0)), *bench.state.feed.sent[1:]))
    bench.state = bench.state._replace(feed=broken)
    assert bench.sync().feed == ((0, 0), (0, 0))
    bench.run(10)
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.OFF, "InternalError")


def fed(**changes: Any) -> Feed:
    """A feed-forward of one axis that is on, with all targets it needs."""
    return armed((LAW,))._replace(targets=((30, 20, 10),), **changes)


def test_it_fades_in_cycle_by_cycle_and_out_the_same_way() -> None:
    """Of 10 cycles each adds a tenth of what the law says, rounded down; ending takes it back."""
    wide, feed = Limits(10**6, 10**6, 10**4, 10**4), fed()
    assert LAW.offsets((30, 20, 10)) == (2000, 30)
    seen = []
    for _ in range(12):
        feed = move(feed, [wide], 10)
        seen.append(feed.applied[0])
    assert seen == [(200 * k, 3 * k) for k in range(1, 11)] + [(2000, 30)] * 2
    feed = end(feed, Alarm("Disarmed"))
    seen = []
    for _ in range(10):
        feed = move(feed, [wide], 10)
        seen.append(feed.applied[0])
    assert seen == [(200 * k, 3 * k) for k in range(9, -1, -1)]
    assert feed.zeros == 1
    for _ in range(ZEROS - 1):
        feed = move(feed, [wide], 10)
        assert feed.mode is FeedMode.ENDING
    assert move(feed, [wide], 10).mode is FeedMode.OFF


def test_nothing_but_zeros_until_every_target_was_heard() -> None:
    feed = armed((LAW,))
    for heard in (5, 1005):
        feed = move(hear(feed, [heard]), [LIMITS], 10)
        assert (feed.applied, feed.share) == (((0, 0),), 0)
    feed = move(hear(feed, [2005]), [LIMITS], 10)
    assert feed.share == 1
    assert any(feed.applied[0])


@pytest.mark.parametrize(
    ("after", "broken"),
    [
        ((40_000, 900), True),
        ((3_000, 120), False),
        ((3_001, 120), True),
        ((3_000, 121), True),
        ((-3_000, -120), False),
        ((-3_001, 0), True),
        ((0, -121), True),
        ((0, 0), False),
        ((0, 0.0), True),
        ((True, 0), True),
    ],
)
def test_the_check_of_a_frame_knows_the_limits_alone(after: Any, broken: bool) -> None:
    assert violates(LIMITS, (0, 0), after) is broken


def test_the_largest_values_are_the_last_that_pass() -> None:
    for largest, torque in ((40_000, 900), (-40_000, -900)):
        assert not violates(LIMITS, (largest, torque), (largest, torque))
        step = 1 if largest > 0 else -1
        assert violates(LIMITS, (largest, torque), (largest + step, torque))
        assert violates(LIMITS, (largest, torque), (largest, torque + step))
    assert not violates(LIMITS, (40_000, 900), (0, 0))  # zero may always be sent


def test_a_gap_is_bridged_for_ten_cycles_in_a_row() -> None:
    """The eleventh ends it; one good cycle in between starts the count anew."""
    hold, feed = (Alarm("TargetLost"),), fed()
    for k in range(HOLD_CYCLES):
        feed = react(feed, hold)
        assert (feed.mode, feed.held) == (FeedMode.ON, k + 1)
    assert react(feed, hold).mode is FeedMode.ENDING
    assert react(feed, ()).held == 0
    assert react(react(feed, ()), hold).held == 1


def test_the_worst_alarm_decides() -> None:
    both = (Alarm("TargetLost"), Alarm("EchoMismatch"), Alarm("BusOff"))
    assert react(fed(), both[:2]).cause == Alarm("EchoMismatch")
    zeroing = react(fed(share=7, zeros=2), both)
    assert (zeroing.mode, zeroing.cause, zeroing.share, zeroing.zeros) == (FeedMode.ZEROING, Alarm("BusOff"), 0, 0)
    assert react(zeroing, (Alarm("SyncLost"),)).cause == Alarm("BusOff")
    assert react(fed(), (Alarm("StaleOffset"),)).mode is FeedMode.ON  # what only forbids arming
    assert react(Feed(), both).mode is FeedMode.OFF


def test_a_lost_target_goes_on_as_the_two_before_it() -> None:
    feed = armed((LAW,))
    assert hear(feed, [None]).targets == ((),)
    feed = hear(hear(feed, [100]), [None])
    assert feed.targets == ((100,),)
    feed = hear(hear(feed, [130]), [None])
    assert feed.targets == ((160, 130, 100),)
    assert hear(feed, [7]).targets == ((7, 160, 130),)


@given(st.integers(-(2**40), 2**40))
def test_dividing_by_the_scale_rounds_to_the_nearest(value: int) -> None:
    law = Law(speed=(value,), torque=(0,), pace=(0,), dry=0)
    assert abs(law.offsets((0, 1))[0] * ONE - value) <= ONE // 2
