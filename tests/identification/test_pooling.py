"""The mixed model of a pool: common values, variation between windows, both directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification.between_window_variance import (
    NO_BETWEEN_VARIANCE,
    PoolMember,
    estimate_between_window_variance,
)
from fdhil.identification.ripple_parts import combine_ripples, split_ripples
from fdhil.identification.window_pool import build_pool_member, estimate_friction_at, pool_estimates
from fdhil.records import INTERVAL_95, PARAMETERS, Estimate, Float, Parameters, freeze_array
from tests.store.sample_records import make_outcome, make_window

BENCH = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
RAPID = 157.0  # rad/s
FIRST = make_outcome(of=make_window()).estimate
assert FIRST is not None


def build_covariance_at(speed_rad_s: float) -> Float:
    """Return a rapid's covariance: friction torque at its speed to 0.01 N.m, ft and Cd separately to 2 % only."""
    spread = np.diag(np.array([3e-4, 7e-6, 1.6e-4, 4e-5, 0.0, 0.0]) ** 2)
    apart, together = 0.09, 0.01
    spread[4:, 4:] = apart**2 * np.outer([-1 / speed_rad_s, 1.0], [-1 / speed_rad_s, 1.0])
    spread[4:, 4:] += together**2 / 2 * np.diag([speed_rad_s**-2.0, 1.0])
    return spread


def draw_windows(
    rng: np.random.Generator, truth: Sequence[Parameters], speeds: Sequence[float], load: float = 0.0
) -> list[PoolMember]:
    """Return windows of both directions at some speeds, each with its own true values."""
    members = []
    for place, (now, speed) in enumerate(zip(truth, speeds, strict=True)):
        direction = 1 - 2 * (place % 2)
        own = build_covariance_at(speed)
        values = np.array(list(now.as_dict().values())) + np.linalg.cholesky(own) @ rng.standard_normal(6)
        values[5] += direction * load
        members.append(PoolMember(PARAMETERS, values, own, np.zeros((6, 6)), place, direction))
    return members


def compute_deviations(found: Estimate, truth: Parameters) -> Float:
    """Return the error of each of the six parameters in standard deviations."""
    off: Float = (found.values[:6] - list(truth.as_dict().values())) / np.sqrt(np.diag(found.covariance))[:6]
    return off


@pytest.mark.parametrize("kelvin", [0.0, 0.2, 2.0])
@pytest.mark.parametrize("speeds", [(RAPID,), (RAPID, 132.0, 113.0)])
def test_intervals_cover_the_truth_while_friction_falls_with_warming(kelvin: float, speeds: Sequence[float]) -> None:
    assert FIRST is not None
    held = []
    for seed in range(6):
        rng = np.random.default_rng([7, seed])
        warm = kelvin * np.linspace(0.0, 1.0, 24)
        truth = [replace(BENCH, ft=0.05 * (1 - 0.16 * k), Cd=5.0 * (1 - 0.1 * k)) for k in warm]
        members = draw_windows(rng, truth, rng.choice(speeds, 24).tolist())
        for newest in range(2, 24):
            apart = estimate_between_window_variance(members[: newest + 1])
            found = pool_estimates(members[max(0, newest - 3) : newest + 1], FIRST, apart)
            held.append(np.abs(compute_deviations(found, truth[newest])) < INTERVAL_95)
    share = np.mean(held, axis=0)
    assert (share > 0.86).all(), share


def test_load_is_added_only_if_present_and_both_directions_exist() -> None:
    assert FIRST is not None
    joined = {0.0: 0, 0.5: 0}
    for load in joined:
        for seed in range(60):
            members = draw_windows(np.random.default_rng([8, seed]), [BENCH] * 4, [RAPID] * 4, load)
            found = pool_estimates(members, FIRST, estimate_between_window_variance(members))
            joined[load] += "load" in found.terms
            if load and found.terms:
                assert found.get_value("load") == pytest.approx(load, abs=6 * found.get_std("load"))
                assert found.get_value("Cd") == pytest.approx(5.0, abs=6 * found.get_std("Cd"))
    assert joined[0.5] == 60
    assert joined[0.0] <= 1
    one_way = [replace(m, direction=1) for m in draw_windows(np.random.default_rng(1), [BENCH] * 4, [RAPID] * 4, 0.0)]
    assert pool_estimates(one_way, FIRST, estimate_between_window_variance(one_way)).terms == ()


def test_viscous_friction_by_direction_is_reported_as_two_values_about_ft() -> None:
    assert FIRST is not None
    rng = np.random.default_rng(3)
    truth = [replace(BENCH, ft=0.06 if k % 2 == 0 else 0.04) for k in range(12)]
    found = pool_estimates(draw_windows(rng, truth, [RAPID, RAPID, 100.0, 100.0] * 3), FIRST, NO_BETWEEN_VARIANCE)
    assert found.get_value("viscous_positive") == pytest.approx(0.06, rel=0.03)
    assert found.get_value("viscous_negative") == pytest.approx(0.04, rel=0.03)
    assert found.get_value("ft") == pytest.approx(
        (found.get_value("viscous_positive") + found.get_value("viscous_negative")) / 2
    )
    root = np.linalg.eigvalsh(found.covariance / np.outer(*[np.sqrt(np.diag(found.covariance))] * 2))
    assert root.min() > -1e-9


