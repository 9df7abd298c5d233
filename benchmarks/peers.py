"""Each peer as ``peer(work) -> (forward, gradient)``: two functions without arguments, or None where it has none.

``forward()`` gives the positions at the end, (batch, particle, 3); ``gradient()`` the derivative of the sum of their
squares with respect to initial position, velocity, ks and kd, in this order. All do explicit Euler in float32.
"""

from __future__ import annotations

import ctypes
import functools
import pathlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from works import DT, KD, KS, Work

import jeuler

Pair = tuple[Callable | None, Callable | None]


def _compiled(final: Callable, work: Work) -> Pair:
    """Forward and gradient of ``final(position, velocity, ks, kd) -> position`` of one system, vmapped over a batch."""
    if work.batch > 1:
        run = jax.vmap(final, in_axes=(0, 0, None, None))
        start = work.position, work.velocity
    else:
        run, start = final, (work.position[0], work.velocity[0])
    args = (*map(jnp.asarray, start), jnp.float32(KS), jnp.float32(KD))
    forward = jax.jit(run).lower(*args).compile()
    gradient = jax.jit(jax.grad(lambda *a: jnp.sum(run(*a) ** 2), argnums=(0, 1, 2, 3))).lower(*args).compile()
    return lambda: jax.block_until_ready(forward(*args)), lambda: jax.block_until_ready(gradient(*args))


def jeuler_simulate(work: Work) -> Pair:
    edges, rest = work.edges, jnp.asarray(work.rest_length)

    def final(position, velocity, ks, kd):
        forces = (jeuler.Springs(edges, ks, kd, rest),) if len(edges) else ()
        forces += (jeuler.Gravity(jnp.array([0.0, 0.0, -work.gravity])),) if work.gravity else ()
        forces += (jeuler.QuadraticDrag(work.drag),) if work.drag else ()
        state = jeuler.ParticleState(position, velocity)
        run = jeuler.simulate(jeuler.Scene(forces), state, dt=DT, num_steps=work.steps, save_every=work.steps)
        return run.y.position[-1]

    return _compiled(final, work)


def acceleration_by_scatter(work: Work) -> Callable:
    """The equation of motion as one would write it in JAX: gathers, and ``.at[].add``."""
    i, j = jnp.asarray(work.edges[:, 0]), jnp.asarray(work.edges[:, 1])
    rest = jnp.asarray(work.rest_length)[:, None]

    def acceleration(position, velocity, ks, kd):
        a = jnp.zeros_like(position)
        if len(work.edges):
            d, s = position[i] - position[j], velocity[i] - velocity[j]
            r = jnp.linalg.norm(d, axis=1, keepdims=True)
            u = d / r
            f = (ks * (rest - r) - kd * jnp.sum(s * u, axis=1, keepdims=True)) * u
            a = a.at[i].add(f).at[j].add(-f)
        if work.gravity:
            a = a + jnp.array([0.0, 0.0, -work.gravity])
        if work.drag:
            a = a - work.drag * jnp.linalg.norm(velocity, axis=1, keepdims=True) * velocity
        return a

    return acceleration


def bare_scan(work: Work) -> Pair:
    acceleration = acceleration_by_scatter(work)

    def final(position, velocity, ks, kd):
        def step(y, _):
            x, v = y
            return (x + DT * v, v + DT * acceleration(x, v, ks, kd)), None

        return jax.lax.scan(step, (position, velocity), None, length=work.steps)[0][0]

    return _compiled(final, work)


def diffrax_euler(work: Work, adjoint=diffrax.RecursiveCheckpointAdjoint) -> Pair:
    acceleration = acceleration_by_scatter(work)
    term = diffrax.ODETerm(lambda t, y, args: (y[1], acceleration(*y, *args)))

    def final(position, velocity, ks, kd):
        solution = diffrax.diffeqsolve(
            term, diffrax.Euler(), 0.0, work.steps * DT, DT, (position, velocity), args=(ks, kd),
            adjoint=adjoint(), max_steps=work.steps + 1,
        )  # fmt: skip
        return solution.ys[0][0]

    return _compiled(final, work)


diffrax_direct = functools.partial(diffrax_euler, adjoint=diffrax.DirectAdjoint)


def jax_md(work: Work) -> Pair:
    """jax-md's bonds are undamped: less work than the others do."""
    if not len(work.edges):
        return None, None
    from jax_md import energy, quantity, space

    whole = work.flat()
    displacement, shift = space.free()

    def final(position, velocity, ks, kd):
        bonds = energy.simple_spring_bond(
            displacement,
            jnp.asarray(whole.edges),
            length=jnp.asarray(whole.rest_length),
            epsilon=ks,
            alpha=2.0,
        )
        force = quantity.force(bonds)

        def step(y, _):
            x, v = y
            return (shift(x, DT * v), v + DT * force(x)), None

        return jax.lax.scan(step, (position, velocity), None, length=whole.steps)[0][0]

    return _compiled(final, whole)


