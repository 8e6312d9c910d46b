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

from fdhil.guard import correction_table, guard_status
from fdhil.guard.event_journal import EventJournal
from fdhil.guard.feedforward_law import Pair, arm_feedforward, violates_limits
from fdhil.guard.feedforward_step import step_feedforward
from fdhil.guard.guard_protocol import FeedMode, Mode
from fdhil.guard.guard_settings import Pdo, decode_settings, encode_settings
from fdhil.guard.guard_socket import DescriptorCloser, GuardSocketClient
from fdhil.guard.guard_state import AxisInput, BusView, GuardRequest, StepInputs, StepOutput, make_initial_state
from fdhil.guard.interlocks import FEEDFORWARD_FACTS, Alarm
from fdhil.guard.table_intake import TableIntake
from tests.guard import simulated_bus
from tests.guard.feedforward_machine import FACTS, LAW, LIMITS, fed_bench, fed_settings, request, switched_on
from tests.guard.guard_rig import OWNER, TOKEN, GuardRig
from tests.guard.simulated_bus import Bench, arm_request, commissioned


def test_feedforward_sends_nothing_until_requested() -> None:
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
def test_feedforward_is_refused_for_each_failing_condition(changes: dict[str, Any], code: str) -> None:
    bench = fed_bench()
    bench.settle()
    refused = bench.run_sync(request(**changes)).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == [code]
    assert bench.state.feed.mode is FeedMode.OFF


def test_feedforward_and_position_offset_are_never_active_together() -> None:
    bench = switched_on()
    refused = bench.run_sync(arm_request()).refused
    assert refused is not None
    assert "NotOff" in {alarm.code for alarm in refused}
    other = simulated_bus.bench()
    other = Bench(fed_settings(), other.path, other.demand, other.drives)
    other.settle()
    assert other.arm() == ()
    refused = other.run_sync(request()).refused
    assert refused is not None
    assert "NotOff" in {alarm.code for alarm in refused}


def test_feedforward_is_refused_without_its_config_section() -> None:
    bench = simulated_bus.bench()
    bench.settle()
    refused = bench.run_sync(request()).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == ["FeedforwardOff"]


def test_disarm_fades_the_feedforward_to_zero() -> None:
    bench = switched_on()
    bench.run_sync(GuardRequest("disarm"))
    bench.run(120)
    assert bench.state.feed.mode is FeedMode.OFF
    assert bench.outputs[-1].feed is None
    last = [output.feed for output in bench.outputs if output.feed is not None][-3:]
    assert last == [((0, 0), (0, 0))] * 3
    cause = bench.state.feed.cause
    assert cause is not None
    assert cause.code == "Disarmed"


def test_sync_loss_zeroes_the_feedforward_at_once() -> None:
    bench = switched_on()
    assert bench.silence().feed == ((0, 0), (0, 0))
    for _ in range(5):
        bench.silence()
    assert bench.state.feed.mode is FeedMode.OFF
    assert bench.state.mode is Mode.OFF


@pytest.mark.parametrize("what", ["fault", "daemon", "target"])
def test_fault_fades_out_the_feedforward(what: str) -> None:
    bench = switched_on()
    if what == "fault":
        bench.drives[0].statusword = 0x0218
    elif what == "daemon":
        bench.main_alive = False
    for _ in range(140):
        bench.run_sync(nc=what != "target")
    assert bench.state.feed.mode is FeedMode.OFF
    cause = bench.state.feed.cause
    assert cause is not None
    assert cause.code == {"fault": "DriveNotEnabled", "daemon": "MainLost", "target": "TargetLost"}[what]


@pytest.mark.fault("A19")
@pytest.mark.parametrize("index", [0x60B1, 0x60B2])
def test_foreign_write_fades_out_the_feedforward(index: int) -> None:
    write = struct.pack("<BHBi", 0x23, index, 0, 300)
    bench = switched_on()
    bench.inject_frame(0x601, write)
    bench.run(140)
    assert bench.state.feed.mode is FeedMode.OFF
    cause = bench.state.feed.cause
    assert cause is not None
    assert (cause.code, cause.axis) == ("OffsetHijack", "X")
    other = simulated_bus.bench()
    other.settle()
    other.inject_frame(0x601, write)
    other.run(3)
    assert other.alarms == []


