"""Scenes and runs: every force and effect against the contract, diffrax and conservation laws."""

import dataclasses
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    CENTRAL_FORCES,
    EFFECTS,
    FORCES,
    INTERNAL_FORCES,
    METHODS,
    NET_EDGES,
    force_state,
    leapfrog_step,
    net_scene,
    net_state,
)

import jeuler
from jeuler import ParticleState, Scene
from jeuler._jax.haste import jit_in_haste
from jeuler.particles.fields import with_required_fields

RUN = {"dt": 0.01, "num_steps": 50}


def final_position(scene, state=None, **kwargs):
    return jeuler.simulate(scene, net_state() if state is None else state, **{**RUN, **kwargs}).y.position[-1]


def derivatives(loss, x):
    """Value, and its derivative in reverse and in forward mode."""
    return *jax.value_and_grad(loss)(x), jax.jacfwd(loss)(x)


@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_force_keeps_shape_and_dtype(name, dtype):
    state = force_state(name, dtype)
    part = jeuler.Scene(forces=(FORCES[name](),)).forces[0]
    force = jit_in_haste(part, "great")(jnp.asarray(0.3, dtype), state.position, state.velocity, state.mass)
    assert (force.shape, force.dtype) == (state.position.shape, dtype)
    assert np.isfinite(force).all()


@pytest.mark.parametrize("name", FORCES)
def test_force_under_jit_vmap_and_grad(name):
    state = force_state(name)
    force = jeuler.Scene(forces=(FORCES[name](),)).forces[0]

    def loss(scale):
        return jnp.sum(force(0.3, scale * state.position, scale * state.velocity, state.mass) ** 2)

    h, at = 1e-6, np.array([0.9, 1.1])
    batch, value, slope, forward = jit_in_haste(lambda x: (jax.vmap(loss)(x), *derivatives(loss, x[1])), "great")(at)
    np.testing.assert_allclose(batch, [loss(0.9), loss(1.1)], rtol=1e-12)
    np.testing.assert_allclose(value, batch[1], rtol=1e-12)
    np.testing.assert_allclose(slope, (loss(1.1 + h) - loss(1.1 - h)) / (2 * h), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(forward, slope, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("name", INTERNAL_FORCES)
def test_action_equals_reaction(name):
    state = force_state(name)
    force = FORCES[name]()(0.0, state.position, state.velocity, state.mass)
    np.testing.assert_allclose(jnp.sum(force, axis=0), 0, atol=1e-12)
    if name in CENTRAL_FORCES:
        torque = state.position[:, 0] * force[:, 1] - state.position[:, 1] * force[:, 0]
        np.testing.assert_allclose(jnp.sum(torque), 0, atol=1e-12)
    moved = FORCES[name]()(0.0, state.position + 3.0, state.velocity + 2.0, state.mass)
    np.testing.assert_allclose(moved, force, atol=1e-11, err_msg="only differences count")


@pytest.mark.parametrize("name", ["gravity", "springs", "springs_without_length"])
def test_force_is_minus_the_gradient_of_its_energy(name):
    part, state = FORCES[name](), net_state()
    mass = jnp.array([3.0, 1.0, 2.0, 0.5])
    if hasattr(part, "kd"):
        part = dataclasses.replace(part, kd=0.0)
    slope = jax.grad(lambda p: part.energy(0.0, p, mass))(state.position)
    np.testing.assert_allclose(part(0.0, state.position, state.velocity, mass), -slope, atol=1e-10)


def effect_scene(name, ks=30.0):
    """A net of springs with the effect, and a state that holds it: where there are births, one slot is free."""
    row = EFFECTS[name]
    springs = jeuler.Springs(NET_EDGES, ks=ks, kd=0.7, rest_length=0.9)
    scene = jeuler.Scene((springs,), (*row.needs, row.make()))

    def state(dtype=jnp.float64):
        alive = {"alive": jnp.array([True, True, True, False])} if "births" in row.fields else {}
        return net_state(dtype).replace(**alive)

    return scene, state


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_effect_keeps_structure_shapes_and_dtypes(name, dtype):
    scene, state = effect_scene(name)
    before = with_required_fields(state(dtype), scene.forces, scene.effects)
    of = jnp.asarray(0.4, dtype), jnp.asarray(0.1, dtype), before, jax.random.key(0)
    after = jax.eval_shape(scene.effects[-1], *of)  # compiled runs are below
    assert jax.tree.structure(after) == jax.tree.structure(before)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)


@pytest.mark.parametrize("name", EFFECTS)
def test_effect_under_jit_vmap_and_grad(name):
    _, state = effect_scene(name)

    def loss(ks):
        scene, _ = effect_scene(name, ks)
        end = jeuler.simulate(scene, state(), dt=0.02, num_steps=10, save_every=10, key=jax.random.key(0))
        return jnp.sum(end.y.position[-1] ** 2)

    h, at = 1e-4, np.array([20.0, 30.0])
    batch, value, slope = jit_in_haste(lambda x: (jax.vmap(loss)(x), *jax.value_and_grad(loss)(x[1])), "great")(at)
    np.testing.assert_allclose(batch, [loss(20.0), loss(30.0)], rtol=1e-12)
    np.testing.assert_allclose(value, batch[1], rtol=1e-12)
    difference = (loss(30.0 + h) - loss(30.0 - h)) / (2 * h)
    assert difference != 0
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_vector_field_drops_into_diffrax():
    grid = jnp.arange(51) * 0.01
    state = net_state()

    def theirs(scene):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(scene.vector_field),
            diffrax.Euler(),
            grid[0],
            grid[-1],
            None,
            (state.position, state.velocity),
            args=state.mass,
            stepsize_controller=diffrax.StepTo(grid),
            saveat=diffrax.SaveAt(ts=grid),
            adjoint=diffrax.DirectAdjoint(),
        ).ys[0]

    def ours(scene):
        return jeuler.simulate(scene, state, **RUN).y.position

    np.testing.assert_allclose(ours(net_scene()), theirs(net_scene()), rtol=1e-12, atol=1e-12)
    mine, reference = (jax.grad(lambda s, run=run: jnp.sum(run(s) ** 2))(net_scene()) for run in (ours, theirs))
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(reference), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


