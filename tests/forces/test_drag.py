"""Quadratic drag against the exact fall with terminal speed."""

import jax
import jax.numpy as jnp
import numpy as np

import jeuler


def test_fall_reaches_terminal_speed():
    """m v' = m g - c v^2 from rest: v = sqrt(m g / c) tanh(t sqrt(c g / m))."""
    mass, g, c = 2.0, 9.81, 0.3
    scene = jeuler.Scene(forces=(jeuler.Gravity([-g]), jeuler.QuadraticDrag(c)))
    run = jeuler.simulate(
        scene, jeuler.ParticleState([[0.0]], [[0.0]], mass), dt=1e-3, num_steps=3000, step=jeuler.rk4_step
    )
    exact = -np.sqrt(mass * g / c) * np.tanh(run.t * np.sqrt(c * g / mass))
    np.testing.assert_allclose(run.y.velocity[:, 0, 0], exact, atol=1e-9)


def test_rest_has_a_finite_derivative():
    drag = jeuler.QuadraticDrag(0.3)

    def force(v):
        return drag(0.0, jnp.zeros((1, 2)), v[None], jnp.ones(()))[0]

    np.testing.assert_array_equal(jax.jacrev(force)(jnp.zeros(2)), np.zeros((2, 2)))
    np.testing.assert_allclose(jax.jacrev(force)(jnp.array([3.0, 0.0])), [[-1.8, 0], [0, -0.9]])
