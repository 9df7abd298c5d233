"""Rows of uniform numbers, against the uniform distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jeuler._jax.random_rows import uniform_rows

KEY = jax.random.key(11)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("impl", ["threefry2x32", "rbg"])
def test_rows_are_uniform_and_independent_of_each_other_and_of_who_else_is_there(impl, dtype):
    key = jax.random.key(2, impl=impl)
    u = uniform_rows(key, [5, 2**32 - 1], 3000, dtype)
    assert (u.shape, u.dtype) == ((2, 3000), dtype)
    assert np.array_equal(uniform_rows(key, [7, 2**32 - 1, 0], 3000, dtype)[1], u[1])
    assert all(scipy.stats.kstest(np.asarray(row), scipy.stats.uniform.cdf).pvalue > 0.01 for row in u)
    assert scipy.stats.spearmanr(*np.asarray(u)).pvalue > 0.01
    assert scipy.stats.spearmanr(u[0, 1:], u[0, :-1]).pvalue > 0.01


def test_numbers_of_double_precision_use_all_their_bits():
    u = np.asarray(uniform_rows(KEY, [1], 1000, jnp.float64))
    assert np.any(u * 2**52 % 2**30 != 0)
    assert np.array_equal(u * 2**52, np.floor(u * 2**52))