def test_scene_is_a_pytree_of_floating_arrays():
    leaves = jax.tree.leaves(net_scene())
    assert len(leaves) == 5
    assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)
    springs = jeuler.Springs([[0, 1]], ks=3, kd=[1], rest_length=np.float32(2))
    assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(springs))


def test_gradient_with_respect_to_a_whole_scene_is_a_scene():
    slope = jax.jit(jax.grad(lambda scene: jnp.sum(final_position(scene) ** 2)))(net_scene())
    assert isinstance(slope, jeuler.Scene)
    ks, h = net_scene().forces[1].ks, 1e-5

    @jax.jit
    def loss(ks):
        scene = net_scene()
        springs = dataclasses.replace(scene.forces[1], ks=ks)
        return jnp.sum(
            final_position(dataclasses.replace(scene, forces=(scene.forces[0], springs, scene.forces[2]))) ** 2
        )

    for k in range(len(NET_EDGES)):
        step = jnp.zeros(len(NET_EDGES)).at[k].set(h)
        np.testing.assert_allclose(
            slope.forces[1].ks[k], (loss(ks + step) - loss(ks - step)) / (2 * h), rtol=1e-5, atol=1e-9
        )


def test_changing_a_parameter_does_not_trace_again():
    traces = []

    @jax.jit
    def run(scene):
        traces.append(None)
        return final_position(scene)

    for ks in (10.0, 20.0):
        run(jeuler.Scene(forces=(jeuler.Springs(NET_EDGES, ks=ks, kd=0.1, rest_length=1.0),)))
    assert len(traces) == 1


