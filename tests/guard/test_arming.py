"""OFF to ARMED is impossible unless every interlock, every fact, the token, the table and the time agree."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from fdhil.arming.guard_client import ANSWER_S
from fdhil.guard import guard_step
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import AxisInput, AxisState, BusView, StepInputs
from fdhil.guard.interlock_checks import (
    AXIS_INTERLOCKS,
    BUS_INTERLOCKS,
    View,
    list_arming_obstacles,
    list_failing_interlocks,
)
from fdhil.guard.interlocks import FACTS, INTERLOCK_CATALOGUE, Alarm, Reaction
from tests.guard.feedforward_machine import fed_bench
from tests.guard.feedforward_machine import request as feedforward
from tests.guard.simulated_bus import DIGEST, FACTS_GIVEN, Bench, arm_request, axis_settings, bench
from tests.guard.simulated_bus import settings as machine_settings

Change = Callable[[AxisInput], AxisInput]
# one change per interlock, that breaks it and no other
AXIS_CHANGES: dict[str, Change] = {
    "StaleData": lambda axis: axis._replace(feedback_age=4.0),
    "NmtStateWrong": lambda axis: axis._replace(nmt=4),
    "HeartbeatLost": lambda axis: axis._replace(heartbeat_age_s=0.6),
    "NotFollowing": lambda axis: axis._replace(statusword=(axis.statusword or 0) & ~0x1000),
    "LimitActive": lambda axis: axis._replace(statusword=(axis.statusword or 0) | 0x0800),
    "FollowingError": lambda axis: axis._replace(statusword=(axis.statusword or 0) | 0x2000),
    "DriveNotEnabled": lambda axis: axis._replace(statusword=(axis.statusword or 0) & ~0x0004),
    "NotCsp": lambda axis: axis._replace(mode=1),
    "ReadBackStale": lambda axis: axis._replace(read_back=None, read_back_age=3),
    "PdoLength": lambda axis: axis._replace(short_frames=3),
    "TargetLost": lambda axis: axis._replace(target=None),
}
BUS_CHANGES: dict[str, dict[str, Any]] = {
    "BusDown": {"state": "down"},
    "SyncJitter": {"sync_regular": False},
    "RxOverflow": {"lost_frames": 1},
}


def test_arming_is_refused_for_each_missing_fact() -> None:
    machine, fed = bench(), fed_bench()
    machine.settle()
    fed.settle()
    refused = machine.run_sync(arm_request(facts={})).refused
    assert [alarm.code for alarm in refused or ()] == [
        *("NotCommissioned", "FeedforwardUnknown", "ModelNotValidated", "ModelStale"),
        *("PoorSkill", "HarmPredicted", "ReadOnlyStore", "WatchdogNotArmed"),
    ]
    refused = fed.run_sync(feedforward(facts={})).refused
    assert [alarm.code for alarm in refused or ()] == [
        *("NotCommissioned", "FeedforwardOff", "ModelNotValidated"),
        *("ModelStale", "ReadOnlyStore", "WatchdogNotArmed"),
    ]


@pytest.fixture(scope="module")
def settled_machine() -> tuple[Bench, StepInputs]:
    machine = bench(axes=("X",))
    axes = tuple(replace(axis, heartbeat_timeout_s=0.5) for axis in machine.settings.axes)
    machine.settings = replace(machine.settings, axes=axes)
    machine.listener.settings = machine.settings
    for _ in range(150):
        machine.receive_frames(0x701, b"\x05")
        machine.run_sync()
    machine.receive_frames(0x701, b"\x05")
    seen, bus = machine.listener.receive_at_sync(bytes([machine.counter + 1]), 0.151, 0.151)
    return machine, StepInputs(True, seen, bus, path=machine.path)


def refusals(machine: Bench, inputs: StepInputs) -> set[str]:
    state, output = guard_step.step_guard(machine.state, inputs, machine.settings)
    assert output.refused is not None
    assert (state.mode is Mode.ARMED) is (output.refused == ())
    assert (output.offsets is None) is (state.mode is not Mode.ARMED)
    return {alarm.code for alarm in output.refused}


def test_guard_arms_when_all_interlocks_pass(settled_machine: tuple[Bench, StepInputs]) -> None:
    machine, inputs = settled_machine
    assert refusals(machine, inputs._replace(request=arm_request())) == set()


def test_every_combination_of_facts_gives_its_refusals(settled_machine: tuple[Bench, StepInputs]) -> None:
    machine, inputs = settled_machine
    others = ("AuthRequired", "MainLost", "ProgramMismatch")
    for vector in itertools.product((True, False), repeat=len(FACTS) + len(others)):
        facts = dict(zip(FACTS, vector, strict=False))
        token, daemon, table = vector[len(FACTS) :]
        request = arm_request(facts=facts, token_valid=token)
        changed = inputs._replace(request=request, main_alive=daemon, path=machine.path if table else None)
        expected = {FACTS[fact] for fact, good in facts.items() if not good}
        expected |= {code for code, good in zip(others, (token, daemon, table), strict=True) if not good}
        assert refusals(machine, changed) == expected


@pytest.mark.usefixtures("long_computation")
def test_every_combination_of_interlocks_gives_its_refusals(settled_machine: tuple[Bench, StepInputs]) -> None:
    machine, inputs = settled_machine
    codes = [*AXIS_CHANGES, *BUS_CHANGES]
    for vector in itertools.product((True, False), repeat=len(codes)):
        axis, bus = inputs.axes[0], inputs.bus
        broken = {code for code, good in zip(codes, vector, strict=True) if not good}
        for code in broken & AXIS_CHANGES.keys():
            axis = AXIS_CHANGES[code](axis)
        for code in broken & BUS_CHANGES.keys():
            bus = bus._replace(**BUS_CHANGES[code])
        answer = refusals(machine, inputs._replace(axes=(axis,), bus=bus, request=arm_request()))
        assert broken <= answer
        assert bool(answer) is bool(broken)


@pytest.mark.parametrize("value", [None, 1, "true", 0, [], {"commissioned": True}])
def test_only_a_literal_true_attests_a_fact(settled_machine: tuple[Bench, StepInputs], value: object) -> None:
    machine, inputs = settled_machine
    facts = {**FACTS_GIVEN, "commissioned": value}
    assert refusals(machine, inputs._replace(request=arm_request(facts=facts))) == {"NotCommissioned"}


@pytest.mark.parametrize("digest", ["", "another"])
@pytest.mark.fault("E5")
def test_arming_is_refused_for_another_program(settled_machine: tuple[Bench, StepInputs], digest: str) -> None:
    machine, inputs = settled_machine
    assert digest != DIGEST
    assert refusals(machine, inputs._replace(request=arm_request(program_digest=digest))) == {"ProgramMismatch"}


def test_arming_is_refused_before_a_hundred_good_cycles() -> None:
    machine = bench()
    machine.settle(30)
    machine.drives[0].mode = 1
    machine.settle(11)
    machine.drives[0].mode = 8
    machine.run_until(Mode.OFF)
    while machine.state.good_for == 0:
        machine.run_sync()
    for _ in range(98):
        assert {alarm.code for alarm in machine.arm()} == {"NotSettled"}
    assert machine.arm() == ()


@pytest.mark.fault("F21")
def test_guard_arms_neither_twice_nor_by_itself() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    assert {alarm.code for alarm in machine.arm()} == {"NotOff"}
    machine.drives[0].statusword = 0x0008
    machine.run_until(Mode.OFF)
    machine.drives[0].statusword = 0x1237
    machine.settle(400)
    assert machine.mode is Mode.OFF
    assert machine.arm() == ()


GOOD: View = (
    replace(axis_settings("X", 1), heartbeat_timeout_s=0.5),
    AxisInput(target=0, statusword=0x1237, mode=8, nmt=5, feedback_age=1, heartbeat_age_s=0.0, read_back_age=1),
    AxisState(following_error=0.0, read_back=0, readings=3),
)


def changed(change: dict[str, Any]) -> View:
    own, seen, axis = GOOD
    ((name, value),) = change.items()
    if name in AxisState._fields:
        axis = axis._replace(**change)
    elif name in AxisInput._fields:
        seen = seen._replace(**change)
    else:
        own = replace(own, **{name: value})
    return own, seen, axis


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"feedback_age": float("nan")}, "StaleData"),
        ({"feedback_age": float("inf")}, "StaleData"),
        ({"feedback_age": 2}, "FeedbackGap"),
        ({"following_error": float("nan")}, "FollowingError"),
        ({"following_error": float("inf")}, "FollowingError"),
        ({"following_error": -16385.0}, "FollowingError"),
        ({"heartbeat_age_s": float("nan")}, "HeartbeatLost"),
        ({"heartbeat_age_s": 0.501}, "HeartbeatLost"),
        ({"statusword": None}, "DriveNotEnabled"),
        ({"mode": None}, "NotCsp"),
        ({"read_back_age": float("nan")}, "ReadBackStale"),
        ({"read_back_age": float("inf")}, "ReadBackStale"),
        ({"read_back_age": 3}, "ReadBackStale"),
        ({"nmt": 0}, "NmtStateWrong"),
        ({"echo_misses": 2}, "EchoMismatch"),
        ({"feed_misses": 2}, "EchoMismatch"),
        ({"target": None}, "TargetLost"),
        ({"short_frames": 3}, "PdoLength"),
    ],
)
def test_unknown_inputs_fail_every_interlock(change: dict[str, Any], code: str) -> None:
    bus = BusView(sync_regular=True, silent=False)
    assert list_failing_interlocks(bus, (GOOD,)) == ()
    bad = list_failing_interlocks(bus, (changed(change),))
    assert code in {alarm.code for alarm in bad}


def test_every_combination_of_axis_inputs_gives_its_alarms() -> None:
    own, seen, axis = GOOD
    bus = BusView(sync_regular=True, silent=False)
    bits = {"DriveNotEnabled": -0x0004, "NotFollowing": -0x1000, "LimitActive": 0x0800, "FollowingError": 0x2000}
    shown: dict[str, dict[str, Any]] = {
        "HeartbeatLost": {"heartbeat_age_s": 1.0},
        "NmtStateWrong": {"nmt": 4},
        "NotCsp": {"mode": 1},
    }
    shown |= {"ReadBackStale": {"read_back_age": 3}, "PdoLength": {"short_frames": 3}, "TargetLost": {"target": None}}
    kept: dict[str, dict[str, Any]] = {"EchoMismatch": {"echo_misses": 2}, "Implausible": {"implausible": 2}}
    kept["OffsetHijack"] = {"foreign": True}
    feedback: list[tuple[float, set[str]]] = [(1, set()), (2, {"FeedbackGap"}), (4, {"FeedbackGap", "StaleData"})]
    names = [*bits, *shown, *kept]
    assert {*names, "FeedbackGap", "StaleData"} == {code for code, _ in AXIS_INTERLOCKS}
    for (age, stale), vector in itertools.product(feedback, itertools.product((True, False), repeat=len(names))):
        broken = {name for name, good in zip(names, vector, strict=True) if not good}
        word = 0x1237
        for bit in [bits[name] for name in broken & bits.keys()]:
            word = word | bit if bit > 0 else word & ~-bit
        now = seen._replace(feedback_age=age, statusword=word)
        for name in broken & shown.keys():
            now = now._replace(**shown[name])
        remembered = axis
        for name in broken & kept.keys():
            remembered = remembered._replace(**kept[name])
        assert {alarm.code for alarm in list_failing_interlocks(bus, ((own, now, remembered),))} == broken | stale


def test_every_combination_of_bus_inputs_gives_its_alarms() -> None:
    states = {"active": "", "warning": "", "passive": "ErrorPassive", "off": "BusOff", "down": "BusDown"}
    result = set()
    for state, regular, silent, lost in itertools.product(states, (True, False), (True, False), (0, 1)):
        expected = {states[state]} - {""} | ({"SyncLost"} if silent else set()) | ({"RxOverflow"} if lost else set())
        expected |= set() if regular else {"SyncJitter"}
        assert {
            alarm.code for alarm in list_failing_interlocks(BusView(state, regular, silent, lost), (GOOD,))
        } == expected
        result |= expected
    assert result == {code for code, _ in BUS_INTERLOCKS}


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"read_back": 5}, "StaleOffset"),
        ({"fed_back": (0, 3)}, "StaleOffset"),
        ({"readings": 2}, "ReadBackStale"),
        ({"record": ""}, "NotCommissioned"),
        ({"record_void": True}, "RecordVoid"),
        ({"long_frames": 1}, "PdoMapping"),
        ({"window": 4 * 819 - 1}, "LimitBeyondWindow"),
    ],
)
def test_conditions_that_only_forbid_arming(change: dict[str, Any], code: str) -> None:
    assert list_arming_obstacles((GOOD,)) == ()
    assert list_arming_obstacles((changed(change),)) == (Alarm(code, "X"),)


FREEZES = {"BusOff", "BusRestarted", "BusDown", "SyncLost", "NmtStateWrong", "NodeRebooted"}
FREEZES |= {"OffsetDoubtful", "InternalError"}
HOLDS = {"SyncJitter", "FeedbackGap", "TargetLost", "Misaligned", "OverrideChanged", "FeedHold"}
REFUSES = {"PdoMapping", "StaleOffset", "SoftwareLimit", "PositionRange", "CorruptFile", "TableBusy", "ProgramMismatch"}
REFUSES |= {"NotCommissioned", "RecordVoid", "FeedforwardUnknown", "FeedforwardOff", "ModelNotValidated"}
REFUSES |= {"HarmPredicted", "WatchdogNotArmed", "LimitBeyondWindow", "AuthRequired"}
REFUSES |= {"NotOff", "NotSettled", "GuardBusy", "DisarmedSince", "PcLate"}


def test_each_alarm_class_has_its_reaction() -> None:
    for reaction, codes in ((Reaction.FREEZE, FREEZES), (Reaction.HOLD, HOLDS), (Reaction.REFUSE, REFUSES)):
        assert {code for code in INTERLOCK_CATALOGUE if Alarm(code).reaction is reaction} == codes


def test_alarm_sentence_has_axis_cause_detail_effect_and_action() -> None:
    bare, full = Alarm("SyncLost"), Alarm("SyncLost", "X", "for 4 ms")
    assert bare.cause == "no SYNC is received"
    assert full.cause == "axis X: no SYNC is received (for 4 ms)"
    action = "hold the feed, restore the NC's SYNC, then adopt"
    frozen = "nothing can be sent: the last offset may still be applied"
    assert bare.sentence() == f"no SYNC is received; {frozen}; {action}"
    off = "the correction is off and nothing is applied"
    assert bare.sentence(off=True) == f"no SYNC is received; {off}; {action}"
    assert Alarm("NotOff", detail="FROZEN").action == "hold the feed, then run fdhil adopt"
    assert Alarm("NotOff", detail="ACTIVE").action == "disarm it first"
    assert Alarm("SyncLost", detail="FROZEN").action == action


@pytest.mark.parametrize("code", INTERLOCK_CATALOGUE)
def test_each_class_has_cause_effect_and_action(code: str) -> None:
    alarm = Alarm(code, "X", "detail")
    sentence = alarm.sentence()
    assert sentence.startswith("axis X: ")
    assert sentence.count("; ") >= 2
    assert alarm.action.strip()
    assert "\n" not in sentence
    assert isinstance(alarm.reaction, Reaction)


@pytest.mark.parametrize(
    "change",
    [
        {"feedback_age": 1.0},
        {"read_back_age": 2.0},
        {"heartbeat_age_s": 0.5},
        {"following_error": 16384.0},
        {"following_error": -16384.0},
        {"echo_misses": 1},
        {"feed_misses": 1},
        {"implausible": 1},
        {"short_frames": 2},
        {"nmt": None},
        {"fed_back": (None, 0)},
        {"window": 4 * 819},
    ],
)
def test_interlocks_pass_at_their_limits(change: dict[str, Any]) -> None:
    bus = BusView(sync_regular=True, silent=False)
    assert list_failing_interlocks(bus, (changed(change),)) == ()
    assert list_arming_obstacles((changed(change),)) == ()


@pytest.mark.parametrize(
    ("bus", "codes"),
    [
        (BusView(), {"SyncLost", "SyncJitter"}),
        (BusView("warning", True, False), set()),
        (BusView("down", True, False), {"BusDown"}),
        (BusView("off", True, False), {"BusOff"}),
        (BusView("passive", True, False), {"ErrorPassive"}),
        (BusView("active", False, False), {"SyncJitter"}),
        (BusView("active", True, True), {"SyncLost"}),
        (BusView("active", True, False, 1), {"RxOverflow"}),
    ],
)
def test_bus_alarms_alone_forbid_arming(bus: BusView, codes: set[str]) -> None:
    assert {alarm.code for alarm in list_failing_interlocks(bus, (GOOD,))} == codes


def test_feedback_three_cycles_old_is_a_gap_and_four_is_stale() -> None:
    bus = BusView(sync_regular=True, silent=False)
    assert {alarm.code for alarm in list_failing_interlocks(bus, (changed({"feedback_age": 3.0}),))} == {"FeedbackGap"}
    assert {alarm.code for alarm in list_failing_interlocks(bus, (changed({"feedback_age": 3.5}),))} == {
        "FeedbackGap",
        "StaleData",
    }


def test_client_waits_longer_than_the_guard_for_sync() -> None:
    """Otherwise arming without SYNC would look like a lost guard instead of a SyncLost refusal."""
    assert machine_settings(clock="sync").silence_s + 1 < ANSWER_S
