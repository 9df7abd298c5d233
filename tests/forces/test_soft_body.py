"""Shape matching of flat and collapsed bodies: the derivative of the rotation, where there is one."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.forces.soft_body import turning

BODY = 6


@functools.cache
def end_of(dim, step):
    """Forward, reverse and finite differences along one direction of the end of eight steps, as one program."""

    @jax.jit
    def measure(rest, p, v, weights, along, h):
        def end(p):
            body = jeuler.ShapeMatching(range(BODY), rest, 10.0, 1.0)
            run = jeuler.simulate(jeuler.Scene((body,)), jeuler.ParticleState(p, v), dt=0.01, num_steps=8, step=step)
            return jnp.sum(weights * run.y.position[-1])

        difference = (end(p + h * along) - end(p - h * along)) / (2 * h)
        return jnp.sum(jax.grad(end)(p) * along), jax.jvp(end, (p,), (along,))[1], difference

    return measure


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("shape", ["full", "flat body", "flat body and rest shape"])
def test_derivatives_agree_with_finite_differences(dim, shape):
    for seed in range(4):
        random = np.random.default_rng(seed)
        rest, p, v, weights, along = (random.normal(size=(BODY, dim)) for _ in range(5))
        if shape != "full":
            p[:, -1] = -0.5
        if "rest" in shape:
            rest[:, -1] = 0.0
        reverse, forward, difference = end_of(dim, jeuler.heun_step)(rest, p, v, weights, along, 1e-5)
        np.testing.assert_allclose(reverse, forward, rtol=1e-9)
        np.testing.assert_allclose(reverse, difference, rtol=2e-6)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("place", [0.0, 1.0, -0.3])
def test_collapsed_body_has_gradients_of_its_own_size(dim, place):
    rest, p = np.random.default_rng(1).normal(size=(BODY, dim)), np.full((BODY, dim), place)
    reverse, forward, _ = end_of(dim, jeuler.heun_step)(rest, p, 0 * p, rest, rest[::-1], 1e-5)
    assert abs(reverse) < 100
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_turning_solves_its_equation(dim, random):
    s, w = random.normal(size=(dim, dim)), random.normal(size=(dim, dim))
    s, w = s @ s.T, w - w.T
    found = turning(jnp.asarray(s), jnp.asarray(s @ w + w @ s))
    np.testing.assert_allclose(found, w, atol=1e-12)
    np.testing.assert_array_equal(found, -found.T)


def test_turning_of_a_straight_body_leaves_out_the_turning_about_its_line():
    line = jnp.outer(jnp.arange(3.0), jnp.array([1.0, 0.0, 0.0]))
    w = jnp.array([[0.0, 1.0, 2.0], [-1.0, 0.0, 3.0], [-2.0, -3.0, 0.0]])
    s = line.T @ line
    np.testing.assert_allclose(turning(s, s @ w + w @ s), w.at[1, 2].set(0).at[2, 1].set(0), atol=1e-12)
