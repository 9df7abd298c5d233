"""Run by test_divided.py in a process with eight devices: one scene divided over them, beside the same undivided."""

import re

import jax
import jax.numpy as jnp
import numpy as np

import jeuler

jax.config.update("jax_enable_x64", True)
PARTICLES = 45  # not a multiple of the devices
rng = np.random.default_rng(0)
place = rng.permutation(PARTICLES)  # the order of the particles tells nothing of their neighbours
chain = place[np.stack([np.arange(PARTICLES - 1), np.arange(1, PARTICLES)], axis=1)]
triples = place[np.arange(PARTICLES - 2)[:, None] + np.arange(3)]
position = np.empty((PARTICLES, 2))
position[place] = np.stack([np.linspace(0, 4, PARTICLES), 0.05 * rng.normal(size=PARTICLES)], axis=1)
mass = np.where(np.arange(PARTICLES) == place[0], np.inf, rng.uniform(0.1, 0.2, PARTICLES))
mesh = jax.make_mesh((8,), ("device",))


def scene(ks, drag):
    forces = (
        jeuler.Springs(chain, ks, 0.05, 0.1),
        jeuler.Bending(triples, 0.01),
        jeuler.Gravity([0.0, -9.8]),
        jeuler.LinearDrag(drag),
        jeuler.PenaltyContact(jeuler.Sphere([2.0, -0.6], 0.5), ks=30.0, radius=jnp.full(PARTICLES, 0.1)),
    )
    return jeuler.Scene(forces)


def ends(step, dtype, **how):
    def of(ks, drag, x):
        state = jeuler.ParticleState(x, jnp.zeros_like(x), mass, color=jnp.ones((PARTICLES, 3), dtype))
        run = jeuler.simulate(scene(ks, drag), state, dt=0.01, num_steps=20, save_every=10, step=step, **how)
        return jnp.sum(run.y.position[-1] ** 2), run

    return of


def same(found, expected, tolerance, name):
    assert jax.tree.structure(found) == jax.tree.structure(expected), name
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape, name
        assert a.dtype == b.dtype, name
        a, b = np.asarray(a), np.asarray(b)
        most = np.abs(b[np.isfinite(b)]).max(initial=1)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * most, err_msg=name)


def given(dtype):
    return np.asarray(rng.uniform(20, 30, len(chain)), dtype), np.full(PARTICLES, 0.1, dtype), position.astype(dtype)


def with_gradient(**how):
    run = ends(jeuler.symplectic_euler_step, np.float32, **how)
    return jax.jit(jax.value_and_grad(run, argnums=(0, 1, 2), has_aux=True))


single, double = given(np.float32), given(np.float64)
same(with_gradient(mesh=mesh)(*single), with_gradient()(*single), 1e-5, "gradient")
print("gradient")

text = jax.jit(ends(jeuler.euler_step, np.float64, mesh=mesh)).lower(*double).compile().as_text()
sent = sum(  # of each message, its numbers and its pairs of devices
    int(numbers) * int(two_dim) * len(re.findall(r"\{\d+,\d+\}", pairs)) * 8
    for numbers, two_dim, pairs in re.findall(
        r"= f64\[(\d+),(\d+)\]\S* collective-permute(?:-start)?\(.*source_target_pairs=\{(\S*)\}", text
    )
)
state = jeuler.ParticleState(position, 0 * position, mass)
division = jeuler.divide(scene(*double[:2]), state, devices=8)
assert sent == division.bytes_sent > 0, (sent, division)
print("bytes", sent)

how = {"compensated": True, "checkpoint": "sqrt"}
found = ends(jeuler.heun_step, np.float64, mesh=mesh, **how)(*double)[1]
same(found, ends(jeuler.heun_step, np.float64, **how)(*double)[1], 1e-12, "not jitted")
print("not jitted")

batch = np.stack([double[0], 2 * double[0]])
run, divided = (jax.vmap(ends(jeuler.euler_step, np.float64, **how), (0, None, None)) for how in ({}, {"mesh": mesh}))
same(divided(batch, *double[1:]), run(batch, *double[1:]), 1e-12, "vmap")
print("vmap")

broken = double[0].copy()
broken[3] = 1e200
found = ends(jeuler.euler_step, np.float64, mesh=mesh)(broken, *double[1:])[1].first_nonfinite
assert found == ends(jeuler.euler_step, np.float64)(broken, *double[1:])[1].first_nonfinite > 0
expected = ends(jeuler.euler_step, np.float64)(*double)[1]
expected = expected.y.position.mean(1) + expected.t[:, None]
np.testing.assert_allclose(
    jeuler.simulate(
        scene(*double[:2]), state, dt=0.01, num_steps=20, save_every=10, mesh=mesh,
        save=lambda t, state: state.position.mean(0) + t,
    ).y,
    expected, rtol=1e-12,
)  # fmt: skip
print("saved")