def test_lost_target_is_bridged() -> None:
    bench = switched_on()
    bench.run_sync(nc=False)
    bench.run(30)
    assert bench.state.feed.mode is FeedMode.ON


def test_feedforward_settings_survive_the_file() -> None:
    made = fed_settings()
    assert decode_settings(encode_settings(made)) == made
    assert {0x401, 0x402} <= made.sent_ids
    assert len(made.feeds) == 2


def mode_of(bench: Bench) -> FeedMode:
    return bench.state.feed.mode


def code_of(bench: Bench) -> str | None:
    cause = bench.state.feed.cause
    return None if cause is None else cause.code


def test_read_back_matches_the_sent_pair() -> None:
    bench = switched_on(shown=True)
    for k in range(200):
        bench.run_sync(late=k % 20 == 5)
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
def test_read_back_mismatch_ends_the_feedforward(takes: Callable[[Pair], Pair]) -> None:
    bench = switched_on(shown=True)
    bench.drives[1].takes_fed = takes
    bench.run(4)
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.ENDING, "EchoMismatch")
    bench.run(200)
    assert mode_of(bench) is FeedMode.OFF
    assert bench.drives[0].fed == (0, 0)


def test_one_wrong_reading_is_tolerated() -> None:
    bench = switched_on(shown=True)
    bench.drives[0].takes_fed = lambda pair: (pair[0] + 7, pair[1])
    bench.run_sync()
    bench.drives[0].takes_fed = lambda pair: pair
    bench.run(50)
    assert mode_of(bench) is FeedMode.ON


def test_drive_that_keeps_its_torque_offset_is_reported() -> None:
    bench = switched_on(shown=True)
    bench.drives[0].takes_fed = lambda _pair: (0, 40)
    bench.run(140)
    assert mode_of(bench) is FeedMode.ENDING
    assert bench.outputs[-1].feed == ((0, 0), (0, 0))
    bench.run(80)
    assert mode_of(bench) is FeedMode.OFF
    assert bench.state.feed.cause == Alarm("EchoMismatch", detail="no zero was read back")
    for wanted in (request(), arm_request()):
        refused = bench.run_sync(wanted).refused
        assert refused is not None
        assert "StaleOffset" in {alarm.code for alarm in refused}
    bench.drives[0].takes_fed = lambda pair: pair
    assert bench.run_sync(GuardRequest("adopt", True)).refused == ()
    bench.run(20)
    assert bench.drives[0].fed == (0, 0)
    assert (bench.mode, bench.state.feed.mode) == (Mode.OFF, FeedMode.OFF)


def test_unsent_zeros_do_not_count() -> None:
    bench = switched_on()
    bench.run_sync(GuardRequest("disarm"))
    before = bench.state.feed.applied
    assert before[0] != (0, 0)
    for _ in range(100):
        bench.run_sync(unsent=(0, 1))
    assert mode_of(bench) is FeedMode.OFF
    shown_status = guard_status.build_status_document(bench.state, bench.settings, None, ())["feedforward"]
    assert shown_status["confirmed"] is False
    assert shown_status["cause"]["text"].endswith("(no zero was read back)")
    assert bench.state.feed.applied[0][0] > before[0][0] // 2
    bench.run(150)
    for wanted in (request(), arm_request()):
        refused = bench.run_sync(wanted).refused
        assert refused is not None
        assert Alarm("StaleOffset", detail="of speed or torque") in refused
    assert bench.run_sync(GuardRequest("adopt", True)).refused == ()
    assert mode_of(bench) is FeedMode.ZEROING
    bench.run(20)
    assert mode_of(bench) is FeedMode.OFF
    assert not bench.state.feed.may_stand
    assert guard_status.build_status_document(bench.state, bench.settings, None, ())["feedforward"]["confirmed"] is True


