"""Every class of notice has its effect and next action in exactly one table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import fdhil
from fdhil.daemon.alarms import CONDITIONS
from fdhil.daemon.notice_texts import WORDS, get_effect_and_action
from fdhil.drivers.can import error_frames
from fdhil.guard.interlocks import INTERLOCK_CATALOGUE, REACTION_EFFECTS, Alarm, Reaction
from fdhil.records import Notice

CALLED = re.compile(r'\b(?:Notice|_notice|_tell)\(\s*"([^"]*)"')


def codes() -> set[str]:
    found = {"BusOff", "BusRestarted", "TransceiverFault", "NotAcknowledged", "ErrorPassive", "NcSilent", "LoadChanged"}
    for path in Path(fdhil.__file__).parent.rglob("*.py"):
        found.update(CALLED.findall(path.read_text("utf-8")))
    return found


@pytest.mark.parametrize("code", sorted(codes()))
def test_each_class_of_notice_has_effect_and_action(code: str) -> None:
    effect, action = get_effect_and_action(Notice(code, "minor", "why"))
    assert effect
    assert action
    assert not effect.endswith(".")
    assert not action.endswith(".")


def test_trip_of_the_guard_has_the_guards_texts() -> None:
    alarm = Alarm("EchoMismatch", "X")
    notices = get_effect_and_action(Notice("GuardTripped", "MAJOR", f"EchoMismatch: {alarm.sentence()}", "X"))
    assert notices == (REACTION_EFFECTS[Reaction.RAMP_DOWN], INTERLOCK_CATALOGUE["EchoMismatch"][2])


def test_trip_of_a_late_pc_advises_against_lateness() -> None:
    alarm = Alarm("LimitActive", "X", late="this PC was late (37 offsets, worst 9.0 ms)")
    _, action = get_effect_and_action(Notice("GuardTripped", "MAJOR", f"LimitActive: {alarm.cause}", "X"))
    assert action == INTERLOCK_CATALOGUE["PcLate"][2] == alarm.action
    assert action != INTERLOCK_CATALOGUE["LimitActive"][2]


def test_refusal_has_the_action_of_its_cause_and_no_effect() -> None:
    effect, action = get_effect_and_action(Notice("ArmRefused", "minor", "ModelStale: the model is 11 h old"))
    assert (effect, action) == (WORDS["ArmRefused"][0], INTERLOCK_CATALOGUE["ModelStale"][2])


def test_shared_class_has_the_guards_effect_on_a_running_correction() -> None:
    effect, action = get_effect_and_action(
        Notice("SyncLost", "MAJOR", "SYNC stopped, nothing is sampled; start the NC.")
    )
    assert effect == f"while a correction runs: {REACTION_EFFECTS[INTERLOCK_CATALOGUE['SyncLost'][0]]}"
    assert action == INTERLOCK_CATALOGUE["SyncLost"][2]


def test_no_class_has_texts_in_two_tables() -> None:
    assert set(WORDS) & set(INTERLOCK_CATALOGUE) == {"CorruptFile"}  # the guard's is a table, the daemon's its history


def test_unknown_class_keeps_its_own_text() -> None:
    assert get_effect_and_action(Notice("Unheard", "minor", "why")) == ("", "")


NEWS = {"Armed", "BlackBox", "CoarseStamps", "PassMeasured", "StoreRecovered"}
ENDED = re.compile(r'Notice\(\s*"([^"]*)",\s*"info"')


def test_classes_whose_end_is_reported_are_conditions() -> None:
    texts = [path.read_text("utf-8") for path in Path(fdhil.__file__).parent.rglob("*.py")]
    ended = {code for text in texts for code in ENDED.findall(text)} | set(error_frames._RECOVERED)
    assert len(ended) > len(NEWS)
    assert ended - NEWS <= CONDITIONS
    assert {*WORDS, *INTERLOCK_CATALOGUE, "ReadOnlyStore"} >= CONDITIONS
