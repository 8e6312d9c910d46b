"""Times with too few digits become the even grid that they approximate, if it is unambiguous."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store.counter_wraps import jump_of_reading, unwrap_counter, unwrap_turns
from fdhil.store.sample_times import compute_usual_step, find_even_times

K = np.arange(1000.0)


def _round_times(time_s: Float, to_s: float) -> Float:
    return np.rint(time_s / to_s) * to_s


@pytest.mark.parametrize(
    ("period_s", "to_s"), [(0.625e-3, 1e-4), (0.25e-3, 1e-4), (1 / 1024, 1e-3), (1 / 480, 1e-3), (1e-3, 1e-2)]
)
def test_rounded_times_become_their_even_grid(period_s: float, to_s: float) -> None:
    even, note = find_even_times(_round_times(K * period_s, to_s), None, "trace")
    np.testing.assert_allclose(np.diff(even), period_s, rtol=2e-3)
    assert f"rounded to {to_s:.4g} s" in note


def test_lost_samples_between_rounded_times_stay_lost() -> None:
    kept = np.delete(K, [400, 401, 402, 700])
    even, _ = find_even_times(_round_times(kept * 0.625e-3, 1e-4), None, "trace")
    np.testing.assert_allclose(np.diff(even) / 0.625e-3, np.diff(kept), rtol=1e-3)


@pytest.mark.parametrize(
    "time_s",
    [
        K * 1e-3,
        np.delete(K, 500) * 1e-3,
        np.delete(K, np.random.default_rng(1).choice(998, 30, replace=False) + 1) * 1e-3,
        np.delete(K, [*range(200, 205), *range(400, 405), *range(600, 605), *range(800, 805)]) * 1e-3,
        np.sort(np.append(K, 500)) * 1e-3,
    ],
    ids=["even", "one lost", "thirty lost", "four bursts lost", "one twice"],
)
def test_other_times_are_unchanged(time_s: Float) -> None:
    even, note = find_even_times(time_s, None, "trace")
    assert np.array_equal(even, time_s)
    assert note == ""


def test_jittered_times_are_refused_without_rate() -> None:
    kept = np.delete(K, [400, 401, 700])
    time_s = kept * 1e-3 + np.random.default_rng(1).uniform(-5e-5, 5e-5, kept.size)
    with pytest.raises(RecordingError, match=r"vary from .* with jittered time stamps.* uneven samples"):
        find_even_times(time_s, None, "trace")
    even, note = find_even_times(time_s, 1000.0, "trace")
    np.testing.assert_allclose(np.diff(even), np.diff(kept) * 1e-3)
    assert "a sample period of 0.001 s is used" in note
    with pytest.raises(RecordingError, match=r"drift from 990 Hz by 0.01\d* s: correct sample_rate_hz"):
        find_even_times(time_s, 990.0, "trace")


def test_ambiguous_steps_are_refused_without_rate() -> None:
    time_s = _round_times(K * 1.02e-3, 1e-3)
    with pytest.raises(RecordingError, match=r"samples 0.00102\d* s apart .* or samples 0.001 s apart of which some"):
        find_even_times(time_s, None, "trace")
    assert np.array_equal(find_even_times(time_s, 1000.0, "trace")[0], time_s)
    np.testing.assert_allclose(np.diff(find_even_times(time_s, 1 / 1.02e-3, "trace")[0]), 1.02e-3)


def test_too_coarse_times_need_the_rate() -> None:
    time_s = np.floor(K[:300] * 1e-3 / 0.1 + 1e-9) * 0.1
    with pytest.raises(RecordingError, match="too coarse"):
        find_even_times(time_s, None, "trace")
    np.testing.assert_allclose(np.diff(find_even_times(time_s, 1000.0, "trace")[0]), 1e-3)


COUNTS = 1000 + np.rint(np.cumsum(np.concatenate([np.zeros(100), np.linspace(0, 400, 200), np.full(300, 400.0)])))


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("sign", [1, -1])
def test_overflowing_counter_is_unwrapped(bits: int, signed: bool, sign: int) -> None:
    counts = sign * COUNTS * (1 if bits == 16 else 40_000)
    low = -(2.0 ** (bits - 1)) if signed else 0.0
    counts[50] = np.nan
    unwrapped, found = unwrap_counter((counts - low) % 2.0**bits + low)
    assert found == bits
    np.testing.assert_array_equal(unwrapped - unwrapped[0], counts - counts[0])


def test_counter_in_thousandths_is_unwrapped() -> None:
    unwrapped, bits = unwrap_counter(((COUNTS + 32768) % 65536 - 32768) / 1000)
    assert bits == 16
    np.testing.assert_allclose(unwrapped - unwrapped[0], (COUNTS - COUNTS[0]) / 1000, atol=1e-9)


def test_single_turn_encoder_is_unwrapped() -> None:
    turns = np.concatenate([np.zeros(50), np.cumsum(np.rint(np.linspace(0, 120, 200)))])
    unwrapped, bits = unwrap_counter(turns % 4096)
    assert bits == 12
    np.testing.assert_array_equal(unwrapped, turns)


@pytest.mark.parametrize(
    "counts",
    [COUNTS, COUNTS % 65536 + np.pi, np.where(COUNTS > 40_000, COUNTS - 40_000, COUNTS), COUNTS * 90 % 65536],
    ids=["no wrap", "no whole numbers", "another period", "too fast"],
)
def test_other_jump_is_left_to_the_checks(counts: Float) -> None:
    unwrapped, found = unwrap_counter(counts)
    assert found is None
    assert np.array_equal(unwrapped, counts)


def test_usual_step_is_mean_of_similar_steps_or_median() -> None:
    assert compute_usual_step(np.array([0.0, 0.333e-3, 0.667e-3, 1e-3, 9.0])) == pytest.approx(1e-3 / 3)
    assert compute_usual_step(np.array([0.0, 1.0, 3.0])) == 1.5


@pytest.mark.parametrize("turn", [20.0, 360.0, 10000.0])
def test_reading_within_one_turn_is_unwrapped_by_the_pitch(turn: float) -> None:
    over_all = turn * np.concatenate([np.zeros(50), np.linspace(0.0, 6.0, 300), np.full(50, 6.0)])
    read, is_turn = unwrap_turns(over_all % turn, turn)
    assert is_turn
    np.testing.assert_allclose(read, over_all)
    assert not unwrap_turns(over_all % turn, 0.7 * turn)[1]
    assert jump_of_reading(over_all % turn) == pytest.approx(turn, rel=0.05)


def test_two_recordings_in_one_file_are_not_unwrapped() -> None:
    rapid = np.concatenate([np.zeros(50), np.linspace(0.0, 120.0, 300), np.full(50, 120.0)])
    for values in (np.tile(rapid, 2), rapid, np.zeros(100), np.where(K[:400] == 200, 0.0, rapid + 1)):
        assert jump_of_reading(values) is None
