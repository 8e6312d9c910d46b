"""Shows by exhaustive cases that each fault ends sending, and that only arming or adopting starts it.

The core evaluates only the classes of alarms, so that all classes, in pairs, cover every case: the worst reaction
counts, and whether ``OffsetHijack`` and ``NodeRebooted`` are among them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

import fdhil.guard
from fdhil.guard import feedforward_law, guard_state, guard_step, offset_adoption, shadow_correction
from fdhil.guard.corrected_path import PathPosition
from fdhil.guard.guard_protocol import AT_REST, HOLD_CYCLES, IN_CHARGE, ON_PATH, RAMPING_MODES, SENDING, Mode
from fdhil.guard.guard_settings import MOST_LEAD, GuardSettings
from fdhil.guard.guard_state import BusView, GuardRequest, GuardState, StepInputs, make_initial_state
from fdhil.guard.interlock_checks import ARMING_INTERLOCKS, AXIS_INTERLOCKS, BUS_INTERLOCKS
from fdhil.guard.interlocks import FACTS, INTERLOCK_CATALOGUE, Alarm, Alarms, Reaction
from fdhil.guard.state_transitions import NEXT, ZEROS_UNCONFIRMED, Event
from tests.guard.simulated_bus import FACTS_GIVEN, settings

pytestmark = pytest.mark.usefixtures("long_computation")

QUIET = StepInputs(True, (), BusView(silent=False, sync_regular=True))
CODES = sorted(INTERLOCK_CATALOGUE)


def state_in(mode: Mode, made: GuardSettings, *, offset: int = 7, **changes: object) -> GuardState:
    """A state of which nothing but its mode and the offsets matters."""
    blank = make_initial_state(made)
    axes = tuple(axis._replace(offset=offset, sent=(offset,) * len(axis.sent)) for axis in blank.axes)
    return blank._replace(mode=mode, axes=axes, places=(PathPosition(5),), **changes)


def alarm_sets() -> Iterator[Alarms]:
    yield ()
    yield from ((Alarm(code),) for code in CODES)
    yield from ((Alarm(one), Alarm(other)) for one, other in product(CODES, CODES) if one != other)


def test_every_alarm_has_the_effect_of_its_reaction() -> None:
    for synchronous, measuring, offset in product((True, False), (0, 1), (0, 7)):
        made = settings(offset_synchronous=synchronous)
        for mode, alarms in product(Mode, alarm_sets()):
            before = state_in(mode, made, measuring=measuring, offset=offset)
            after = guard_step._react_to_alarms(before, QUIET._replace(alarms=alarms), alarms, made).mode
            worst = max((guard_step._find_reaction(alarm, made) for alarm in alarms), default=Reaction.REFUSE)
            if mode in AT_REST:
                assert after is mode
            elif worst is Reaction.FREEZE:
                assert after in AT_REST
            elif worst is Reaction.RAMP_DOWN:
                assert after in RAMPING_MODES | AT_REST
            else:
                assert after is mode


@pytest.mark.parametrize("mode", sorted(IN_CHARGE))
def test_lost_daemon_withdrawn_fact_and_unsent_frames_end_the_correction(mode: Mode) -> None:
    made = settings()
    for lost in (
        QUIET._replace(main_alive=False),
        *(QUIET._replace(withdrawn=(Alarm(code),)) for code in FACTS.values()),
    ):
        assert guard_step._react_to_alarms(state_in(mode, made), lost, (), made).mode in RAMPING_MODES
    unsent = state_in(mode, made, failed_run=2 * guard_step.FAILED_SENDS)
    assert guard_step._react_to_alarms(unsent, QUIET, (), made).mode is Mode.FROZEN


@pytest.mark.parametrize("kind", ["disarm", "stop"])
@pytest.mark.parametrize("mode", sorted(IN_CHARGE))
def test_disarm_has_no_precondition(mode: Mode, kind: str) -> None:
    made = settings()
    asked = QUIET._replace(request=GuardRequest(kind))
    state, refused = guard_step._decide_request(state_in(mode, made), asked, (), (), made)
    assert (state.mode, refused) == (Mode.RAMP_DOWN, ())


def test_hold_has_a_bounded_duration() -> None:
    made = settings()
    for mode, code in product((Mode.ARMED, *sorted(ON_PATH)), CODES):
        state, cycles = state_in(mode, made), 0
        while state.mode in IN_CHARGE:
            state, cycles = guard_step._hold_offset(state, Alarm(code), made), cycles + 1
        assert state.mode is Mode.RAMP_DOWN
        assert cycles == 1 + (made.convert_to_cycles(guard_step.FEED_HOLD_S) if code == "FeedHold" else HOLD_CYCLES)


def test_ramp_down_ends_after_zeros_whatever_the_drives_show() -> None:
    for lead, shown, mode in product(range(MOST_LEAD + 1), product((True, False), repeat=2), sorted(RAMPING_MODES)):
        made = settings(lead=lead)
        state = state_in(mode, made, offset=0)
        axes = tuple(axis._replace(zero_shown=each) for axis, each in zip(state.axes, shown, strict=True))
        state, cycles = state._replace(axes=axes), 0
        while state.mode in RAMPING_MODES:
            state, cycles = guard_step._finish_ramps(state, None, lead), cycles + 1
        assert state.mode is (Mode.OFF if all(shown) else Mode.FROZEN)
        assert cycles <= ZEROS_UNCONFIRMED + lead + 1


# --- what begins it ---


def test_only_arm_and_adopt_leave_the_idle_states() -> None:
    ways = {(mode, event): after for (mode, event), after in NEXT.items() if mode in AT_REST and after is not mode}
    assert {event for (_, event), after in ways.items() if after in SENDING} == {Event.ARM, Event.ADOPT}
    assert [mode for mode, event in ways if event is Event.ARM] == [Mode.OFF]
    for mode, event in product(SENDING, Event):
        assert NEXT.get((mode, event)) not in ({Mode.ADOPT, Mode.ARMED} - {mode})


def guard_trees() -> dict[str, ast.Module]:
    folder = Path(fdhil.guard.__file__).parent
    return {path.name: ast.parse(path.read_text()) for path in sorted(folder.glob("*.py"))}


def test_mode_changes_only_by_the_transition_table() -> None:
    """No call but the one in ``follow_event`` gives a state another mode; the copy of the shadow is never sent."""
    found = [
        (name, ast.unparse(keyword.value))
        for name, tree in guard_trees().items()
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("_replace")
        for keyword in call.keywords
        if keyword.arg == "mode"
    ]
    others = sorted({(name, value) for name, value in found if name != Path(feedforward_law.__file__).name})
    assert others == [
        (Path(guard_state.__file__).name, "NEXT[self.mode, event]"),
        (Path(shadow_correction.__file__).name, "Mode.ARMED"),
    ]


def test_arm_and_adopt_events_occur_in_one_function_each() -> None:
    used = [
        (name, function.name, event)
        for name, tree in guard_trees().items()
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for call in ast.walk(function)
        if isinstance(call, ast.Call) and ast.unparse(call.func).endswith(".follow_event")
        for event in [ast.unparse(call.args[0])]
        if event in ("Event.ARM", "Event.ADOPT") and name != Path(feedforward_law.__file__).name
    ]
    assert sorted(used) == sorted(
        (Path(module.__file__).name, function.__name__, event)
        for module, function, event in (
            (offset_adoption, offset_adoption.begin_adoption, "Event.ADOPT"),
            (guard_step, guard_step._enter_armed, "Event.ARM"),
        )
    )


class _Table:
    """A table of the program that is asked for, the machine at its begin."""

    program_digest, first = "program", 0

    def count_standing_rows(self) -> int:
        return 0


def arming(made: GuardSettings, **changes: object) -> tuple[GuardState, StepInputs, GuardRequest]:
    """State, inputs and request that nothing forbids, but for the ``changes`` of any of the three."""
    values: dict[str, object] = {
        "mode": Mode.OFF, "good_for": guard_step.SETTLED_CYCLES, "main_alive": True, "path": _Table(),
        "token_valid": True, "program_digest": "program", "facts": FACTS_GIVEN,
    } | changes  # fmt: skip
    state = make_initial_state(made)._replace(mode=values["mode"], good_for=values["good_for"])
    inputs = QUIET._replace(main_alive=values["main_alive"], path=values["path"])
    asked = GuardRequest("arm", values["token_valid"], values["program_digest"], values["facts"])
    return state, inputs, asked


FORBIDDEN: tuple[dict[str, object], ...] = (
    *({"mode": mode} for mode in Mode if mode is not Mode.OFF),
    {"good_for": guard_step.SETTLED_CYCLES - 1},
    *({"main_alive": value} for value in (False, None)),
    *({"token_valid": value} for value in (False, None, 1, "yes")),
    {"path": None},
    *({"program_digest": value} for value in ("", "another")),
    *({"facts": {**FACTS_GIVEN, fact: value}} for fact in FACTS for value in (False, None, 1, "yes")),
    *({"facts": {k: v for k, v in FACTS_GIVEN.items() if k != fact}} for fact in FACTS),
)


def test_arming_needs_every_condition() -> None:
    made = settings()
    state, inputs, asked = arming(made)
    assert guard_step._list_arm_refusals(state, inputs, asked, (), (), made) == ()
    for one in FORBIDDEN:
        for other in ({}, *FORBIDDEN):
            state, inputs, asked = arming(made, **one, **{k: v for k, v in other.items() if k not in one})
            assert guard_step._list_arm_refusals(state, inputs, asked, (), (), made), (one, other)
            assert guard_step._decide_request(state, inputs._replace(request=asked), (), (), made)[0].mode is state.mode
    state, inputs, asked = arming(made)
    for alarms in alarm_sets():
        assert bool(guard_step._list_arm_refusals(state, inputs, asked, alarms, (), made)) is bool(alarms)


@pytest.mark.parametrize("table", [BUS_INTERLOCKS, AXIS_INTERLOCKS, ARMING_INTERLOCKS])
def test_every_interlock_has_a_reaction(table: tuple[tuple[str, object], ...]) -> None:
    assert {code for code, _ in table} <= set(INTERLOCK_CATALOGUE)
