"""The small symmetric matrices of the normal equations, compared with numpy's factorisations."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.identification.normal_equations import compute_inverse_root, invert_symmetric, solve_least_squares


@pytest.mark.parametrize("k", [1, 2, 3, 6, 7])
def test_inverse_and_condition_match_numpy(k: int) -> None:
    rng = np.random.default_rng(k)
    phi = rng.standard_normal((60, k)) @ rng.standard_normal((k, k)) * 10.0 ** rng.uniform(-5, 5, k)
    inverse, condition = invert_symmetric(phi.T @ phi)
    lengths = np.sqrt((phi * phi).sum(axis=0))
    unit = phi / lengths
    np.testing.assert_allclose(inverse * np.outer(lengths, lengths), np.linalg.inv(unit.T @ unit), rtol=1e-8)
    assert condition == pytest.approx(np.linalg.cond(unit), rel=1e-8)
    root = compute_inverse_root(phi.T @ phi)
    np.testing.assert_allclose(root @ root.T, inverse, rtol=1e-10)


def test_direction_without_power_is_excluded() -> None:
    phi = np.column_stack([np.ones(9), np.arange(9.0), 2 * np.arange(9.0)])
    inverse, condition = invert_symmetric(phi.T @ phi)
    gram = phi.T @ phi
    assert not condition < 1e7
    np.testing.assert_allclose(gram @ inverse @ gram, gram, atol=1e-6)
    theta, _ = solve_least_squares(phi, phi @ np.array([3.0, 1.0, 2.0]))
    np.testing.assert_allclose(phi @ theta, phi @ np.array([3.0, 1.0, 2.0]), atol=1e-6)


def test_non_finite_matrix_has_nan_inverse() -> None:
    inverse, condition = invert_symmetric(np.array([[1.0, np.inf], [np.inf, 2.0]]))
    assert np.isnan(inverse).all()
    assert condition == np.inf
    assert (invert_symmetric(np.zeros((2, 2)))[0] == 0).all()
