"""Run by test_divided.py in a process with eight devices: one scene divided over them, beside the same undivided."""

import re
import sys

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


state = jeuler.ParticleState(position, 0 * position, mass, color=np.ones((PARTICLES, 3)))
hands = jeuler.PrescribedMotion(place[[0, 20]], lambda t: jnp.array([[0.0, 0.0], [1.8, 0.1]]) + jnp.sin(5 * t) / 10)
floor = jeuler.Collisions((jeuler.Plane([0.0, -0.08], [0.0, 1.0]),), radius=jnp.full(PARTICLES, 0.02), restitution=0.3)


def scene(ks, drag, effects=()):
    forces = (
        jeuler.Springs(chain, ks, 0.05, 0.1, box=np.array([3.0, 9.0], ks.dtype)),
        jeuler.Bending(triples, 0.01),
        jeuler.Gravity([0.0, -9.8]),
        jeuler.LinearDrag(drag),
        jeuler.PenaltyContact(jeuler.Sphere([2.0, -0.6], 0.5), ks=30.0, radius=jnp.full(PARTICLES, 0.1)),
    )
    return jeuler.Scene(forces, effects)


def run(given, num_steps=20, effects=(), **how):
    ks, drag, x = given
    start = state.replace(position=x, velocity=0 * x, color=state.color.astype(x.dtype))
    how = {"save_every": 10, "step": jeuler.symplectic_euler_step, **how}
    return jeuler.simulate(scene(ks, drag, effects), start, dt=0.01, num_steps=num_steps, **how)


def same(found, expected, tolerance, name):
    assert jax.tree.structure(found) == jax.tree.structure(expected), name
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.shape == b.shape, name
        assert a.dtype == b.dtype, name
        most = np.abs(b[np.isfinite(b)]).max(initial=1)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * most, err_msg=name)
    print(name)


def parameters(dtype):
    return np.asarray(rng.uniform(20, 30, len(chain)), dtype), np.full(PARTICLES, 0.1, dtype), position.astype(dtype)


single, double = parameters(np.float32), parameters(np.float64)


def gradients(**how):
    def end(ks, *others):
        found = run((ks, *others), num_steps=10, checkpoint=5, **how)
        return jnp.sum(found.y.position[-1] ** 2), found

    batch = np.stack([single[0], 2 * single[0]])
    each = jax.vmap(jax.value_and_grad(end, argnums=(0, 1, 2), has_aux=True), (0, None, None))
    return jax.jit(each)(batch, *single[1:])


same(gradients(mesh=mesh), gradients(), 1e-5, "gradients of a batch")

text = jax.jit(lambda *given: run(given, mesh=mesh)).lower(*double).compile().as_text()
sent = sum(  # of each message, its numbers and its pairs of devices
    int(numbers) * int(two_dim) * len(re.findall(r"\{\d+,\d+\}", pairs)) * 8
    for numbers, two_dim, pairs in re.findall(
        r"= f64\[(\d+),(\d+)\]\S* collective-permute(?:-start)?\(.*source_target_pairs=\{(\S*)\}", text
    )
)
division = jeuler.divide(scene(*double[:2]), state, devices=8)
assert sent == division.bytes_sent > 0, (sent, division)
print("bytes", sent)

broken = double[0].copy(), *double[1:]
broken[0][3] = 1e200
how = {"step": jeuler.heun_step, "compensated": True, "save": lambda t, y: (y.position.mean(0) + t, y)}
undivided, divided = ([run(given, **how, **over) for given in (double, broken)] for over in ({}, {"mesh": mesh}))
same(divided[0], undivided[0], 1e-12, "not jitted")
assert divided[1].first_nonfinite == undivided[1].first_nonfinite > 0

folder = sys.argv[1]
jax.config.update("jax_compilation_cache_dir", f"{folder}/programs")  # calls that go on have the same program
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
effects = hands, floor
for name, steps in (("whole", 20), ("parts", 10), ("parts", 20)):
    found = run(double, steps, effects, mesh=mesh, resume=f"{folder}/{name}", checkpoint_every=10)
    frames = jax.tree.map(np.asarray, (found.t, found.y))
    if name == "whole":
        plain = run(double, steps, effects)
        same(frames, (plain.t, plain.y), 1e-9, "effects")
        same(int(found.unresolved_contacts), int(plain.unresolved_contacts), 0, "unresolved")
        whole = frames
same(frames, whole, 0, "gone on")
heights = frames[1].position[1:, place[1:], 1]
assert -0.0601 < heights.min() < -0.059  # on the floor
