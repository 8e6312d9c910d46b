"""The CiA 402 state machine: every transition, and random walks against an independent table."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.sim.drive.power_stage import PowerStage, PowerState, StopRamp

S = PowerState


def decode_state(power: PowerStage) -> PowerState:
    return power.state


def create_stage(**codes: int) -> PowerStage:
    options = {0x605A: 2, 0x605B: 0, 0x605C: 1, 0x605E: 2} | {int(k[1:], 16): v for k, v in codes.items()}
    power = PowerStage(lambda index: options[index])
    assert decode_state(power) is S.NOT_READY
    power.enter_switch_on_disabled()
    return power


def create_enabled_stage(**codes: int) -> PowerStage:
    power = create_stage(**codes)
    for word in (0x06, 0x07, 0x0F):
        power.evaluate_controlword(word)
    assert decode_state(power) is S.OPERATION_ENABLED
    assert power.powered
    return power


def test_transitions_to_operation_enabled_and_back() -> None:
    power = create_stage()
    states = [S.SWITCH_ON_DISABLED]
    for word in (0x07, 0x06, 0x07, 0x06, 0x0F, 0x06, 0x00, 0x06, 0x02):
        power.evaluate_controlword(word)
        states.append(power.state)
    assert states == [
        S.SWITCH_ON_DISABLED, S.SWITCH_ON_DISABLED, S.READY, S.SWITCHED_ON, S.READY, S.OPERATION_ENABLED, S.READY,
        S.SWITCH_ON_DISABLED, S.READY, S.SWITCH_ON_DISABLED,
    ]  # fmt: skip


def test_disable_operation_waits_for_ramp_and_can_be_cancelled() -> None:
    power = create_enabled_stage()
    power.evaluate_controlword(0x07)
    assert (power.state, power.ramp, power.follows_setpoints) == (S.OPERATION_ENABLED, StopRamp.SLOW_DOWN, False)
    power.evaluate_controlword(0x0F)
    assert power.follows_setpoints
    power.evaluate_controlword(0x07)
    power.finish_ramp()
    assert decode_state(power) is S.SWITCHED_ON
    at_once = create_enabled_stage(o605C=0)
    at_once.evaluate_controlword(0x07)
    assert decode_state(at_once) is S.SWITCHED_ON


def test_quick_stop_ends_by_option_code() -> None:
    for code, ramp, end in (
        (1, StopRamp.SLOW_DOWN, S.SWITCH_ON_DISABLED),
        (2, StopRamp.QUICK_STOP, S.SWITCH_ON_DISABLED),
        (5, StopRamp.SLOW_DOWN, S.QUICK_STOP_ACTIVE),
        (6, StopRamp.QUICK_STOP, S.QUICK_STOP_ACTIVE),
    ):
        power = create_enabled_stage(o605A=code)
        power.evaluate_controlword(0x02)
        assert (power.state, power.ramp) == (S.QUICK_STOP_ACTIVE, ramp)
        power.evaluate_controlword(0x02)
        power.finish_ramp()
        assert decode_state(power) is end
    direct = create_enabled_stage(o605A=0)
    direct.evaluate_controlword(0x02)
    assert decode_state(direct) is S.SWITCH_ON_DISABLED


def test_transition_16_needs_option_and_new_controlword() -> None:
    power = create_enabled_stage(o605A=6)
    power.start_quick_stop()  # ordered by the drive itself while 0x0F stands
    power.evaluate_controlword(0x0F)
    assert decode_state(power) is S.QUICK_STOP_ACTIVE
    power.evaluate_controlword(0x02)
    power.evaluate_controlword(0x0F)
    assert decode_state(power) is S.QUICK_STOP_ACTIVE  # it is the word at the quick stop
    power.evaluate_controlword(0x1F)
    assert decode_state(power) is S.OPERATION_ENABLED
    by_word = create_enabled_stage(o605A=6)
    by_word.evaluate_controlword(0x02)
    by_word.evaluate_controlword(0x0F)
    assert decode_state(by_word) is S.OPERATION_ENABLED
    without = create_enabled_stage(o605A=2)
    without.evaluate_controlword(0x02)
    without.evaluate_controlword(0x0F)
    assert decode_state(without) is S.QUICK_STOP_ACTIVE
    without.evaluate_controlword(0x00)
    assert decode_state(without) is S.SWITCH_ON_DISABLED


def test_fault_resets_on_rising_edge_only() -> None:
    power = create_enabled_stage()
    power.evaluate_controlword(0x8F)  # bit 7 is high already when the fault comes
    power.enter_fault()
    assert (power.state, power.ramp, power.powered) == (S.FAULT_REACTION_ACTIVE, StopRamp.QUICK_STOP, True)
    power.evaluate_controlword(0x00)
    assert decode_state(power) is S.FAULT_REACTION_ACTIVE
    power.evaluate_controlword(0x80)
    power.finish_ramp()
    assert decode_state(power) is S.FAULT
    power.evaluate_controlword(0x80)
    assert decode_state(power) is S.FAULT
    power.evaluate_controlword(0x00)
    assert power.evaluate_controlword(0x80)
    assert decode_state(power) is S.SWITCH_ON_DISABLED
    for code, wanted in ((0, S.FAULT), (1, S.FAULT_REACTION_ACTIVE)):
        other = create_enabled_stage(o605E=code)
        other.enter_fault()
        other.enter_fault()
        assert decode_state(other) is wanted
    idle = create_stage()
    idle.start_quick_stop()
    assert decode_state(idle) is S.SWITCH_ON_DISABLED
    idle.finish_ramp()
    idle.enter_fault()
    assert decode_state(idle) is S.FAULT
    idle.disable_voltage()
    assert decode_state(idle) is S.FAULT


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
def test_random_walks_follow_state_table_of_standard(words: list[int | None]) -> None:
    power = create_stage(o605A=0, o605B=0, o605C=0, o605E=0)
    expected, last = S.SWITCH_ON_DISABLED, None
    for word in words:
        if word is None:
            power.enter_fault()
            expected = S.FAULT
            continue
        if expected is S.FAULT:
            if word & 0x80 and not (last or 0) & 0x80:
                expected = S.SWITCH_ON_DISABLED
        else:
            expected = next((s for (mask, value), s in TABLE[expected] if word & mask == value), expected)
        power.evaluate_controlword(word)
        last = word
        assert decode_state(power) is expected
