"""Every class of notice has its effect and next action in exactly one table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import fdhil
from fdhil.daemon.alarms import CONDITIONS
from fdhil.daemon.notice_words import WORDS, words_of
from fdhil.drivers.can import error_frames
from fdhil.guard.interlocks import CATALOGUE, EFFECT, Alarm, Reaction
from fdhil.records import Notice

CALLED = re.compile(r'\b(?:Notice|_notice|_tell)\(\s*"([^"]*)"')


def codes() -> set[str]:
    found = {"BusOff", "BusRestarted", "TransceiverFault", "NotAcknowledged", "ErrorPassive", "NcSilent", "LoadChanged"}
    for path in Path(fdhil.__file__).parent.rglob("*.py"):
        found.update(CALLED.findall(path.read_text("utf-8")))
    return found


@pytest.mark.parametrize("code", sorted(codes()))
def test_a_class_of_notice_has_effect_and_action(code: str) -> None:
    effect, action = words_of(Notice(code, "minor", "why"))
    assert effect
    assert action
    assert not effect.endswith(".")
    assert not action.endswith(".")


def test_what_the_guard_stopped_has_the_guards_own_words() -> None:
    alarm = Alarm("EchoMismatch", "X")
    notices = words_of(Notice("GuardTripped", "MAJOR", f"EchoMismatch: {alarm.sentence()}", "X"))
    assert notices == (EFFECT[Reaction.RAMP_DOWN], CATALOGUE["EchoMismatch"][2])


def test_what_a_late_pc_caused_has_the_action_against_a_late_pc() -> None:
    alarm = Alarm("LimitActive", "X", late="this PC was late (37 offsets, worst 9.0 ms)")
    _, action = words_of(Notice("GuardTripped", "MAJOR", f"LimitActive: {alarm.cause}", "X"))
    assert action == CATALOGUE["PcLate"][2] == alarm.action
    assert action != CATALOGUE["LimitActive"][2]


def test_a_refusal_has_the_action_of_its_cause_and_no_effect_on_a_machine_that_was_not_corrected() -> None:
    effect, action = words_of(Notice("ArmRefused", "minor", "ModelStale: the model is 11 h old"))
    assert (effect, action) == (WORDS["ArmRefused"][0], CATALOGUE["ModelStale"][2])


def test_what_the_daemon_hears_too_tells_the_guards_effect_for_a_correction_that_runs() -> None:
    effect, action = words_of(Notice("SyncLost", "MAJOR", "SYNC stopped, nothing is sampled; start the NC."))
    assert effect == f"while a correction runs: {EFFECT[CATALOGUE['SyncLost'][0]]}"
    assert action == CATALOGUE["SyncLost"][2]


def test_no_class_has_words_in_two_places() -> None:
    assert set(WORDS) & set(CATALOGUE) == {"CorruptFile"}  # the guard's is a table, the daemon's its history


def test_a_class_that_is_not_known_is_left_to_its_text() -> None:
    assert words_of(Notice("Unheard", "minor", "why")) == ("", "")


NEWS = {"Armed", "BlackBox", "CoarseStamps", "PassMeasured", "StoreRecovered"}
ENDED = re.compile(r'Notice\(\s*"([^"]*)",\s*"info"')


def test_classes_whose_end_is_reported_are_conditions() -> None:
    texts = [path.read_text("utf-8") for path in Path(fdhil.__file__).parent.rglob("*.py")]
    ended = {code for text in texts for code in ENDED.findall(text)} | set(error_frames._RECOVERED)
    assert len(ended) > len(NEWS)
    assert ended - NEWS <= CONDITIONS
    assert {*WORDS, *CATALOGUE, "ReadOnlyStore"} >= CONDITIONS
