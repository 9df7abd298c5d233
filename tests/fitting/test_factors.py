"""Factors by the Gram matrix give what reflections give, and give way where they would not."""

import numpy as np
import pytest

from jeuler.fitting import factors


def matrix(condition, m=4000, n=30):
    random = np.random.default_rng(0)
    u, _ = np.linalg.qr(random.normal(size=(m, n)))
    v, _ = np.linalg.qr(random.normal(size=(n, n)))
    a = u * np.geomspace(1, 1 / condition, n) @ v.T
    return a / np.linalg.norm(a, axis=0), random.normal(size=(m, 2))


@pytest.mark.parametrize("condition", [1.0, 1e3, 1e8])
def test_the_least_squares_solution_is_that_of_lapack(condition):
    a, columns = matrix(condition)
    within, triangle = factors.projected(a, columns)
    gram = factors.upper_factor(a)
    assert (gram is not None) == (condition <= 1e3)
    best = np.linalg.lstsq(a, columns, rcond=None)[0]
    found = np.linalg.lstsq(triangle, within, rcond=None)[0]
    np.testing.assert_allclose(a @ found, a @ best, atol=1e-7)


@pytest.mark.parametrize("condition", [1e3, 1e8])
def test_singular_values_and_vectors(condition):
    a, _ = matrix(condition)
    left, values, vectors = factors.singular(a)
    np.testing.assert_allclose(values, np.linalg.svd(a, compute_uv=False), rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(left.T @ left, np.eye(30), atol=1e-8)
    np.testing.assert_allclose((left * values) @ vectors.T, a, atol=1e-12)


@pytest.mark.parametrize("rows", [4000, 31, 30, 12])
def test_a_column_that_is_not_finite_spoils_no_other(rows):
    a, columns = matrix(10.0)
    a, columns = a[:rows], columns[:rows].copy()
    columns[3, 1] = np.inf
    within, triangle = factors.projected(a, columns)
    assert np.isnan(within[:, 1]).all()
    np.testing.assert_allclose(triangle.T @ within[:, 0], a.T @ columns[:, 0], atol=1e-9)


@pytest.mark.parametrize(("m", "n"), [(1203, 10), (2000, 1), (8020, 44), (3, 5), (0, 3), (5, 0), (700, 100)])
def test_reflections_by_blocks_are_a_factorisation(m, n):
    a = np.random.default_rng(0).normal(size=(m, n))
    q, triangle = factors.tall_qr(a)
    np.testing.assert_allclose(q @ triangle, a, atol=1e-13)
    np.testing.assert_allclose(q.T @ q, np.eye(min(m, n)), atol=1e-13)
    np.testing.assert_array_equal(np.tril(triangle, -1), 0)
