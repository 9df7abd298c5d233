"""Programs lower for accelerators; whether they run well there is for a machine that has one."""

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler._jax import platforms

GRID = {"dt": 0.01, "num_steps": 4, "save_every": 2}
STATE = jeuler.ParticleState(np.eye(3, 2), np.zeros((3, 2)))


def solved(k):
    return jeuler.solve(lambda t, y, k: -k * y, jnp.ones(3), args=k, step=jeuler.rk4_step, **GRID).y.sum()


def springs(k):
    scene = jeuler.Scene((jeuler.Springs([(0, 1), (1, 2)], k, 0.1, 1.0), jeuler.Gravity([0.0, -9.8])))
    return jeuler.simulate(scene, STATE, **GRID).y.position.sum()


def collisions(k):
    floor = jeuler.Collisions((jeuler.Plane([0.0, -k], [0.0, 1.0]),), pairs=[(0, 1)], radius=0.1)
    return jeuler.simulate(jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (floor,)), STATE, **GRID).y.position.sum()


def births(k):
    emitter = jeuler.Emitter(100.0, position=[0.0, 0.0], velocity=jeuler.Cone([0.0, 1.0], speed=k, angle=0.2))
    scene = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (emitter, jeuler.Lifetime(1.0)))
    return jeuler.simulate(scene, jeuler.empty_pool(8, 2), key=jax.random.key(0), **GRID).y.position.sum()


def adaptive(k):
    return jeuler.solve_adaptive(lambda t, y, k: -k * y, jnp.ones(3), t1=0.1, args=k, rtol=1e-3, atol=1e-3).y.sum()


def by_implicit_steps(k):
    return jeuler.solve(lambda t, y, k: -k * y, jnp.ones(3), args=k, step=jeuler.implicit_euler_step, **GRID).y.sum()


def undone(k):
    scene = jeuler.Scene((jeuler.Springs([(0, 1), (1, 2)], k, 0.0, 1.0),))
    how = GRID | {"step": jeuler.symplectic_euler_step, "checkpoint": "reversible"}
    return jeuler.simulate(scene, STATE, **how).y.position.sum()


@pytest.mark.parametrize("function", [solved, springs, collisions, births, adaptive, by_implicit_steps, undone])
def test_runs_and_gradients_lower_for_accelerators(function):
    run = jax.jit(jax.value_and_grad(function))
    exported = jax.export.export(run, platforms=["cuda", "rocm", "tpu"])(jnp.float32(1.0))
    assert set(exported.platforms) == {"cuda", "rocm", "tpu"}


def fitted(data):
    """A whole fit, its search included, as a part of a program."""

    def residual(params):
        run = jeuler.solve(lambda t, y, k: -k * y, jnp.ones(()), dt=0.1, num_steps=9, args=params["k"])
        return run.y - data

    return jeuler.fit(residual, {"k": jnp.float32(1.0)}, max_iterations=5).params["k"]


def fitted_springs(positions):
    scene = jeuler.Scene((jeuler.Springs([(0, 1), (1, 2)], 1.0, 0.1, 1.0),))
    return jeuler.fit_springs(scene, STATE, np.arange(1, 5) * 0.01, positions, dt=0.01, max_iterations=3).ks


@pytest.mark.parametrize(("function", "shape"), [(fitted, (10,)), (fitted_springs, (4, 3, 2))])
def test_fits_lower_for_accelerators(function, shape):
    data = jnp.ones(shape, jnp.float32)
    exported = jax.export.export(jax.jit(function), platforms=["cuda", "rocm", "tpu"])(data)
    assert set(exported.platforms) == {"cuda", "rocm", "tpu"}


def test_ensembles_lower_for_accelerators_in_either_order(monkeypatch):
    for last in (True, False):
        monkeypatch.setitem(platforms.BATCH_LAST, jax.default_backend(), last)
        run = jax.jit(lambda ks: jax.vmap(springs)(ks))
        jax.export.export(run, platforms=["cuda", "rocm", "tpu"])(jnp.ones(64))


def test_the_order_of_a_batch_is_chosen_by_the_table(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not platforms.batch_last()
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert platforms.batch_last()