def test_pinned_particles_stay_whatever_their_velocity():
    state = dataclasses.replace(net_state(), velocity=jnp.ones((4, 2)))
    for method in METHODS.values():
        run = jeuler.simulate(net_scene(), state, **RUN, step=method.step)
        np.testing.assert_array_equal(run.y.position[:, 0], np.broadcast_to(state.position[0], (51, 2)))
        assert run.first_nonfinite == -1
    velocity, acceleration = net_scene().vector_field(0.0, (state.position, state.velocity), state.mass)
    assert not velocity[0].any()
    assert not acceleration[0].any()


@pytest.mark.parametrize("count", [0, 1])
def test_few_particles(count):
    state = jeuler.ParticleState(jnp.zeros((count, 3)), jnp.ones((count, 3)))
    scene = jeuler.Scene(forces=(jeuler.Gravity([0.0, 0.0, -10.0]), jeuler.Springs([], 1.0, 1.0, 1.0)))
    run = jeuler.simulate(scene, state, **RUN)
    assert run.y.position.shape == (51, count, 3)
    assert run.first_nonfinite == -1


def test_no_forces_is_uniform_motion():
    run = jeuler.simulate(jeuler.Scene(), net_state(), dt=0.5, num_steps=4)
    np.testing.assert_allclose(run.y.position[-1, 1:], (net_state().position + 2 * net_state().velocity)[1:])


def test_saved_state_has_one_leading_axis_everywhere():
    run = jeuler.simulate(net_scene(), net_state(), **RUN, save_every=10)
    assert [leaf.shape[0] for leaf in jax.tree.leaves(run.y)] == [6, 6, 6]
    last = jax.tree.map(lambda leaf: leaf[-1], run.y)
    again = jeuler.simulate(net_scene(), last, **RUN, t0=0.5)
    straight = jeuler.simulate(net_scene(), net_state(), dt=0.01, num_steps=100)
    np.testing.assert_allclose(again.y.position[-1], straight.y.position[-1], rtol=1e-12)


def test_effects_run_in_the_order_written_with_their_own_keys():

    def shift(t, dt, state, key):
        return dataclasses.replace(state, position=state.position + 1)

    def double(t, dt, state, key):
        return dataclasses.replace(state, position=2 * state.position)

    def draw(t, dt, state, key):
        return dataclasses.replace(state, velocity=jax.random.normal(key, state.velocity.shape))

    state = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    run = jeuler.simulate(jeuler.Scene(effects=(shift, double)), state, dt=0.1, num_steps=3)
    assert run.y.position[:, 0, 0].tolist() == [0, 2, 6, 14]

    def drawn(effects, key=3):
        return jeuler.simulate(
            jeuler.Scene(effects=effects), state, dt=0.1, num_steps=3, key=jax.random.key(key)
        ).y.velocity

    once, twice = drawn((draw,)), drawn((draw, draw))
    assert len(np.unique(once)) == 4  # the start, and another number at each step
    assert not np.isin(twice[1:], once[1:]).any()  # the second effect has a key of its own
    np.testing.assert_array_equal(once, drawn((draw,)))
    assert (once[1:] != drawn((draw,), key=4)[1:]).all()


def test_effect_time_is_the_time_reached():
    def stamp(t, dt, state, key):
        return dataclasses.replace(state, velocity=jnp.full_like(state.velocity, t))

    state = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    run = jeuler.simulate(jeuler.Scene(effects=(stamp,)), state, dt=0.25, num_steps=4, t0=1.0)
    np.testing.assert_allclose(run.y.velocity[:, 0, 0], [0, 1.25, 1.5, 1.75, 2.0])


def test_compensated_run_agrees_with_the_plain_one():
    plain, kept = (final_position(net_scene(), compensated=c) for c in (False, True))
    np.testing.assert_allclose(kept, plain, rtol=1e-12)