def test_warming_drive_is_distinguished_from_a_steady_one() -> None:
    rng = np.random.default_rng(4)
    still = estimate_between_window_variance(draw_windows(rng, [BENCH] * 24, [RAPID] * 24))
    warming = [replace(BENCH, ft=0.05 * (1 - 0.3 * k / 24), Cd=5.0 * (1 - 0.2 * k / 24)) for k in range(24)]
    moving = estimate_between_window_variance(draw_windows(rng, warming, [RAPID] * 24))
    assert not still.surely
    assert moving.surely
    assert moving.walk["Cd"] > 4 * still.walk["Cd"]
    assert 0.003 < moving.walk["Cd"] ** 0.5 < 0.04  # true: 0.8 to 1.3 % from window to window


def test_terms_are_averaged_over_their_windows_and_ripple_phase_over_the_circle() -> None:
    assert FIRST is not None
    rng, names = np.random.default_rng(5), (*PARAMETERS, "ripple_screw_1", "ripple_screw_1_phase")
    members = []
    for place, plain in enumerate(draw_windows(rng, [BENCH] * 4, [RAPID] * 4)):
        phase = np.pi + (0.1 if place % 2 else -0.1)  # on either side of the phase jump
        values = np.array([*plain.values, 0.2, np.arctan2(np.sin(phase), np.cos(phase))])
        own = np.zeros((8, 8))
        own[:6, :6], own[6:, 6:] = plain.own, np.diag([0.01**2, 0.05**2])
        parts = split_ripples(names, values, own, np.zeros((8, 6)))
        members.append(PoolMember(names, *parts, place, plain.direction))
    members[0] = draw_windows(rng, [BENCH], [RAPID])[0]
    found = pool_estimates(members, FIRST, NO_BETWEEN_VARIANCE, joining=False)
    assert found.terms == names[6:]
    assert found.get_value("ripple_screw_1") == pytest.approx(0.2, abs=0.02)
    assert abs(abs(found.get_value("ripple_screw_1_phase")) - np.pi) < 0.1
    assert found.get_std("ripple_screw_1") == pytest.approx(0.01 / 3**0.5, rel=0.1)
    rare = pool_estimates(
        [members[1], *draw_windows(rng, [BENCH] * 3, [RAPID] * 3)], FIRST, NO_BETWEEN_VARIANCE, joining=False
    )
    assert rare.terms == ()


def test_ripple_parts_combine_to_the_original() -> None:
    names = ("Cd", "ripple_motor_4", "ripple_motor_4_phase")
    values, covariance = np.array([5.0, 0.3, -2.0]), np.diag([0.1, 0.02, 0.03]) ** 2
    reported, spread, doubts = combine_ripples(names, *split_ripples(names, values, covariance, np.ones((3, 1))))
    assert reported == pytest.approx(values)
    assert np.allclose(spread, covariance)
    assert doubts == pytest.approx(np.ones((3, 1)))


def test_given_and_missing_parameters_stay_so_in_the_pool() -> None:
    made = make_outcome(of=make_window())
    assert made.estimate is not None
    values, covariance = made.estimate.values.copy(), made.estimate.covariance.copy()
    values[:2] = covariance[:2, :] = covariance[:, :2] = np.nan
    covariance[2, :] = covariance[:, 2] = 0.0
    deaf = replace(made.estimate, values=freeze_array(values), covariance=freeze_array(covariance), given=("K",))
    members = [build_pool_member(made.window, deaf, place) for place in range(3)]
    found = pool_estimates(members, deaf, estimate_between_window_variance(members))
    assert np.isnan(found.values[:2]).all()
    assert (found.get_value("K"), found.get_std("K")) == (0.8, 0.0)
    assert found.get_std("Jt") < deaf.get_std("Jt")


def test_friction_sum_at_one_speed_is_more_certain_than_its_parts() -> None:
    assert FIRST is not None
    reported = replace(
        FIRST, values=freeze_array(list(BENCH.as_dict().values())), covariance=freeze_array(build_covariance_at(RAPID))
    )
    known = estimate_friction_at(reported, RAPID)
    assert known is not None
    assert known[0] == pytest.approx(5.0 + 0.05 * RAPID)
    assert known[1] == pytest.approx(0.01, rel=0.01)
    assert reported.get_std("Cd") > 5 * known[1]
    unknown = replace(reported, values=freeze_array([*reported.values[:4], np.nan, 5.0]))
    assert estimate_friction_at(unknown, RAPID) is None


def test_inconsistent_term_does_not_distort_other_parameters() -> None:
    """Two speeds separate a resonance by twenty deviations; Jt, which correlates with it, must not change."""
    assert FIRST is not None
    names = (*PARAMETERS, "resonance")
    plain = draw_windows(np.random.default_rng(6), [BENCH] * 8, [RAPID] * 8)
    members = []
    for place, one in enumerate(plain):
        own = np.zeros((7, 7))
        own[:6, :6], own[6, 6] = one.own, 1.0
        own[3, 6] = own[6, 3] = 0.95 * np.sqrt(one.own[3, 3])
        values = np.array([*one.values, 100.0 if place < 4 else 120.0])
        members.append(PoolMember(names, values, own, np.zeros((7, 6)), place, one.direction))
    apart = estimate_between_window_variance(members)
    assert apart.scatter["resonance"] == pytest.approx(100.0, rel=0.3)  # 10 Hz to each side
    found = pool_estimates(members, FIRST, apart, joining=False)
    assert abs(found.get_value("Jt") - BENCH.Jt) < 3 * found.get_std("Jt")
    assert found.get_std("resonance") > 2.0
