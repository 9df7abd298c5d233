"""The spring and damper law, and its hardest point: coincident ends."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import NET_EDGES, net_state

import jeuler
from jeuler import Gravity, Springs


def by_the_formula(p, v, edges, ks, kd, rest_length):
    """A transcription of the law, spring by spring, in NumPy."""
    force = np.zeros_like(p)
    for (i, j), k, c, length in zip(edges, ks, kd, rest_length, strict=True):
        d = p[i] - p[j]
        r = np.linalg.norm(d)
        u = d / r
        pull = k * (length - r) * u - c * np.dot(v[i] - v[j], u) * u
        force[i] += pull
        force[j] -= pull
    return force


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_law(random, dim):
    p, v = random.normal(size=(2, 12, dim))
    edges = np.array([(i, j) for i in range(12) for j in range(i) if random.random() < 0.4])
    ks, kd, rest_length = random.uniform(0.5, 3, (3, len(edges)))
    ours = jeuler.Springs(edges, ks, kd, rest_length)(0.0, jnp.asarray(p), jnp.asarray(v), jnp.ones(()))
    np.testing.assert_allclose(ours, by_the_formula(p, v, edges, ks, kd, rest_length), rtol=1e-11, atol=1e-12)


def force_on_first(d, ks=2.0, kd=0.5, rest_length=0.0):
    position = jnp.stack([d, jnp.zeros_like(d)])
    velocity = jnp.ones_like(position) * jnp.array([[1.0], [-1.0]], d.dtype)
    return jeuler.Springs([[0, 1]], ks, kd, rest_length)(0.0, position, velocity, jnp.ones((), d.dtype))[0]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_coincident_ends_without_length(dtype):
    """The force is 0, the Jacobian exactly -ks I, the second derivative 0."""
    zero = np.zeros(3, dtype)
    assert force_on_first(jnp.asarray(zero)).tolist() == [0, 0, 0]
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(jax.jit(jacobian(force_on_first))(zero), -2 * np.eye(3))
    np.testing.assert_array_equal(jax.jit(jax.hessian(lambda d: jnp.sum(force_on_first(d))))(zero), 0)
    of_batch = jax.jit(jax.vmap(jax.jacfwd(force_on_first)))
    np.testing.assert_array_equal(of_batch(np.zeros((2, 3), dtype)), [-2 * np.eye(3)] * 2)


@functools.cache
def derivatives_of_the_total():
    """The sum of the force on one end, its gradient and its Hessian."""

    def total(d, rest_length):
        return jnp.sum(force_on_first(d, rest_length=rest_length))

    return jax.jit(total), jax.jit(jax.grad(total)), jax.jit(jax.hessian(total))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-20, 1e-14, 1e-10, 1e-5])
@pytest.mark.parametrize("rest_length", [0.0, 1.0])
def test_nearly_coincident_ends_are_finite_to_second_order(dtype, size, rest_length):
    for derivative in derivatives_of_the_total():
        assert np.isfinite(derivative(np.asarray([size, 0.0, size], dtype), dtype(rest_length))).all()


def test_one_coincident_pair_among_many(random):
    position = jnp.asarray(random.normal(size=(6, 2))).at[3].set(0.7).at[4].set(0.7)
    edges = [(k, k + 1) for k in range(5)]
    scene = jeuler.Scene(forces=(jeuler.Springs(edges, 10.0, 0.1, 0.5),))
    state = jeuler.ParticleState(position, jnp.zeros((6, 2)))

    def loss(scene):
        return jnp.sum(jeuler.simulate(scene, state, dt=0.01, num_steps=20).y.position ** 2)

    slope = jax.grad(loss)(scene)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    batch = jax.vmap(jax.grad(lambda k: loss(jax.tree.map(lambda x: k * x, scene))))(jnp.array([1.0, 2.0]))
    assert np.isfinite(batch).all()


def test_large_coordinates_lose_no_digits():
    """Two particles a metre apart, a thousand kilometres away, in float32: the offset is exact there."""
    near = jnp.array([[0.0, 0.0], [1.25, 0.0]], jnp.float32)
    spring = jeuler.Springs([[0, 1]], 100.0, 0.0, 1.0)
    still = jnp.zeros((2, 2), jnp.float32)
    here = spring(0.0, near, still, jnp.float32(1))
    there = spring(0.0, near + jnp.float32(2**20), still, jnp.float32(1))
    np.testing.assert_array_equal(here, there)


def test_topology_reads_as_an_array():
    springs = jeuler.Springs(np.array([[0, 1], [2, 1]]), 1.0, 0.0, 1.0)
    assert np.asarray(springs.edges).tolist() == [[0, 1], [2, 1]]
    assert springs.edges.shape == (2, 2)
    assert springs.edges[:, 0].tolist() == [0, 2]
    assert hash(springs.edges) == hash(jeuler.Springs([[0, 1], [2, 1]], 2.0, 0.0, 1.0).edges)
    assert springs.edges != jeuler.Springs([[0, 1], [1, 2]], 2.0, 0.0, 1.0).edges


def test_oscillation_against_the_exact_solution():
    """A mass on a damped spring, against x = e^(-gt) (cos wt + g/w sin wt)."""
    ks, kd, mass = 9.0, 0.6, 1.5
    scene = jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks, kd, 1.0),))
    state = jeuler.ParticleState([[0.0], [1.3]], [[0.0], [0.0]], mass=[jnp.inf, mass])
    run = jeuler.simulate(scene, state, dt=1e-3, num_steps=4000, step=jeuler.rk4_step)
    decay = kd / mass / 2
    omega = np.sqrt(ks / mass - decay**2)
    exact = 1 + 0.3 * np.exp(-decay * run.t) * (np.cos(omega * run.t) + decay / omega * np.sin(omega * run.t))
    np.testing.assert_allclose(run.y.position[:, 1, 0], exact, atol=1e-11)


@pytest.mark.parametrize(
    ("name", "value", "where"), [("ks", -3.0, ""), ("kd", [0.1, -0.2], "at index 1"), ("rest_length", -1e-3, "")]
)
def test_negative_parameters_are_refused_before_tracing(name, value, where):
    parameters = {"ks": 1.0, "kd": 0.0, "rest_length": 1.0} | {name: value}
    scene = jeuler.Scene((jeuler.Springs([[0, 1], [1, 2]], **parameters),))
    state = jeuler.ParticleState([[0.0], [1.0], [2.0]], jnp.zeros((3, 1)))
    with pytest.raises(
        ValueError, match=rf"Springs.{name} must not be negative, got -.*{where}; .*keep it at 0 or above"
    ):
        jeuler.simulate(scene, state, dt=0.1, num_steps=1)


def test_a_traced_negative_parameter_passes_as_nobody_can_look_at_it():
    state = jeuler.ParticleState([[0.0], [1.5]], jnp.zeros((2, 1)))

    def end(ks):
        scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks, 0.0, 1.0),))
        return jeuler.simulate(scene, state, dt=0.1, num_steps=2).y.position[-1, 1, 0]

    np.testing.assert_allclose(jax.jit(end)(-1.0), 1.5 + 0.01 * 0.5)
    assert np.isfinite(jax.grad(end)(-1.0))


def test_springs_and_gravity_that_change_in_time():
    """A muscle: at each time the force of springs with the numbers of that time, in a pool too."""
    state = net_state()
    ks = jnp.linspace(20.0, 60.0, 5)
    muscle = Springs(NET_EDGES, ks=lambda t: ks * (1 + t), kd=0.7, rest_length=lambda t: 0.9 - 0.2 * t)
    then = Springs(NET_EDGES, ks=1.5 * ks, kd=0.7, rest_length=0.8)
    here = state.position, state.velocity, state.mass
    np.testing.assert_allclose(muscle(0.5, *here), then(0.5, *here), rtol=1e-12)
    np.testing.assert_allclose(muscle.energy(0.5, *here[::2]), then.energy(0.5, *here[::2]))
    pulls = Gravity(lambda t: jnp.stack([t, -9.8]))
    alive = state.replace(alive=jnp.array([True, True, False, True]))

    def end(*forces):
        scene = jeuler.Scene(forces, (jeuler.SpeedLimit(9.0),))
        return jeuler.simulate(scene, alive, t0=0.5, dt=1e-3, num_steps=1).y.velocity[-1]

    np.testing.assert_allclose(end(muscle, pulls), end(then, Gravity([0.5, -9.8])), rtol=1e-12)
    for wrong, match in ((lambda t: jnp.ones(3), "Springs.ks"), (lambda: 3.0, "function")):
        with pytest.raises(ValueError, match=match):
            jeuler.simulate(jeuler.Scene((Springs(NET_EDGES, wrong, 0.1, 1.0),)), state, dt=0.1, num_steps=1)