def test_a_step_of_ones_own_gets_arrays():
    """A leapfrog written on arrays (particle, dim) keeps the energy of an undamped net to second order."""
    scene = jeuler.Scene(forces=(dataclasses.replace(FORCES["springs"](), kd=0.0),))
    drifts = []
    for num_steps in (200, 400):
        run = jeuler.simulate(scene, net_state(), dt=2.0 / num_steps, num_steps=num_steps, step=leapfrog_step)
        energy = jax.vmap(lambda s: scene.energy(0.0, (s.position, s.velocity), s.mass))(run.y)
        drifts.append(float(jnp.max(jnp.abs(energy - energy[0]))))
    assert abs(np.log2(drifts[0] / drifts[1]) - 2) < 0.2


def test_energy_of_a_damped_net_falls_to_its_rest():
    scene, state = jeuler.Scene(forces=(FORCES["springs"](),)), net_state()
    run = jeuler.simulate(scene, state, dt=1e-3, num_steps=4000, save_every=100, step=jeuler.rk4_step)
    energy = jax.vmap(lambda s: scene.energy(0.0, (s.position, s.velocity), s.mass))(run.y)
    assert (jnp.diff(energy) < 0).all()


def state_with(**changes):
    fields = {"position": jnp.zeros((2, 2)), "velocity": jnp.zeros((2, 2)), "mass": jnp.ones(2), **changes}
    return jeuler.ParticleState(**fields)


SPRING = jeuler.Springs([[0, 1]], ks=1.0, kd=0.0, rest_length=1.0)


@pytest.mark.parametrize(
    ("forces", "state", "message"),
    [
        ((), state_with(position=jnp.zeros((2, 2), int)), "state.position must be floating, got int"),
        ((), state_with(position=jnp.zeros(2)), r"state.position must have shape \(particle, dim\), got \(2,\)"),
        ((), state_with(velocity=jnp.zeros((2, 3))), r"state.velocity must have the shape of position, \(2, 2\)"),
        ((), state_with(velocity=jnp.zeros((2, 2), jnp.float32)), "state.velocity must have the dtype of position"),
        ((), state_with(mass=jnp.ones(3)), r"state.mass must have shape \(\) or \(2,\)"),
        ((), state_with(mass=jnp.array([1.0, 0.0])), "greater than 0 kg .* got 0.0 at particle 1"),
        ((), state_with(mass=jnp.array([jnp.nan, 1.0])), "greater than 0 kg .* got nan at particle 0"),
        ((jeuler.Gravity([0.0, 1.0, 2.0]),), state_with(), r"Gravity.acceleration must have shape \(2,\)"),
        (
            (jeuler.Springs([[0, 2]], 1.0, 1.0, 1.0),),
            state_with(),
            r"below the number of particles, 2, got .* \[0, 2\]",
        ),
        ((jeuler.Springs([[0, 1]], [1.0, 2.0], 1.0, 1.0),), state_with(), r"Springs.ks must have shape \(\) or \(1,\)"),
        ((jeuler.QuadraticDrag([1.0]),), state_with(), r"coefficient must have shape \(\) or \(2,\)"),
        ((lambda t, p, v, m: jnp.zeros((2, 2), complex),), state_with(), "keep the dtype"),
    ],
)
def test_bad_scenes_and_states(forces, state, message):
    with pytest.raises(ValueError, match=message):
        jeuler.simulate(jeuler.Scene(forces=forces), state, dt=0.1, num_steps=1)


