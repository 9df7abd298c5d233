"""The last places of each particle, whatever moved it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Collisions, DistanceLinks, Emitter, Gravity, Lifetime, Plane, Scene, Trail, simulate

DT = 0.1
FLOOR = Plane([0.0, 0.0], [0.0, 1.0])


MOVED = {
    "freely": {},
    "backwards": {"dt": -DT},
    "on a floor, touching": {"effects": (Collisions((FLOOR,), radius=0.4, restitution=0.5, pairs=[[0, 1]]),)},
    "at a rod": {"effects": (DistanceLinks([[0, 1]], 2.0),)},
    "by an implicit step": {"step": jeuler.implicit_euler_step},
    "by the midpoint rule": {"step": jeuler.implicit_midpoint_step},
}


@pytest.mark.parametrize(("every", "dtype"), [(1, jnp.float32), (3, jnp.float64)])
@pytest.mark.parametrize("how", MOVED)
def test_the_places_are_those_of_the_run(how, every, dtype):
    position, velocity = jnp.array([[0.0, 0.4], [2.0, 0.4]], dtype), jnp.array([[1.0, -3.0], [0.5, 0.0]], dtype)
    state = jeuler.ParticleState(position, velocity)
    how = {"dt": DT, "effects": ()} | MOVED[how]
    scene = Scene((Gravity([0.0, -9.81]),), (*how.pop("effects"), Trail(4, every)))
    y = simulate(scene, state, num_steps=14, **how).y
    for n in range(15):
        last = every * ((n - 1) // every)  # the start of the step of the last sample
        places = [y.position[max(last - k * every, 0)] for k in range(4)] if n else [y.position[0]] * 4
        found = y.position[n][:, None] + y.trail[n]
        np.testing.assert_allclose(
            found, np.stack(places, axis=1), rtol=1e-5 if dtype == jnp.float32 else 1e-12, atol=1e-6
        )


def test_a_run_that_goes_on_from_another_has_the_same_trail():
    state, scene = (
        jeuler.ParticleState(jnp.zeros((1, 2)), jnp.ones((1, 2))),
        Scene((Gravity([0.0, -9.81]),), (Trail(3, 2),)),
    )
    whole = simulate(scene, state, dt=DT, num_steps=7).y
    half = jax.tree.map(lambda x: x[-1], simulate(scene, state, dt=DT, num_steps=3).y)
    np.testing.assert_allclose(simulate(scene, half, dt=DT, num_steps=4).y.trail[-1], whole.trail[-1], rtol=1e-12)


def test_a_newborn_in_the_slot_of_one_that_died_in_the_step_has_a_trail_of_its_own():
    jet = Emitter(0.0, [5.0, 5.0], [1.0, 0.0], bursts=((0.3, 1),))
    state = jeuler.ParticleState(jnp.zeros((1, 2)), jnp.ones((1, 2)))
    y = simulate(Scene((), (Lifetime(0.3), jet, Trail(4))), state, dt=DT, num_steps=5, key=jax.random.key(0)).y
    assert y.alive[:, 0].all()
    went = np.asarray(y.trail[5, 0] + y.position[5, 0])
    np.testing.assert_allclose(went[0], y.position[4, 0])
    assert (np.abs(went - [5.0, 5.0]) < 0.2).all()


def test_what_moves_a_particle_before_the_motion_moves_its_trail_along():
    @jeuler.uses(acts="before motion")
    def canal(t, dt, state, key):
        """That closes on itself after 2 m."""
        return state.replace(position=jnp.mod(state.position, 2.0))

    state = jeuler.ParticleState(jnp.array([[1.8]]), jnp.ones((1, 1)))
    y = simulate(Scene((), (canal, Trail(3))), state, dt=0.5, num_steps=4).y
    np.testing.assert_allclose(y.position[:, 0, 0], [1.8, 2.3, 0.8, 1.3, 1.8])
    np.testing.assert_allclose(y.trail[2:, 0, :, 0], [[-0.5, -1.0, -1.0], [-0.5, -1.0, -1.5], [-0.5, -1.0, -1.5]])


def test_a_trail_cannot_be_divided_over_devices_and_says_so():
    with pytest.raises(ValueError, match="Trail"):
        jeuler.divide(Scene((), (Trail(2),)), jeuler.ParticleState(jnp.ones((4, 2)), jnp.ones((4, 2))), devices=2)


def test_what_moves_particles_after_it_is_refused():
    with pytest.raises(ValueError, match="Trail must stand in Scene.effects last, .* wrong side of Collisions"):
        simulate(
            Scene((), (Trail(2), Collisions((FLOOR,)))), jeuler.ParticleState(jnp.ones((1, 2)), jnp.ones((1, 2))),
            dt=DT, num_steps=1,
        )  # fmt: skip