def test_feedforward_waits_for_the_last_axis_to_show_zero() -> None:
    bench = switched_on()
    bench.main_alive = False
    bench.silence()
    for _ in range(10):
        bench.run_sync(unsent=(1,))
    assert mode_of(bench) is FeedMode.ZEROING
    bench.run(10)
    assert mode_of(bench) is FeedMode.OFF
    assert not bench.state.feed.may_stand


def test_mismatch_ends_when_zero_is_shown() -> None:
    bench = switched_on(shown=True)
    bench.drives[1].takes_fed = lambda pair: (pair[0], -pair[1])
    bench.run(200)
    assert (mode_of(bench), code_of(bench)) == (FeedMode.OFF, "EchoMismatch")
    assert not bench.state.feed.may_stand


@pytest.mark.usefixtures("real_time")
def test_guard_that_exits_with_a_torque_offset_reports_it(tmp_path: Path) -> None:
    with closing(GuardRig(tmp_path, commissioned(fed_settings()))) as shop:
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
        assert shop.guard.build_status()["feedforward"]["confirmed"] is False
        shop.stop.send(b"x")
        assert shop.guard.run() == 3
        events = [event for event in shop.events() if event["event"] in ("feedforward", "stopped")][-2:]
        assert events[0]["text"].startswith("speed and torque offsets may still be applied; hold the feed")
        assert events[1]["text"].startswith(
            "the guard has stopped; speed and torque offsets may still be applied; hold"
        )


def test_drive_with_a_torque_offset_at_start_gets_zeros() -> None:
    bench = fed_bench(shown=True)
    bench.drives[1].fed = (0, -25)
    bench.settle()
    assert bench.drives[1].fed == (0, 0)
    assert {output.feed for output in bench.outputs} == {None, ((0, 0), (0, 0))}
    assert (bench.mode, bench.state.feed.mode) == (Mode.OFF, FeedMode.OFF)
    assert bench.run_sync(request()).refused == ()


def test_one_mapped_object_is_enough_for_the_comparison() -> None:
    bench = fed_bench(shown=True)
    layout = ((0x2000, 0, 32, True), (0x60B2, 0, 16, True))
    axes = [replace(a, tpdos=(*a.tpdos[:-1], Pdo(0x1A0 + a.node_id, layout))) for a in bench.settings.axes]
    bench = Bench(replace(bench.settings, axes=tuple(axes)), None, bench.demand, bench.drives)
    bench.settle()
    assert bench.run_sync(request()).refused == ()
    bench.play()
    bench.run(200)
    assert mode_of(bench) is FeedMode.ON
    bench.drives[0].takes_fed = lambda pair: (pair[0], pair[1] + 1)
    bench.run(4)
    assert code_of(bench) == "EchoMismatch"


def test_feed_hold_takes_the_feedforward_to_zero() -> None:
    bench = switched_on()
    bench.rest = bench.targets()
    bench.run(60)
    assert bench.outputs[-1].feed == ((0, 0), (0, 0))
    sent = [output.feed for output in bench.outputs if output.feed is not None]
    for before, after in pairwise(sent):
        assert not any(violates_limits(LIMITS, *way) for way in zip(before, after, strict=True))
    assert mode_of(bench) is FeedMode.ON


@pytest.mark.parametrize("what", ["bus off", "reboot", "not operational"])
def test_bus_or_drive_stop_zeroes_the_feedforward_at_once(what: str) -> None:
    bench = switched_on()
    if what == "bus off":
        bench.listener.set_controller_state("off")
    elif what == "reboot":
        bench.receive_frames(0x701, b"\0")
    else:
        bench.receive_frames(0x701, b"\x7f")
    assert bench.run_sync().feed == ((0, 0), (0, 0))
    bench.run(10)
    assert bench.outputs[-1].feed is None
    code = {"bus off": "BusOff", "reboot": "NodeRebooted", "not operational": "NmtStateWrong"}[what]
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.OFF, code)


