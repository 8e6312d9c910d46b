"""The CiA 402 state machine: every transition, and random walks against an independent table."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.sim.drive.power import PowerStage, Ramp, State

S = State


def state(power: PowerStage) -> State:
    return power.state


def stage(**codes: int) -> PowerStage:
    options = {0x605A: 2, 0x605B: 0, 0x605C: 1, 0x605E: 2} | {int(k[1:], 16): v for k, v in codes.items()}
    power = PowerStage(lambda index: options[index])
    assert state(power) is S.NOT_READY
    power.start()
    return power


def enabled(**codes: int) -> PowerStage:
    power = stage(**codes)
    for word in (0x06, 0x07, 0x0F):
        power.control(word)
    assert state(power) is S.OPERATION_ENABLED
    assert power.powered
    return power


def test_the_way_up_and_down() -> None:
    power = stage()
    states = [S.SWITCH_ON_DISABLED]
    for word in (0x07, 0x06, 0x07, 0x06, 0x0F, 0x06, 0x00, 0x06, 0x02):
        power.control(word)
        states.append(power.state)
    assert states == [
        S.SWITCH_ON_DISABLED, S.SWITCH_ON_DISABLED, S.READY, S.SWITCHED_ON, S.READY, S.OPERATION_ENABLED, S.READY,
        S.SWITCH_ON_DISABLED, S.READY, S.SWITCH_ON_DISABLED,
    ]  # fmt: skip


def test_disable_operation_waits_for_the_ramp_and_can_be_taken_back() -> None:
    power = enabled()
    power.control(0x07)
    assert (power.state, power.ramp, power.follows) == (S.OPERATION_ENABLED, Ramp.SLOW_DOWN, False)
    power.control(0x0F)
    assert power.follows
    power.control(0x07)
    power.at_rest()
    assert state(power) is S.SWITCHED_ON
    at_once = enabled(o605C=0)
    at_once.control(0x07)
    assert state(at_once) is S.SWITCHED_ON


def test_quick_stop_ends_as_its_option_code_says() -> None:
    for code, ramp, end in (
        (1, Ramp.SLOW_DOWN, S.SWITCH_ON_DISABLED),
        (2, Ramp.QUICK_STOP, S.SWITCH_ON_DISABLED),
        (5, Ramp.SLOW_DOWN, S.QUICK_STOP_ACTIVE),
        (6, Ramp.QUICK_STOP, S.QUICK_STOP_ACTIVE),
    ):
        power = enabled(o605A=code)
        power.control(0x02)
        assert (power.state, power.ramp) == (S.QUICK_STOP_ACTIVE, ramp)
        power.control(0x02)
        power.at_rest()
        assert state(power) is end
    direct = enabled(o605A=0)
    direct.control(0x02)
    assert state(direct) is S.SWITCH_ON_DISABLED


def test_transition_16_needs_the_option_and_another_controlword() -> None:
    power = enabled(o605A=6)
    power.quick_stop()  # ordered by the drive itself while 0x0F stands
    power.control(0x0F)
    assert state(power) is S.QUICK_STOP_ACTIVE
    power.control(0x02)
    power.control(0x0F)
    assert state(power) is S.QUICK_STOP_ACTIVE  # it is the word at the quick stop
    power.control(0x1F)
    assert state(power) is S.OPERATION_ENABLED
    by_word = enabled(o605A=6)
    by_word.control(0x02)
    by_word.control(0x0F)
    assert state(by_word) is S.OPERATION_ENABLED
    without = enabled(o605A=2)
    without.control(0x02)
    without.control(0x0F)
    assert state(without) is S.QUICK_STOP_ACTIVE
    without.control(0x00)
    assert state(without) is S.SWITCH_ON_DISABLED


def test_fault_reaction_and_reset_on_the_rising_edge_alone() -> None:
    power = enabled()
    power.control(0x8F)  # bit 7 is high already when the fault comes
    power.fault()
    assert (power.state, power.ramp, power.powered) == (S.FAULT_REACTION_ACTIVE, Ramp.QUICK_STOP, True)
    power.control(0x00)
    assert state(power) is S.FAULT_REACTION_ACTIVE
    power.control(0x80)
    power.at_rest()
    assert state(power) is S.FAULT
    power.control(0x80)
    assert state(power) is S.FAULT
    power.control(0x00)
    assert power.control(0x80)
    assert state(power) is S.SWITCH_ON_DISABLED
    for code, wanted in ((0, S.FAULT), (1, S.FAULT_REACTION_ACTIVE)):
        other = enabled(o605E=code)
        other.fault()
        other.fault()
        assert state(other) is wanted
    idle = stage()
    idle.quick_stop()
    assert state(idle) is S.SWITCH_ON_DISABLED
    idle.at_rest()
    idle.fault()
    assert state(idle) is S.FAULT
    idle.disable_voltage()
    assert state(idle) is S.FAULT


# state -> ((mask, value of the controlword), next state) in priority order, CiA 402-2 tables 27 and 28, without ramps
TABLE = {
    S.SWITCH_ON_DISABLED: [((0x87, 0x06), S.READY)],
    S.READY: [
        ((0x82, 0x00), S.SWITCH_ON_DISABLED),
        ((0x86, 0x02), S.SWITCH_ON_DISABLED),
        ((0x8F, 0x0F), S.OPERATION_ENABLED),
        ((0x8F, 0x07), S.SWITCHED_ON),
    ],
    S.SWITCHED_ON: [
        ((0x82, 0x00), S.SWITCH_ON_DISABLED),
        ((0x86, 0x02), S.SWITCH_ON_DISABLED),
        ((0x87, 0x06), S.READY),
        ((0x8F, 0x0F), S.OPERATION_ENABLED),
    ],
    S.OPERATION_ENABLED: [
        ((0x82, 0x00), S.SWITCH_ON_DISABLED),
        ((0x86, 0x02), S.SWITCH_ON_DISABLED),
        ((0x87, 0x06), S.READY),
        ((0x8F, 0x07), S.SWITCHED_ON),
    ],
}


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=300)
@given(st.lists(st.one_of(st.sampled_from([0, 2, 6, 7, 15, 128]), st.integers(0, 0xFFFF), st.none()), max_size=20))
def test_random_walks_follow_the_standard_s_table(words: list[int | None]) -> None:
    power = stage(o605A=0, o605B=0, o605C=0, o605E=0)
    expected, last = S.SWITCH_ON_DISABLED, None
    for word in words:
        if word is None:
            power.fault()
            expected = S.FAULT
            continue
        if expected is S.FAULT:
            if word & 0x80 and not (last or 0) & 0x80:
                expected = S.SWITCH_ON_DISABLED
        else:
            expected = next((s for (mask, value), s in TABLE[expected] if word & mask == value), expected)
        power.control(word)
        last = word
        assert state(power) is expected
