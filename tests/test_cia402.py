"""The pure CiA 402 codec: states, the way to Operation enabled, PDO packing, scaling."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil import cia402
from fdhil.cia402 import (
    PdoEntry,
    PowerState,
    Scaling,
    compute_pdo_length,
    decode_power_state,
    lay_out,
    pack_pdo,
    unpack_pdo,
)

# CiA 402-2, statusword of each state; x bits are tried both ways
STATES = {
    PowerState.NOT_READY: "x0xx0000",
    PowerState.SWITCH_ON_DISABLED: "x1xx0000",
    PowerState.READY: "x01x0001",
    PowerState.SWITCHED_ON: "x01x0011",
    PowerState.OPERATION_ENABLED: "x01x0111",
    PowerState.QUICK_STOP_ACTIVE: "x00x0111",
    PowerState.FAULT_REACTION_ACTIVE: "x0xx1111",
    PowerState.FAULT: "x0xx1000",
}


@pytest.mark.parametrize("state", STATES)
@given(st.integers(0, 0xFFFF))
def test_states_are_decoded_from_their_bits(state: PowerState, other_bits: int) -> None:
    pattern = STATES[state]
    fixed = int(pattern.replace("x", "0"), 2)
    free = int("".join("1" if bit == "x" else "0" for bit in pattern), 2) | 0xFF00
    assert decode_power_state(fixed | other_bits & free) is state


def test_every_state_can_reach_operation_enabled() -> None:
    arrives = {
        PowerState.FAULT: PowerState.SWITCH_ON_DISABLED,
        PowerState.SWITCH_ON_DISABLED: PowerState.READY,
        PowerState.READY: PowerState.SWITCHED_ON,
        PowerState.SWITCHED_ON: PowerState.OPERATION_ENABLED,
        PowerState.QUICK_STOP_ACTIVE: PowerState.SWITCH_ON_DISABLED,
    }
    for start in arrives:
        state, words = start, []
        while state is not PowerState.OPERATION_ENABLED:
            words.append(cia402.choose_enabling_controlword(state))
            state = arrives[state]
            assert len(words) < 6
        assert None not in words
    assert cia402.choose_enabling_controlword(PowerState.NOT_READY) is None
    assert cia402.choose_enabling_controlword(PowerState.FAULT_REACTION_ACTIVE) is None
    assert cia402.choose_enabling_controlword(PowerState.OPERATION_ENABLED) == 0x0F


@st.composite
def build_entries(draw: st.DrawFn) -> tuple[tuple[PdoEntry, ...], tuple[int, ...]]:
    entries: list[tuple[int, int, int, bool]] = []
    left = 64
    for _ in range(draw(st.integers(1, 8))):
        bits = draw(st.integers(1, 32))
        if bits > left:
            break
        left -= bits
        entries.append((draw(st.integers(0x1000, 0xFFFF)), draw(st.integers(0, 255)), bits, draw(st.booleans())))
    laid = lay_out(entries)
    values = tuple(
        draw(st.integers(-(1 << e.bits - 1), (1 << e.bits - 1) - 1) if e.signed else st.integers(0, (1 << e.bits) - 1))
        for e in laid
    )
    return laid, values


@given(build_entries(), st.binary(max_size=4))
def test_packed_values_are_unpacked_unchanged(pdo: tuple[tuple[PdoEntry, ...], tuple[int, ...]], tail: bytes) -> None:
    entries, values = pdo
    data = pack_pdo(entries, values)
    assert len(data) == compute_pdo_length(entries) <= 8
    assert unpack_pdo(entries, data) == values
    assert unpack_pdo(entries, data + tail) == values  # of a long PDO the mapped bytes count
    with pytest.raises(ValueError, match="its mapping needs"):
        unpack_pdo(entries, data[:-1])


@pytest.mark.parametrize("value", [1 << 15, -(1 << 15) - 1, 1.0, 1.7, math.nan, True, None])
def test_value_that_does_not_fit_is_refused(value: object) -> None:
    entries = lay_out([(0x6078, 0, 16, True)])
    with pytest.raises(ValueError, match="does not fit"):
        pack_pdo(entries, [value])  # type: ignore[list-item]  # a wrong type is what is tried


def test_more_than_64_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="64 bits"):
        lay_out([(0x607A, 0, 32, True)] * 3)


def test_a_mapping_value_is_index_sub_and_bits() -> None:
    assert lay_out([(0x60B0, 0, 32, True)])[0].mapping == 0x60B00020


@given(st.integers(-(2**31), 2**31 - 1), st.sampled_from([1, -1]))
def test_increments_and_millimetres_agree(increments: int, sign: int) -> None:
    scaling = Scaling(65536, 20.0, sign)
    assert scaling.convert_to_increments(scaling.convert_to_mm(increments)) == increments


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_missing_position_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="not a valid position"):
        Scaling(65536, 20.0).convert_to_increments(value)
