"""The guard's on-line feed-forward on the machine: mute until armed, zero on any fault, read back."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from fdhil.guard import status, table
from fdhil.guard.control import Client, Closer
from fdhil.guard.feedforward import Pair, armed, violates
from fdhil.guard.feeding import go_on
from fdhil.guard.intake import Intake
from fdhil.guard.interlocks import FEEDFORWARD_FACTS, Alarm
from fdhil.guard.journal import Journal
from fdhil.guard.protocol import FeedMode, Mode
from fdhil.guard.settings import Pdo, from_json, to_json
from fdhil.guard.state import AxisInput, BusView, Inputs, Output, Request, initial
from tests.guard import machine
from tests.guard.fed import FACTS, LAW, LIMITS, fed_bench, fed_settings, request, switched_on
from tests.guard.machine import Bench, arm_request, commissioned
from tests.guard.shop import OWNER, TOKEN, Shop


def test_it_is_mute_until_it_is_asked_for() -> None:
    bench = fed_bench()
    bench.play()
    bench.settle(300)
    assert all(output.feed is None and not output.heartbeat for output in bench.outputs)
    bench = switched_on()
    assert all(output.feed is not None for output in bench.outputs[-150:])
    assert all(output.offsets is None for output in bench.outputs)
    assert any(any(pair) for pair in bench.outputs[-1].feed or ())
    assert {later - sooner for sooner, later in pairwise(bench.heartbeats)} == {20}
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
    bench = fed_bench()
    bench.settle()
    refused = bench.sync(request(**changes)).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == [code]
    assert bench.state.feed.mode is FeedMode.OFF


def test_never_together_with_a_position_offset() -> None:
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
    bench = machine.bench()
    bench.settle()
    refused = bench.sync(request()).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == ["FeedforwardOff"]


def test_disarmed_it_fades_to_zero_and_stops() -> None:
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
    bench = switched_on()
    assert bench.silence().feed == ((0, 0), (0, 0))
    for _ in range(5):
        bench.silence()
    assert bench.state.feed.mode is FeedMode.OFF
    assert bench.state.mode is Mode.OFF


@pytest.mark.parametrize("what", ["fault", "daemon", "target"])
def test_a_fault_fades_it_out(what: str) -> None:
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


@pytest.mark.fault("A19")
@pytest.mark.parametrize("index", [0x60B1, 0x60B2])
def test_another_masters_write_fades_it_out(index: int) -> None:
    write = struct.pack("<BHBi", 0x23, index, 0, 300)
    bench = switched_on()
    bench.inject(0x601, write)
    bench.run(140)
    assert bench.state.feed.mode is FeedMode.OFF
    cause = bench.state.feed.cause
    assert cause is not None
    assert (cause.code, cause.axis) == ("OffsetHijack", "X")
    other = machine.bench()
    other.settle()
    other.inject(0x601, write)
    other.run(3)
    assert other.alarms == []


def test_a_lost_target_is_bridged() -> None:
    bench = switched_on()
    bench.sync(nc=False)
    bench.run(30)
    assert bench.state.feed.mode is FeedMode.ON


def test_settings_keep_it() -> None:
    made = fed_settings()
    assert from_json(to_json(made)) == made
    assert {0x401, 0x402} <= made.sent_ids
    assert len(made.feeds) == 2


def mode_of(bench: Bench) -> FeedMode:
    return bench.state.feed.mode


def code_of(bench: Bench) -> str | None:
    cause = bench.state.feed.cause
    return None if cause is None else cause.code


def test_what_the_drives_show_is_what_was_sent() -> None:
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


def test_zeros_that_do_not_leave_are_none() -> None:
    bench = switched_on()
    bench.sync(Request("disarm"))
    before = bench.state.feed.applied
    assert before[0] != (0, 0)
    for _ in range(100):
        bench.sync(unsent=(0, 1))
    assert mode_of(bench) is FeedMode.OFF
    shown_status = status.document(bench.state, bench.settings, None, ())["feedforward"]
    assert shown_status["confirmed"] is False
    assert shown_status["cause"]["text"].endswith("(no zero was read back)")
    assert bench.state.feed.applied[0][0] > before[0][0] // 2
    bench.run(150)
    for wanted in (request(), arm_request()):
        refused = bench.sync(wanted).refused
        assert refused is not None
        assert Alarm("StaleOffset", detail="of speed or torque") in refused
    assert bench.sync(Request("adopt", True)).refused == ()
    assert mode_of(bench) is FeedMode.ZEROING
    bench.run(20)
    assert mode_of(bench) is FeedMode.OFF
    assert not bench.state.feed.may_stand
    assert status.document(bench.state, bench.settings, None, ())["feedforward"]["confirmed"] is True


def test_an_axis_whose_zeros_stay_behind_is_waited_for() -> None:
    bench = switched_on()
    bench.main_alive = False
    bench.silence()
    for _ in range(10):
        bench.sync(unsent=(1,))
    assert mode_of(bench) is FeedMode.ZEROING
    bench.run(10)
    assert mode_of(bench) is FeedMode.OFF
    assert not bench.state.feed.may_stand


def test_a_mismatch_that_ended_at_zero_is_over() -> None:
    bench = switched_on(shown=True)
    bench.drives[1].takes_fed = lambda pair: (pair[0], -pair[1])
    bench.run(200)
    assert (mode_of(bench), code_of(bench)) == (FeedMode.OFF, "EchoMismatch")
    assert not bench.state.feed.may_stand


@pytest.mark.usefixtures("real_time")
def test_a_guard_that_ends_over_a_torque_says_so(tmp_path: Path) -> None:
    with closing(Shop(tmp_path, commissioned(fed_settings()))) as shop:
        client = shop.connect()
        shop.run(150)
        laws = dict.fromkeys("XY", LAW._asdict())
        assert shop.ask(client, {"request": "feedforward", "token": TOKEN, "laws": laws, "facts": FACTS})["ok"]
        shop.playing = True
        shop.run(150)
        shop.wire.down = True
        shop.wire.feed([])
        shop.turn()
        for _ in range(100):
            shop.guard._last_sync_s -= 20
            shop.guard._stepped_s -= 1
            shop.turn()
        assert shop.guard.status()["feedforward"]["confirmed"] is False
        shop.stop.send(b"x")
        assert shop.guard.run() == 3
        events = [event for event in shop.events() if event["event"] in ("feedforward", "stopped")][-2:]
        assert events[0]["text"].startswith("speed and torque offsets may still be applied; hold the feed")
        assert events[1]["text"].startswith(
            "the guard has stopped; speed and torque offsets may still be applied; hold"
        )


def test_a_drive_that_holds_a_torque_at_start_gets_zeros() -> None:
    bench = fed_bench(shown=True)
    bench.drives[1].fed = (0, -25)
    bench.settle()
    assert bench.drives[1].fed == (0, 0)
    assert {output.feed for output in bench.outputs} == {None, ((0, 0), (0, 0))}
    assert (bench.mode, bench.state.feed.mode) == (Mode.OFF, FeedMode.OFF)
    assert bench.sync(request()).refused == ()


def test_one_mapped_object_is_enough_to_compare() -> None:
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
    """The check uses other formulas than the computation: InternalError, zeros, off."""
    bench = switched_on()
    broken = bench.state.feed._replace(sent=(((LIMITS.speed + 5_000, 0), (0, 0)), *bench.state.feed.sent[1:]))
    bench.state = bench.state._replace(feed=broken)
    assert bench.sync().feed == ((0, 0), (0, 0))
    bench.run(10)
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.OFF, "InternalError")
    cause = bench.state.feed.cause
    assert cause is not None
    assert cause.detail.startswith("feed-forward ((45000, 0), (0, 0)) -> ((4")


def test_a_change_is_told_in_the_cycle_in_which_it_happens() -> None:
    bench = switched_on()
    bench.sync(Request("disarm"))
    bench.run(120)
    result = [output.feed_transition for output in bench.outputs if output.feed_transition is not None]
    assert result == [(FeedMode.OFF, FeedMode.ON), (FeedMode.ON, FeedMode.ENDING), (FeedMode.ENDING, FeedMode.OFF)]
    bench = switched_on()
    bench.silence()
    assert bench.outputs[-1].feed_transition == (FeedMode.ON, FeedMode.ZEROING)


@pytest.mark.parametrize("sync", [True, False])
def test_where_nothing_can_be_sent_what_was_sent_last_stays_in_force(sync: bool) -> None:
    bench = switched_on()
    before = bench.state.feed._replace(sent=tuple([((k, 0), (0, k)) for k in range(4)]))
    bench.state = bench.state._replace(feed=before)
    inputs = Inputs(sync, (AxisInput(target=1), AxisInput(target=2)), BusView(), late=sync)
    state, output = go_on(bench.state, inputs, (), bench.settings, Output())
    assert output == Output()
    assert state.feed.sent == ((before.applied, *before.sent[:-1]) if sync else before.sent)


def test_what_acts_cannot_be_adopted() -> None:
    bench = switched_on(shown=True)
    for mode in (FeedMode.ON, FeedMode.ENDING):
        refused = bench.sync(Request("adopt", True)).refused
        assert refused is not None
        assert [alarm.code for alarm in refused] == ["NotOff"]
        assert (bench.mode, mode_of(bench)) == (Mode.OFF, mode)
        bench.sync(Request("disarm"))


def test_a_whole_table_waits_while_it_sends(tmp_path: Path) -> None:
    """Checking a long table would delay its frames."""
    allowed = {mode: _answer_to_a_table(tmp_path / mode.value, mode)["ok"] for mode in FeedMode}
    assert allowed == {mode: mode is FeedMode.OFF for mode in FeedMode}


def _answer_to_a_table(folder: Path, mode: FeedMode) -> dict[str, Any]:
    folder.mkdir()
    made = replace(fed_settings(), run_directory=str(folder))
    zeros = {axis.name: [0] * 50 for axis in made.axes}
    here, there = socket.socketpair()
    with here, there, (folder / "journal").open("wb") as lines:
        intake = Intake(made, Journal(lines.fileno()))
        state = initial(made)
        state = state._replace(feed=armed((LAW, LAW))._replace(mode=mode))
        closer = Closer()
        sealed = table.seal(table.encode(list(zeros), zeros, zeros, "digest"))
        intake.begin(Client(here, 0.0, closer, OWNER, descriptor=sealed), {}, state)
        intake.check(state)
        closer.end()
        return dict(json.loads(there.recv(10_000)))
