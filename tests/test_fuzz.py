"""2,000 random scenes: nothing is lost unannounced, and jit, eager, vmap and a loop agree."""

import functools

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies

import jeuler
from jeuler.colliders import Plane, Sphere
from jeuler.effects import Collisions

SCENES_AT_ONCE, EXAMPLES, STEPS = 10, 50, 20
SHAPES = {
    "tree": (5, [[0, 1], [1, 2], [1, 3]], ()),  # particle 4 is free
    "net over a floor": (
        4,
        [[0, 1], [1, 2], [2, 3], [0, 3], [0, 2]],
        (Plane([0.0, 0.0], [0.0, 1.0]), Sphere([0.5, -0.5], 0.8)),
    ),
}


@functools.cache
def programs(shape):
    """The run of one scene and its gradient; jitted for a batch and for one."""
    _, edges, colliders = SHAPES[shape]

    def run(scene):
        position, velocity, mass, ks, kd, rest_length, dt, bounce = scene
        contact = Collisions(colliders, radius=0.05, restitution=bounce, friction=bounce, max_bounces=1)
        parts = jeuler.Gravity([0.0, -9.81]), jeuler.Springs(edges, ks, kd, rest_length)
        state = jeuler.ParticleState(position, velocity, mass)
        solution = jeuler.simulate(
            jeuler.Scene(parts, (contact,) if colliders else ()),
            state,
            dt=dt,
            num_steps=STEPS,
            save_every=STEPS,
            step=jeuler.symplectic_euler_step,
        )
        end = solution.y
        return jnp.sum(end.position[-1] + 0.1 * end.velocity[-1]), (end.position[-1], solution.first_nonfinite)

    of_one = jax.value_and_grad(run, has_aux=True)
    return run, jax.jit(of_one), jax.jit(jax.vmap(of_one))


def random_scenes(shape, dtype, seed):
    """Coincident points, infinite and tiny masses, zero springs, resting contacts; dt to twice the limit."""
    particles, edges, _ = SHAPES[shape]
    random = np.random.default_rng(seed)
    size, springs = SCENES_AT_ONCE, len(edges)

    def some(probability, extra):
        return random.random((size, *extra)) < probability

    position = random.normal(size=(size, particles, 2)) * 10.0 ** random.integers(-3, 3, (size, 1, 1))
    position = np.where(some(0.3, (1, 1)), position[:, :1], position)  # all at one place
    position[:, 1] = np.where(some(0.3, (1,)), position[:, 0], position[:, 1])
    position[..., 1] = np.where(some(0.3, (particles,)), 0.05, position[..., 1])  # at rest on the floor
    velocity = np.where(some(0.3, (particles, 1)), 0, random.normal(size=position.shape))
    mass = 10.0 ** random.uniform(-3, 3, (size, particles))
    mass = np.where(some(0.2, (particles,)), np.inf, mass)
    ks = np.where(some(0.2, (springs,)), 0, 10.0 ** random.uniform(-4, 4, (size, springs)))
    kd = np.where(some(0.3, (springs,)), 0, ks * 0.01)
    rest_length = np.where(some(0.4, (springs,)), 0, random.uniform(0, 2, (size, springs)))
    limit = 2 / np.sqrt(2 * springs * np.maximum(ks.max(axis=1), 1) / mass.min(axis=1).clip(max=1e3))
    dt = limit * 10.0 ** random.uniform(-4, np.log10(2), size)
    bounce = random.choice([0.0, 0.5, 1.0], size)
    return tuple(jnp.asarray(x, dtype) for x in (position, velocity, mass, ks, kd, rest_length, dt, bounce))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("shape", SHAPES)
def test_nothing_is_lost_unannounced(shape, dtype):
    _, of_one, of_many = programs(shape)
    seen = set()

    @hypothesis.settings(derandomize=True, deadline=None, max_examples=EXAMPLES, database=None)
    @hypothesis.given(strategies.integers(0, 2**32 - 1))
    def check(seed):
        scenes = random_scenes(shape, dtype, seed)
        (_, (position, lost)), gradient = of_many(scenes)
        finite = np.asarray(jnp.isfinite(position).all(axis=(1, 2)))
        gradient_finite = np.ones(SCENES_AT_ONCE, bool)
        for name, leaf in zip(["position", "velocity", "mass", "ks", "kd", "L", "dt", "bounce"], gradient, strict=True):
            leaf = np.asarray(leaf).reshape(SCENES_AT_ONCE, -1)
            gradient_finite &= np.isfinite(leaf).all(axis=1)
            assert (gradient_finite | (np.asarray(lost) >= 0)).all(), f"gradient of {name}, seed {seed}"
        assert (finite | (np.asarray(lost) >= 0)).all(), f"value, seed {seed}"
        alone = jax.tree.map(lambda x: x[0], scenes)
        (_, (position_alone, lost_alone)), _ = of_one(alone)
        assert lost_alone == lost[0]
        scale = float(jnp.max(jnp.abs(position[0]))) + 1
        tolerance = (1e-3 if dtype == jnp.float32 else 1e-9) * scale
        np.testing.assert_allclose(position_alone, position[0], atol=tolerance, err_msg=f"seed {seed}")
        seen.add(seed)

    check()
    assert len(seen) == EXAMPLES  # times SCENES_AT_ONCE, two shapes and two dtypes: 2,000 scenes


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_eager_equals_jit(dtype):
    run, of_one, _ = programs("tree")
    scene = jax.tree.map(lambda x: x[0], random_scenes("tree", dtype, 1))
    with jax.disable_jit():
        eager, _ = run(scene)
    np.testing.assert_allclose(eager, of_one(scene)[0][0], rtol=1e-5 if dtype == jnp.float32 else 1e-12)
