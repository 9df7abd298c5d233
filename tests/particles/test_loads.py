"""Forces that can be read: against weights, differences and the equation of motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FORCES, IN_SPACE, net_state, path

import jeuler
from jeuler import Scene

G = 9.8
HANGING = jeuler.ParticleState([[0.0, 0.0], [0.0, -1.5], [0.0, -2.2]], jnp.zeros((3, 2)), mass=[jnp.inf, 2.0, 3.0])
WEIGHTS = (
    jeuler.Springs([[0, 1], [1, 2]], ks=[98.0, 147.0], kd=0.0, rest_length=[1.0, 0.5]),
    jeuler.Gravity([0.0, -G]),
)


def test_a_support_carries_the_weight_and_springs_their_tensions():
    scene = Scene(WEIGHTS)
    np.testing.assert_allclose(scene.force(0.0, HANGING), [[0, -5 * G], [0, 0], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(scene.reactions(0.0, HANGING), [[0, 5 * G], [0, 0], [0, 0]], atol=1e-12)
    springs = scene.forces[0]
    np.testing.assert_allclose(springs.tension(0.0, HANGING), [5 * G, 3 * G])
    np.testing.assert_allclose(springs.strain(0.0, HANGING), [0.5, 0.4])
    np.testing.assert_allclose(jnp.sum(springs.stored_energy(0.0, HANGING)), springs.energy(0.0, HANGING.position, 1.0))
    assert np.isnan(jeuler.Springs([[0, 1]], 1.0, 0.0, 0.0).strain(0.0, HANGING)).all(), "no length, no strain"


def test_forces_by_name_add_up_to_the_equation_of_motion():
    """All forces of the plane at once, and a second gravity."""
    state = net_state()
    scene = Scene((*(make() for name, make in FORCES.items() if name not in IN_SPACE), jeuler.Gravity([1.0, 2.0])))

    @jax.jit
    def read(state):
        _, acceleration = scene.vector_field(0.3, (state.position, state.velocity), state.mass)
        return scene.force(0.3, state), scene.forces_by_name(0.3, state), scene.reactions(0.3, state), acceleration

    force, each, reactions, acceleration = read(state)
    assert len(each) == len(scene.forces)
    without_edges = f"Springs[{sum(type(make()) is jeuler.Springs for make in FORCES.values()) - 1}]"
    assert {"Gravity[0]", "Gravity[1]", without_edges, "Bending"} <= {*each}
    np.testing.assert_allclose(sum(each.values()), force, atol=1e-12)
    np.testing.assert_array_equal(each[without_edges], 0, err_msg="springs without edges")
    moving = jnp.isfinite(state.mass)
    np.testing.assert_allclose(force[moving], (state.mass[:, None] * acceleration)[moving], atol=1e-12)
    np.testing.assert_allclose(reactions, jnp.where(moving[:, None], 0, -force), atol=1e-12)


def test_a_whole_run_is_read_by_vmap_and_a_load_has_a_gradient():
    @jax.jit
    def load(ks):  # of a cell at the pinned particle, over time
        scene = Scene((jeuler.Springs([[0, 1]], ks=ks, kd=0.7, rest_length=1.0),))
        run = jeuler.simulate(scene, HANGING, dt=0.01, num_steps=2)
        return jax.vmap(scene.force)(run.t, run.y)[:, 0, 1]

    slope = jax.jacfwd(load)(50.0)
    np.testing.assert_allclose(slope, (load(50.001) - load(49.999)) / 0.002, rtol=1e-6, atol=1e-9)


def test_a_prescribed_particle_is_pushed_along_its_path():
    scene = Scene((jeuler.Gravity([0.0, -G]),), (jeuler.PrescribedMotion([1], path),))
    state = net_state()
    rate = np.array([-4 * 0.3 * np.sin(1.0), 0.0])  # of `path` at 0.5 s
    np.testing.assert_allclose(scene.reactions(0.5, state)[1], state.mass[1] * (rate + np.array([0.0, G])), rtol=1e-6)


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.implicit_euler_step])
def test_what_acted_in_a_step_has_changed_the_momentum(step):
    """Drag that a long step limits, and a speed limit, included."""
    forces, effects = (jeuler.Gravity([0.0, -G]), jeuler.LinearDrag(80.0)), (jeuler.SpeedLimit(0.4),)
    state = net_state().replace(force=jnp.zeros((4, 2)))
    run = jeuler.simulate(Scene(forces, effects), state, dt=0.05, num_steps=3, step=step)
    gained = np.diff(run.y.velocity, axis=0)[:, 1:] * np.asarray(state.mass)[1:, None]
    np.testing.assert_allclose(run.y.force[1:, 1:] * 0.05, gained, atol=1e-12)
    assert not run.y.force[1:, 0].any(), "nothing pulls at the pinned one"


def test_what_acted_keeps_its_digits_in_single_precision():
    state = jeuler.ParticleState(np.zeros((1, 1), np.float32), np.full((1, 1), 1000, np.float32))
    state = state.replace(force=jnp.zeros_like(state.position))
    run = jeuler.simulate(Scene((jeuler.Gravity([-1e-3]),)), state, dt=1e-3, num_steps=2)
    np.testing.assert_allclose(run.y.force[1:, 0, 0], -1e-3, rtol=1e-6)


def test_dead_slots_feel_nothing():
    state = net_state().replace(alive=jnp.array([True, False, True, True]), force=jnp.zeros((4, 2)))
    scene = Scene((FORCES["springs"](), jeuler.Gravity([0.0, -G])), (jeuler.SpeedLimit(5.0),))
    assert not scene.force(0.0, state)[1].any()
    assert not scene.forces[0].tension(0.0, state)[np.array([0, 1])].any(), "those two have a dead end"
    assert not jeuler.simulate(scene, state, dt=0.01, num_steps=2).y.force[:, 1].any()


def test_a_state_with_times_is_refused_with_the_way_to_read_it():
    run = jeuler.simulate(Scene(WEIGHTS), HANGING, dt=0.01, num_steps=2)
    with pytest.raises(ValueError, match="jax.vmap"):
        Scene(WEIGHTS).force(run.t, run.y)
    with pytest.raises(ValueError, match="zeros_like"):
        jeuler.simulate(Scene(WEIGHTS), HANGING.replace(force=jnp.zeros(3)), dt=0.01, num_steps=2)


def test_a_damper_is_read_as_its_end_moves_along_a_path():
    """A hand of infinite mass that is prescribed has a velocity, which a run saves and a damper feels."""
    springs = jeuler.Springs([[0, 1]], ks=20.0, kd=3.0, rest_length=0.5)
    scene = Scene((springs,), (jeuler.PrescribedMotion([0], path),))
    state = jeuler.ParticleState([[0.0, 0.0], [1.0, 0.0]], jnp.zeros((2, 2)), mass=[jnp.inf, 1.0])
    run = jeuler.simulate(scene, state, dt=0.01, num_steps=20)
    t, last = run.t[-1], jax.tree.map(lambda x: x[-1], run.y)
    assert np.linalg.norm(last.velocity[0]) > 0.1
    d = last.position[1] - last.position[0]
    pull = -scene.force(t, last)[1] @ d / np.linalg.norm(d)
    np.testing.assert_allclose(springs.tension(t, last), [pull], rtol=1e-12)
    np.testing.assert_allclose(jeuler.observing.SpringForce()(t, scene, last), [pull], rtol=1e-12)
    rate = (last.velocity[1] - last.velocity[0]) @ d / np.linalg.norm(d)
    np.testing.assert_allclose(springs.damper_power(t, last), [3.0 * rate**2], rtol=1e-12)