def warp(work: Work) -> Pair:
    import warp as wp
    import warp_kernels as kernels

    whole = work.flat()
    x0, v0 = whole.position[0], whole.velocity[0]
    n, springs = len(x0), len(whole.edges)
    device = "cuda" if jax.default_backend() == "gpu" else "cpu"

    def vectors(values, grad):
        return wp.array(values, dtype=wp.vec3, device=device, requires_grad=grad)

    edges = wp.array(whole.edges, dtype=wp.vec2i, device=device)
    rest = wp.array(whole.rest_length, dtype=float, device=device)
    ks, kd = (wp.array([k], dtype=float, device=device, requires_grad=True) for k in (KS, KD))

    def states(count, grad):
        made = [(vectors(x0, grad), vectors(v0, grad))]
        return made + [(wp.empty_like(made[0][0]), wp.empty_like(made[0][1])) for _ in range(count - 1)]

    def advance(now, then, f):
        if springs:
            f.zero_()
            wp.launch(kernels.spring_forces, springs, inputs=[*now, edges, rest, ks, kd, f], device=device)
        wp.launch(kernels.move, n, inputs=[*now, f, *then, DT, whole.gravity, whole.drag], device=device)

    two, plain_force = states(2, False), vectors(0 * x0, False)

    def forward():
        two[0][0].assign(x0)
        two[0][1].assign(v0)
        for k in range(whole.steps):
            advance(two[k % 2], two[1 - k % 2], plain_force)
        return two[whole.steps % 2][0].numpy()[None]

    history = states(whole.steps + 1, True)
    forces = [vectors(0 * x0, True) for _ in range(whole.steps)]
    loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)

    def gradient():
        loss.zero_()
        with wp.Tape() as tape:
            for k in range(whole.steps):
                advance(history[k], history[k + 1], forces[k])
            wp.launch(kernels.sum_of_squares, n, inputs=[history[-1][0], loss], device=device)
        tape.backward(loss)
        out = [a.grad.numpy().copy() for a in (*history[0], ks, kd)]
        tape.zero()
        return out[0], out[1], out[2][0], out[3][0]

    return forward, gradient


def c_program(work: Work) -> Pair:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None, None
    source = pathlib.Path(__file__).with_name("springs.c")
    library = pathlib.Path(tempfile.mkdtemp()) / "springs.so"
    options = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, str(source), "-o", str(library), "-lm"], check=True)
    run = ctypes.CDLL(str(library)).run
    whole = work.flat()
    edges, rest = np.ascontiguousarray(whole.edges), np.ascontiguousarray(whole.rest_length)
    n = whole.position.shape[1]

    def address(array):
        return array.ctypes.data_as(ctypes.c_void_p)

    def forward():
        x, v = whole.position[0].copy(), whole.velocity[0].copy()
        f = np.empty_like(x)
        numbers = map(ctypes.c_float, (KS, KD, DT, whole.gravity, whole.drag))
        run(
            whole.steps,
            n,
            len(edges),
            address(edges),
            address(rest),
            *numbers,
            address(x),
            address(v),
            address(f),
        )
        return x[None]

    return forward, None


def numpy_program(work: Work) -> Pair:
    whole = work.flat()
    i, j = whole.edges[:, 0], whole.edges[:, 1]
    n = whole.position.shape[1]

    def forward():
        x, v = whole.position[0].copy(), whole.velocity[0].copy()
        for _ in range(whole.steps):
            a = np.zeros_like(x)
            if len(i):
                d, s = x[i] - x[j], v[i] - v[j]
                r = np.sqrt(np.einsum("ij,ij->i", d, d))
                c = (KS * (whole.rest_length - r) - KD * np.einsum("ij,ij->i", s, d) / r) / r
                for k in range(3):
                    f = c * d[:, k]
                    a[:, k] = np.bincount(i, f, n) - np.bincount(j, f, n)
            if whole.gravity:
                a[:, 2] -= whole.gravity
            if whole.drag:
                a -= whole.drag * np.linalg.norm(v, axis=1, keepdims=True) * v
            x, v = x + np.float32(DT) * v, v + np.float32(DT) * a
        return x[None]

    return forward, None


PEERS: dict[str, Callable[[Work], Pair]] = {
    "jeuler": jeuler_simulate,
    "bare scan, scatter-add": bare_scan,
    "diffrax Euler": diffrax_euler,
    "diffrax Euler, DirectAdjoint": diffrax_direct,
    "jax-md (no damper)": jax_md,
    "Warp": warp,
    "C, one thread": c_program,
    "NumPy": numpy_program,
}
