"""Arithmetic on pytrees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler._core import trees

LEAVES = {
    "two of one shape": lambda lost: (jnp.array([1.0, lost]), jnp.zeros(2)),
    "of several shapes": lambda lost: (jnp.zeros((3, 2)), jnp.array(lost), jnp.zeros(2)),
    "with integers": lambda lost: (jnp.arange(2), jnp.array([lost, 1.0])),
    "complex": lambda lost: (jnp.array([1.0, complex(0.0, lost)]), jnp.zeros(2)),
    "half precision": lambda lost: (jnp.array([1.0, lost], jnp.float16), jnp.zeros(2)),
    "many": lambda lost: (jnp.full(100_000, 3e38, jnp.float32).at[77].set(lost),),
}


@pytest.mark.parametrize("name", LEAVES)
@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf])
def test_one_number_that_is_not_finite_is_found(name, lost):
    for all_finite in (trees.all_finite, jax.jit(trees.all_finite)):
        assert all_finite(LEAVES[name](1.0))
        assert not all_finite(LEAVES[name](lost))


def test_where_there_are_no_numbers_all_are_finite():
    assert trees.all_finite(())
    assert trees.all_finite((jnp.zeros((0, 3)),))


def test_leaves_of_one_shape_are_one_sum():
    program = str(jax.make_jaxpr(trees.all_finite)((jnp.zeros(5),) * 6))
    assert program.count("reduce_sum") == 1
    assert "reduce_and" not in program
