"""Many small systems under ``vmap``: they run with the batch axis last, as they would one by one, at any derivative."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jeuler
from jeuler._jax.batch_last import batch_last, fits

COUNT, PARTICLES = 64, 5
EDGES = [(i, i + 1) for i in range(PARTICLES - 1)]


def end(position, ks, kd):
    """Where a chain is after a few steps."""
    scene = jeuler.Scene((jeuler.Springs(EDGES, ks, kd, jnp.full(len(EDGES), 0.9)), jeuler.Gravity([0.0, -9.8])))
    state = jeuler.ParticleState(position, 0 * position)
    return jeuler.simulate(scene, state, dt=0.01, num_steps=3, save_every=3).y.position[-1]


def loss(position, ks, kd):
    return jnp.sum(end(position, ks, kd) ** 3)


def one_by_one(function):
    """What ``vmap`` does, as a loop over members: nothing is batched."""
    return lambda *stacked: lax.map(lambda member: function(*member), tuple(map(jnp.asarray, stacked)))


@pytest.fixture(scope="module")
def members():
    rng = np.random.default_rng(3)
    line = np.stack([np.arange(PARTICLES), np.zeros(PARTICLES)], axis=1)
    position = jnp.asarray(line + 0.1 * rng.normal(size=(COUNT, PARTICLES, 2)))
    return position, jnp.asarray(rng.uniform(5, 9, size=(COUNT, len(EDGES)))), jnp.float64(0.3)


def test_members_run_with_the_batch_axis_last(members):
    position, ks, kd = members
    text = jax.jit(jax.vmap(end, (0, 0, None))).lower(position, ks, kd).compile().as_text()
    assert f"f64[{PARTICLES + 1},{COUNT}]{{1,0}} fusion" in text  # slots of springs, members


def test_gradients_of_an_ensemble_are_those_of_its_members(members):
    def together(position, ks, kd):
        return jnp.sum(jax.vmap(loss, (0, 0, None))(position, ks, kd))

    def apart(position, ks, kd):
        return jnp.sum(one_by_one(functools.partial(lambda kd, p, k: loss(p, k, kd), kd))(position, ks))

    direction = jax.tree.map(jnp.cos, members)

    def second(function):
        return lambda *x: jax.jvp(jax.grad(function, argnums=(0, 1, 2)), x, direction)

    for ours, theirs in zip(*(jax.tree.leaves(jax.jit(second(f))(*members)) for f in (together, apart)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


def orbit(y, k):
    """Where a pendulum is after a few steps."""
    return jeuler.solve(lambda t, y, k: jnp.stack([y[1], -k * jnp.sin(y[0])]), y, dt=0.1, num_steps=3, args=k).y[-1]


def gradients_of_pairs(vmap):
    return vmap(lambda k: vmap(lambda y: jax.grad(lambda k: jnp.sum(orbit(y, k)))(k))(STARTS))(STIFFNESS)


def gradient_of_all_pairs(vmap):
    return jax.grad(lambda k: jnp.sum(vmap(lambda y: vmap(lambda k: orbit(y, k) ** 2)(k))(STARTS)))(STIFFNESS)


def jacobians(vmap):
    return vmap(lambda k: jax.jacfwd(jax.jacrev(lambda y: orbit(y, k)))(STARTS[1]))(STIFFNESS)


STARTS, STIFFNESS = np.array([[0.3, 0.1], [1.0, -2.0]]), np.linspace(1, 4, COUNT)


@pytest.mark.parametrize("function", [gradients_of_pairs, gradient_of_all_pairs, jacobians])
def test_batches_nest_around_and_inside_derivatives(function):
    ours, theirs = (jax.jit(functools.partial(function, vmap))() for vmap in (jax.vmap, one_by_one))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.optimised
def test_one_member_that_overflows_leaves_the_others_alone(members):
    position, ks, kd = members
    run = jax.jit(jax.grad(lambda p: jnp.sum(jax.vmap(loss, (0, 0, None))(p, ks, kd))))
    broken = run(position.at[7].set(jnp.inf))
    assert not np.isfinite(broken[7]).any()
    np.testing.assert_array_equal(np.delete(broken, 7, axis=0), np.delete(run(position), 7, axis=0))


def test_members_may_print_or_talk_to_each_other(members):
    mean = jax.vmap(
        lambda y: jeuler.solve(lambda t, y, args: -lax.pmean(y, "all"), y, dt=0.5, num_steps=2).y[-1], axis_name="all"
    )
    y = jnp.arange(float(COUNT))
    np.testing.assert_allclose(mean(y), y - 0.75 * jnp.mean(y))


@jax.custom_jvp
def cube(x):
    return x**3


cube.defjvp(lambda primals, tangents: (cube(*primals), 3 * primals[0] ** 2 * tangents[0]))


def many_operations(x, n, shared):
    """x (3, 4), n () and shared (4,), through operations of all kinds."""
    y = jnp.where(x > n, cube(x), shared) + jnp.pad(
        lax.slice(x, (1, 0), (3, 4), (1, 2)), ((0, 1), (1, 1)), constant_values=2.0
    )
    z = jnp.concatenate([y, jnp.cumsum(y, axis=0), jnp.ones((3, 1)) * n], axis=1).T.reshape(3, 9)
    w = jnp.stack([jnp.max(z, axis=1), jnp.sum(z * z, axis=1), jnp.min(jnp.flip(z), axis=1)], axis=1)
    return jnp.clip(w, 0, n), jnp.argmax(w, axis=1), lax.split(w, (1, 2))[1] % shared[:2, None], jnp.tanh(n), shared * 2


def looked_up(x, n, shared):
    return jnp.sort(x, axis=1) @ shared + n, x[jnp.array([2, 0])]


@pytest.mark.parametrize(("function", "expected"), [(many_operations, True), (looked_up, False)])
def test_operations_with_the_batch_axis_last_are_those_of_vmap(function, expected):
    rng = np.random.default_rng(5)
    x, n, shared = rng.normal(size=(6, 3, 4)), rng.normal(size=6), rng.uniform(1, 2, size=4)
    closed = jax.make_jaxpr(function)(x[0], n[0], shared)
    batched = [True, True, False]
    assert fits(closed.jaxpr, batched) == expected
    ours = jax.jit(lambda *operands: batch_last(closed.jaxpr, closed.consts, operands, batched, 6))
    theirs = jax.jit(jax.vmap(function, (0, 0, None)))
    for last, first in zip(ours(jnp.moveaxis(x, 0, -1), n, shared), theirs(x, n, shared), strict=True):
        np.testing.assert_allclose(jnp.moveaxis(last, -1, 0), first, rtol=1e-12)


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.rk4_step])
@pytest.mark.parametrize("by_numbers", [True, False])
def test_members_that_are_taken_apart_into_numbers_stay_as_vmap_has_them(step, by_numbers):
    def field(t, y, p):
        if not by_numbers:
            return p * y * y - y
        return jnp.stack([10 * (y[1] - y[0]), y[0] * (p - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]])

    def run(y):
        return jeuler.solve(field, y, args=0.5, dt=0.1, num_steps=2, step=step).y

    jaxpr = str(jax.make_jaxpr(jax.vmap(run))(jnp.ones((100, 3))))
    assert ("size=100" in jaxpr) is not by_numbers