def test_feedforward_beyond_its_limits_is_limited_and_counted() -> None:
    bench = fed_bench()
    bench.settle()
    assert bench.run_sync(request()).refused == ()
    bench.run(120)
    assert bench.state.feed.limited == 0
    bench.play()
    bench.run(150)
    assert bench.state.feed.limited > 10
    sent = [output.feed for output in bench.outputs if output.feed is not None]
    assert max(abs(pair[0]) for pairs in sent for pair in pairs) == LIMITS.speed


def test_corrupt_state_sends_zeros() -> None:
    """The check uses other formulas than the computation: InternalError, zeros, off."""
    bench = switched_on()
    broken = bench.state.feed._replace(sent=(((LIMITS.speed + 5_000, 0), (0, 0)), *bench.state.feed.sent[1:]))
    bench.state = bench.state._replace(feed=broken)
    assert bench.run_sync().feed == ((0, 0), (0, 0))
    bench.run(10)
    assert (bench.state.feed.mode, code_of(bench)) == (FeedMode.OFF, "InternalError")
    cause = bench.state.feed.cause
    assert cause is not None
    assert cause.detail.startswith("feed-forward ((45000, 0), (0, 0)) -> ((4")


def test_transition_is_reported_in_its_own_cycle() -> None:
    bench = switched_on()
    bench.run_sync(GuardRequest("disarm"))
    bench.run(120)
    result = [output.feed_transition for output in bench.outputs if output.feed_transition is not None]
    assert result == [(FeedMode.OFF, FeedMode.ON), (FeedMode.ON, FeedMode.ENDING), (FeedMode.ENDING, FeedMode.OFF)]
    bench = switched_on()
    bench.silence()
    assert bench.outputs[-1].feed_transition == (FeedMode.ON, FeedMode.ZEROING)


@pytest.mark.parametrize("sync", [True, False])
def test_last_pair_stays_in_force_while_nothing_can_be_sent(sync: bool) -> None:
    bench = switched_on()
    before = bench.state.feed._replace(sent=tuple([((k, 0), (0, k)) for k in range(4)]))
    bench.state = bench.state._replace(feed=before)
    inputs = StepInputs(sync, (AxisInput(target=1), AxisInput(target=2)), BusView(), late=sync)
    state, output = step_feedforward(bench.state, inputs, (), bench.settings, StepOutput())
    assert output == StepOutput()
    assert state.feed.sent == ((before.applied, *before.sent[:-1]) if sync else before.sent)


def test_adopt_is_refused_while_the_feedforward_acts() -> None:
    bench = switched_on(shown=True)
    for mode in (FeedMode.ON, FeedMode.ENDING):
        refused = bench.run_sync(GuardRequest("adopt", True)).refused
        assert refused is not None
        assert [alarm.code for alarm in refused] == ["NotOff"]
        assert (bench.mode, mode_of(bench)) == (Mode.OFF, mode)
        bench.run_sync(GuardRequest("disarm"))


def test_whole_table_is_refused_while_the_feedforward_sends(tmp_path: Path) -> None:
    """Checking a long table would delay its frames."""
    allowed = {mode: _answer_to_a_table(tmp_path / mode.value, mode)["ok"] for mode in FeedMode}
    assert allowed == {mode: mode is FeedMode.OFF for mode in FeedMode}


def _answer_to_a_table(folder: Path, mode: FeedMode) -> dict[str, Any]:
    folder.mkdir()
    made = replace(fed_settings(), run_directory=str(folder))
    zeros = {axis.name: [0] * 50 for axis in made.axes}
    here, there = socket.socketpair()
    with here, there, (folder / "journal").open("wb") as lines:
        intake = TableIntake(made, EventJournal(lines.fileno()))
        state = make_initial_state(made)
        state = state._replace(feed=arm_feedforward((LAW, LAW))._replace(mode=mode))
        closer = DescriptorCloser()
        sealed = correction_table.seal_table(correction_table.encode_table(list(zeros), zeros, zeros, "digest"))
        intake.begin_table(GuardSocketClient(here, 0.0, closer, OWNER, descriptor=sealed), {}, state)
        intake.check_next_rows(state)
        closer.finish_closing()
        return dict(json.loads(there.recv(10_000)))
