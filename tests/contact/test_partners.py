"""Rows of particles for the partners of pairs: slices say what gathers and scatters say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Collisions
from jeuler.contact.partners import AMONG, BY_SLICES, add, least, most, put, rows

INDICES = [(0,), (3,), (2, 0), (1, 1), (0, 3, 3), (3, 1, 0)]


@pytest.mark.parametrize("shape", [(), (2,)], ids=["a number each", "a vector each"])
@pytest.mark.parametrize("k", INDICES, ids=str)
def test_slices_are_gathers_and_scatters_and_have_their_derivatives(k, shape):
    random = np.random.default_rng(0)
    y, of_pairs = (jnp.asarray(random.normal(size=(length, *shape))) for length in (4, len(k)))
    for function in (lambda y, k, _: rows(y, k), add, least, most):
        by_slices, by_index = (
            lambda y, of_pairs, k=k, function=function: function(y, k, of_pairs) for k in (k, jnp.array(k))
        )
        np.testing.assert_allclose(by_slices(y, of_pairs), by_index(y, of_pairs), rtol=1e-15)
        for derivative in (jax.jacfwd, jax.jacrev):
            jacobians = [derivative(by, (0, 1))(y, of_pairs) for by in (by_slices, by_index)]
            for own, other in zip(*jacobians, strict=True):
                np.testing.assert_allclose(own, other, rtol=1e-15)


@pytest.mark.parametrize(
    "which", [(False, False, False), (True, False, False), (False, False, True), (True, False, True)]
)
def test_only_what_is_chosen_is_put(which):
    y, of_pairs, k = jnp.arange(4.0), jnp.array([10.0, 20.0, 30.0]), (3, 3, 0)
    expected = np.array(y)
    for particle, value, chosen in zip(k, of_pairs, which, strict=True):
        expected[particle] = value if chosen else expected[particle]
    for indices in (k, jnp.array(k)):
        np.testing.assert_array_equal(put(y, indices, of_pairs, jnp.array(which)), expected)


@pytest.mark.parametrize("far", [0, 1, 2])
def test_runs_with_slices_are_runs_with_indices(far):
    """Further pairs that never meet make a scene one that works by indices; what else happens is the same."""
    position = np.array([[0.1, 0.3], [0.3, 0.3], [0.53, 0.35], *[[9.0 + 3 * k, 0.0] for k in range(BY_SLICES)]])
    velocity = np.zeros_like(position)
    velocity[:3] = [[1.0, 0.0], [0.0, 0.0], [-0.5, 0.0]]
    pairs = [(0, 1), (2, 1), (0, 2)][: 3 - far]

    def end(x, v, pairs):
        floor = jeuler.Plane([0.0, 0.0], [0.0, 1.0])
        contact = Collisions((floor,), pairs, radius=0.1, restitution=0.5, friction=0.3)
        scene = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (contact,))
        return jeuler.simulate(scene, jeuler.ParticleState(x, v), dt=0.02, num_steps=20).y.position[-1]

    further = [(3 + k, 4 + k) for k in range(BY_SLICES - 1)] + [(0, 3), (1, 4)]
    values = [end(position, velocity, p) for p in (pairs, pairs + further)]
    np.testing.assert_allclose(*values, rtol=1e-13, atol=1e-13)
    slopes = [
        jax.jacrev(lambda x, v: jnp.sum(end(x, v, p)[:3] ** 2), (0, 1))(position, velocity)  # noqa: B023
        for p in (pairs, pairs + further)
    ]
    for own, other in zip(*slopes, strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-11)


def test_one_pair_among_many_particles_does_not_take_a_slice_of_each():
    def size(particles):
        zero = jnp.zeros((particles, 2))

        def end(x):
            scene = jeuler.Scene(effects=(Collisions(pairs=[(0, 1)], radius=0.1),))
            return jeuler.simulate(scene, jeuler.ParticleState(x, zero), dt=0.1, num_steps=1).y.position

        return str(jax.make_jaxpr(end)(zero)).count("\n")

    assert size(AMONG) > 0
    assert size(20 * AMONG) < 1.2 * size(AMONG + 1)


@pytest.mark.parametrize(("pairs", "rounds"), [(0, 8), (1, 191), (32, 191), (33, 32)])
def test_rounds_of_impacts_by_the_number_of_pairs(pairs, rounds):
    """A ball between two walls that it meets as often as it takes: what is left is counted once."""
    walls = (jeuler.Plane([0.0, 0.0], [1.0, 0.0]), jeuler.Plane([1.0, 0.0], [-1.0, 0.0]))
    others = 50.0 + np.arange(pairs + 1.0)[:, None] * np.array([0.0, 3.0])
    position = jnp.concatenate([jnp.array([[0.5, 0.0]]), jnp.asarray(others)])
    velocity = jnp.zeros_like(position)

    @jax.jit
    def left(speed):
        walled = Collisions(walls, [(1 + k, 2 + k) for k in range(pairs)], restitution=1.0)
        state = jeuler.ParticleState(position, velocity.at[0, 0].set(speed))
        alive = jeuler.simulate(jeuler.Scene(effects=(walled,)), state, dt=1.0, num_steps=1)
        return alive.unresolved_contacts

    assert left(rounds + 0.25) == 0
    assert left(rounds + 1.25) == 1