@pytest.mark.parametrize(
    ("forces", "effects", "message"),
    [
        ((jeuler.Gravity,), (), r"got the class Gravity; make one, Gravity\(\.\.\.\)"),
        ((None,), (), r"Scene.forces must hold functions .* got None"),
        ((jeuler.Lifetime(1.0),), (), r"Lifetime is an effect.*Scene.effects"),
        ((), (jeuler.Gravity([0.0, 1.0]),), r"Gravity is a force.*Scene.forces"),
        ((lambda dt, state: state,), (), r"<lambda> is an effect"),
    ],
)
def test_bad_parts_of_a_scene(forces, effects, message):
    with pytest.raises(ValueError, match=message):
        jeuler.Scene(forces, effects)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene": jeuler.Gravity([0.0, 1.0])}, "scene must be a Scene, got Gravity"),
        ({"state": {"position": 1.0}}, "state must be a ParticleState, got {'position': 1.0}"),
        ({"key": 0}, r"key must be a jax.random.key, got 0; pass key=jax.random.key\(0\)"),
        ({"step": "euler"}, "step must be a function .* got 'euler'; pass, say, jeuler.euler_step"),
        ({"step": jeuler.implicit_euler}, r"step must be a function .* got implicit_euler\(.*implicit_euler\(\) makes"),
    ],
)
def test_bad_arguments_of_simulate(change, message):
    arguments = {"scene": jeuler.Scene(), "state": state_with(), "dt": 0.1, "num_steps": 1} | change
    with pytest.raises(ValueError, match=message):
        jeuler.simulate(**arguments)


def test_words_for_numbers():
    with pytest.raises(ValueError, match=r"ParticleState.mass must be an array of numbers, got 'heavy'"):
        state_with(mass="heavy")
    with pytest.raises(ValueError, match=r"Springs.ks must be a number, .* got None"):
        jeuler.Springs([[0, 1]], ks=None, kd=0.0, rest_length=1.0)


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ([[0, 0]], r"two different particles, got edges\[0\] = \[0, 0\]"),
        ([[0, -1]], r"indices from 0, got edges\[0\]"),
        ([0, 1], r"shape \(spring, 2\), got \(2,\)"),
        ([[0.0, 1.0]], "must be integers"),
    ],
)
def test_bad_edges(edges, message):
    with pytest.raises(ValueError, match=message):
        jeuler.Springs(edges, 1.0, 0.0, 1.0)


def test_scene_wants_tuples():
    with pytest.raises(ValueError, match="Scene.forces must be a tuple, got Springs"):
        jeuler.Scene(forces=SPRING)


FALLING = ParticleState(jnp.ones((1, 2)), jnp.zeros((1, 2)))
GRAVITY = (jeuler.Gravity([0.0, -9.8]),)
BOUNCING = Scene(GRAVITY, (jeuler.Collisions((jeuler.Plane([0.0, 0.0], [0.0, 1.0]),)), jeuler.SpeedLimit(5.0)))


def test_a_vector_field_without_the_effects_of_its_scene_says_so():
    with pytest.warns(UserWarning, match="without Collisions, SpeedLimit: run the scene by jeuler.simulate") as warned:
        jeuler.solve(BOUNCING.vector_field, (FALLING.position, FALLING.velocity), args=1.0, dt=0.1, num_steps=1)
    assert [w.filename for w in warned] == [__file__], "one warning, at the line that took the field"
    with pytest.warns(UserWarning, match=r"write scene.without_effects\(\).vector_field"):
        diffrax.ODETerm(BOUNCING.vector_field)


def test_a_vector_field_that_is_all_of_its_scene_is_silent():
    hand = jeuler.PrescribedMotion([0], lambda t: jnp.zeros((1, 2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = FALLING.position, FALLING.velocity
        assert BOUNCING.without_effects().vector_field(0.0, motion, 1.0)[1].tolist() == [[0.0, -9.8]]
        for scene in (Scene(GRAVITY), Scene(GRAVITY, (hand,))):
            assert scene.without_effects() is scene
            jeuler.solve(scene.vector_field, motion, args=1.0, dt=0.1, num_steps=1)
        assert Scene(GRAVITY, (hand, *BOUNCING.effects)).without_effects().effects == (hand,)
        jeuler.simulate(BOUNCING, FALLING, dt=0.1, num_steps=1)
        jeuler.stability_limit(BOUNCING, FALLING)
        jeuler.advise_step(BOUNCING, FALLING, t1=0.1, error=0.1)
