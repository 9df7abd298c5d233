"""Rigid links: lengths to roundoff, the pendulum's equation, derivatives against differences, what has no solution."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ellipk

import jeuler
from jeuler import DistanceLinks, Gravity, ParticleState, Scene

G = 9.81


def test_a_rod_swings_as_a_pendulum():
    """To the second order with a step of the second order or above."""

    quarter = float(ellipk(0.5)) / np.sqrt(G)  # of the period, from the horizontal
    scene = Scene((Gravity([0.0, -G]),), (DistanceLinks([[0, 1]], 1.0),))
    bob = ParticleState([[0.0, 0.0], [1.0, 0.0]], jnp.zeros((2, 2)), mass=[jnp.inf, 2.0])

    def error(n):
        x = jeuler.simulate(scene, bob, dt=quarter / n, num_steps=n, step=jeuler.rk4_step).y.position[:, 1]
        np.testing.assert_allclose(jnp.linalg.norm(x, axis=1), 1, atol=1e-10)
        return abs(jnp.arctan2(x[-1, 0], -x[-1, 1]))

    assert 3.7 < error(100) / error(200) < 4.3
    assert error(200) < 1e-3


def rope(g, length):
    """The end of a rope of 4 links after a while, and the whole run."""
    x = np.stack([np.arange(5) / 4, np.zeros(5)], axis=1)
    scene = Scene((Gravity(jnp.array([0.0, -1.0]) * g),), (DistanceLinks([[n, n + 1] for n in range(4)], length),))
    state = ParticleState(x, 0 * x, mass=[np.inf, 0.1, 0.2, 0.1, 0.3])
    run = jeuler.simulate(scene, state, dt=0.01, num_steps=30, step=jeuler.symplectic_euler_step).y
    return jnp.sum(run.position[-1] ** 2), run


def test_a_rope_keeps_its_lengths_and_momentum_and_has_the_right_gradient():
    both = jax.jit(jax.value_and_grad(rope, (0, 1), has_aux=True))
    (_, run), slope = both(G, 0.25)
    np.testing.assert_allclose(jnp.linalg.norm(jnp.diff(run.position, axis=1), axis=2), 0.25, atol=1e-10)
    rate = jnp.sum(jnp.diff(run.position, axis=1) * jnp.diff(run.velocity, axis=1), axis=2)
    np.testing.assert_allclose(rate[1:], 0, atol=1e-9)
    assert run.unresolved_links[-1] == 0
    np.testing.assert_allclose(slope[0], (both(G + 1e-5, 0.25)[0][0] - both(G - 1e-5, 0.25)[0][0]) / 2e-5, rtol=1e-6)
    np.testing.assert_allclose(slope[1], (both(G, 0.25 + 1e-6)[0][0] - both(G, 0.25 - 1e-6)[0][0]) / 2e-6, rtol=1e-5)


def run_links(edges, length, state, **options):
    scene = Scene((), (DistanceLinks(edges, length),))
    return jeuler.simulate(scene, state, dt=1e-3, num_steps=20, **options).y


def test_links_that_say_the_same_hold_and_links_that_contradict_each_other_are_counted():
    square = [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]]
    corners = ParticleState(
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0], [0.3, 0]]
    )
    long = np.array([1.0, 1.0, 1.0, 1.0, np.sqrt(2), np.sqrt(2)])
    run = run_links(square, long, corners)
    ends = run.position[-1][np.array(square)]
    np.testing.assert_allclose(jnp.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), long, atol=1e-10)
    assert run.unresolved_links[-1] == 0
    wrong = run_links(square, long + np.array([0, 0, 0, 0, 0, 3.0]), corners)
    assert wrong.unresolved_links.tolist() == list(range(21)), "in each step"
    pinned = corners.replace(mass=jnp.full(4, jnp.inf))
    assert run_links(square, long, pinned).unresolved_links[-1] == 0
    np.testing.assert_array_equal(run_links(square, long, pinned).position[-1], corners.position)
