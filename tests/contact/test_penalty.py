"""Penalty contact: the spring of the formula, its energy, its rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import PenaltyContact
from jeuler.contact.colliders import Plane


def test_force_is_minus_the_gradient_of_its_energy(random):
    contact = PenaltyContact(Plane([0.0, 0.0], [1.0, 2.0]), ks=50.0, radius=0.2)
    position = jnp.asarray(random.normal(size=(30, 2)))
    force = contact(0.0, position, jnp.zeros_like(position), jnp.asarray(1.0))
    slope = jax.grad(lambda x: contact.energy(0.0, x, None))(position)
    np.testing.assert_allclose(force, -slope, atol=1e-12)
    assert jnp.any(force != 0)
    assert jnp.any(jnp.all(force == 0, axis=-1))


def test_it_never_pulls():
    contact = PenaltyContact(Plane([0.0], [1.0]), ks=1.0, kd=100.0)
    force = contact(0.0, jnp.array([[-0.1]]), jnp.array([[5.0]]), jnp.asarray(1.0))
    assert force.item() == 0


def test_ball_settles_where_the_spring_carries_its_weight():
    scene = jeuler.Scene((jeuler.Gravity([-10.0]), PenaltyContact(Plane([0.0], [1.0]), ks=1000.0, kd=20.0)))
    state = jeuler.ParticleState([[0.1]], [[0.0]])
    end = jeuler.simulate(scene, state, dt=1e-3, num_steps=3000, save_every=3000, step=jeuler.symplectic_euler_step)
    np.testing.assert_allclose(end.y.position[-1], -10 / 1000, rtol=1e-6)


def test_gradient_through_a_bounce_is_that_of_the_spring():
    """d(height at 0.6 s)/d(height at 0) of an elastic ball from 0.6 m, against finite differences."""
    scene = jeuler.Scene((jeuler.Gravity([-10.0]), PenaltyContact(Plane([0.0], [1.0]), ks=1e4)))

    @jax.jit
    def end(height):
        state = jeuler.ParticleState(height[None, None], jnp.zeros((1, 1)))
        run = jeuler.simulate(scene, state, dt=1e-3, num_steps=600, save_every=600, step=jeuler.symplectic_euler_step)
        return run.y.position[-1, 0, 0]

    h = 1e-7
    difference = (end(jnp.array(0.6 + h)) - end(jnp.array(0.6 - h))) / (2 * h)
    np.testing.assert_allclose(jax.grad(end)(jnp.array(0.6)), difference, rtol=1e-5)


def test_bad_shape():
    scene = jeuler.Scene((PenaltyContact(Plane([0.0], [1.0]), ks=[1.0, 2.0]),))
    with pytest.raises(ValueError, match=r"PenaltyContact\.ks must have shape"):
        jeuler.simulate(scene, jeuler.ParticleState([[0.1]], [[0.0]]), dt=0.1, num_steps=1)
