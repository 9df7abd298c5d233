"""A value that a search has found, with the derivatives of a function; and work skipped only where nobody needs it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler._jax.anywhere import anywhere, where_needed
from jeuler._jax.found import found


def square_root(a):
    """By bisection, without derivative; its derivatives are those of a power."""
    low, high = jax.lax.fori_loop(0, 60, lambda _, s: _halved(*s, jax.lax.stop_gradient(a)), (0.0 * a, a + 1.0))
    return found((low + high) / 2, lambda: a**0.5)


def _halved(low, high, a):
    middle = (low + high) / 2
    below = middle * middle < a
    return jnp.where(below, middle, low), jnp.where(below, high, middle)


def in_a_scan(a):
    return jax.lax.scan(lambda x, _: (square_root(x) * a, None), a, length=3)[0]


def power(a):
    return a ** (1 / 8 + 1 + 1 / 2 + 1 / 4)


@pytest.mark.parametrize(
    "derivative",
    [
        lambda f: f,
        jax.grad,
        lambda f: jax.grad(jax.grad(f)),
        lambda f: jax.jacfwd(jax.jacfwd(f)),
        lambda f: jax.hessian(f),
    ],
)
def test_a_found_value_has_the_derivatives_of_its_function(derivative):
    a = jnp.array([0.5, 1.0, 3.0])
    for f in (jax.vmap(derivative(in_a_scan)), jax.jit(jax.vmap(derivative(in_a_scan)))):
        np.testing.assert_allclose(f(a), jax.vmap(derivative(power))(a), rtol=1e-11)


def test_anywhere_is_one_answer_for_a_batch():
    def f(x):
        return jax.lax.cond(anywhere(x > 1), jnp.sin, jnp.cos, x)

    x = jnp.array([0.0, 1.0, 2.0])
    np.testing.assert_allclose(jax.vmap(f)(x), jnp.sin(x))
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(f)))(x[:2]), -jnp.sin(x[:2]))
    assert "select_n" not in str(jax.make_jaxpr(jax.vmap(f))(x))


def test_work_is_done_for_the_members_that_need_it_alone():
    def one(x):
        return where_needed(x > 1, lambda x: (10 * x, jnp.sin(x)), (x, jnp.zeros_like(x)), x)

    x = jnp.array([0.5, 2.0, 1.0])
    for first, second in (jax.vmap(one)(x), jax.jit(jax.vmap(one))(x)):
        np.testing.assert_allclose(first, [0.5, 20.0, 1.0])
        np.testing.assert_allclose(second, [0.0, np.sin(2.0), 0.0])
    np.testing.assert_allclose(jax.vmap(one)(jnp.zeros(2))[0], 0)
