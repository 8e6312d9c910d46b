"""Lateness of the guard: counted, reported as a cause, and refused above a stated share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest

from fdhil.guard.interlocks import Alarm
from fdhil.guard.turn_lateness import BINS_US, LEAST_TURNS, MOST_LATE, RECENT_S, TurnLateness
from tests.guard.feedforward_machine import FACTS, LAW
from tests.guard.guard_rig import TOKEN, GuardRig
from tests.guard.simulated_bus import DIGEST, FACTS_GIVEN, settings

MADE = replace(settings(), clock="monotonic")


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., GuardRig]]:
    made: list[GuardRig] = []

    def build(**changes: Any) -> GuardRig:
        made.append(GuardRig(tmp_path, **changes))
        return made[-1]

    yield build
    for shop in made:
        shop.close()


def test_turns_are_counted_in_a_histogram() -> None:
    turns = TurnLateness(MADE)
    for us in (15.0, 20.0, 21.0, 700.0, 60_000.0, -5.0, 2e12):
        turns.count_turn(us * 1e-6, False, 0.0)
    document = turns.build_lateness_document()
    assert (document["turns"], document["worst_us"]) == (7, 60_000)
    assert [top for top, _ in document["histogram_us"]] == [*BINS_US, None]
    assert {top: n for top, n in document["histogram_us"] if n} == {20: 4, 50: 1, 1000: 1, None: 1}
    assert document["recent"] == {"turns": 7, "late": 1, "worst_us": 60_000}


def test_late_offsets_explain_only_their_direct_consequences() -> None:
    turns = TurnLateness(MADE)
    assert turns.explain_by_lateness("LimitActive", 0.0) == ""
    turns.count_turn(0.009, False, 5.0)
    turns.count_turn(0.0002, True, 5.001)
    expected = "this PC was late (2 offsets, worst 9.0 ms)"
    assert turns.explain_by_lateness("LimitActive", 5.5) == expected
    assert turns.explain_by_lateness("SoftwareLimit", 5.5) == ""
    assert turns.explain_by_lateness("LimitActive", 5.001 + RECENT_S + 0.1) == ""
    turns.forget_late_offsets()
    assert turns.explain_by_lateness("LimitActive", 5.5) == ""
    alarm = Alarm("LimitActive", "X", late=expected)
    assert alarm.cause == f"{expected}, therefore axis X: an internal limit is active (statusword bit 11)"
    assert "take load off this PC" in alarm.action
    assert "adopt" in Alarm("SyncLost", late=expected).action  # what was frozen needs what it always needs


@pytest.mark.parametrize(("clock", "refused"), [("monotonic", True), ("sync", False)])
def test_arming_is_refused_above_the_allowed_share_of_late_turns(
    clock: Literal["monotonic", "sync"], refused: bool
) -> None:
    turns = TurnLateness(replace(MADE, clock=clock))
    allowed = round(MOST_LATE * LEAST_TURNS * 2)
    for k in range(2 * LEAST_TURNS):
        turns.count_turn(0.004 if k < allowed else 0.0001, k < allowed, 0.0)
    assert turns.refuse_when_late() == ""
    for _ in range(allowed):
        turns.count_turn(0.004, True, 0.0)
    assert (turns.refuse_when_late() != "") is refused
    if refused:
        of = f"{2 * allowed} of the last {2 * LEAST_TURNS + allowed} offsets"
        assert turns.refuse_when_late() == f"{of} would have left late, the worst after 4.0 ms"
    for second in (61.0, 122.0):  # two minutes later they are forgotten
        for _ in range(LEAST_TURNS):
            turns.count_turn(0.0001, False, second)
    assert turns.refuse_when_late() == ""
    assert turns.build_lateness_document()["recent"]["late"] == 0


@pytest.mark.parametrize("kind", ["arm", "feedforward"])
def test_guard_refuses_to_arm_on_a_late_pc_and_shows_how_late(make: Callable[..., GuardRig], kind: str) -> None:
    shop = make()
    shop.guard._turns = TurnLateness(MADE)
    client = shop.connect()
    shop.load(client)
    shop.run(150)
    now_s = shop.guard._now_s()
    for _ in range(2 * LEAST_TURNS):
        shop.guard._turns.count_turn(0.4, True, now_s)
    asked: dict[str, dict[str, Any]] = {
        "arm": {"program_digest": DIGEST, "facts": dict(FACTS_GIVEN)},
        "feedforward": {"facts": FACTS, "laws": LAW},
    }
    answer = shop.ask(client, {"request": kind, "token": TOKEN, **asked[kind]})
    assert (answer["ok"], answer["code"]) == (False, "PcLate")
    assert "offsets would have left late, the worst after 400.0 ms" in answer["text"]
    assert "fdhil doctor --latency" in answer["advice"]
    assert shop.ask(client, {"request": "status"})["lateness"]["recent"]["late"] >= 2 * LEAST_TURNS


def test_guard_reports_a_late_pc_as_the_cause_of_the_end(make: Callable[..., GuardRig]) -> None:
    shop = make()
    client = shop.into_the_cut()
    shop.guard._turns.count_turn(0.009, True, shop.guard._now_s())
    shop.drives[0].statusword |= 1 << 11
    shop.run(3)
    cause = shop.ask(client, {"request": "status"})["cause"]
    assert cause["code"] == "LimitActive"
    assert cause["late"] == "this PC was late (1 offset, worst 9.0 ms)"
    assert cause["text"].startswith("this PC was late (1 offset, worst 9.0 ms), therefore axis X: an internal limit")
    assert "take load off this PC" in cause["advice"]
    assert any("this PC was late" in event.get("text", "") for event in shop.events())
