"""One oscillator, 10,000 steps of explicit Euler: what the loop itself costs."""

from __future__ import annotations

import diffrax
import jax
import jax.numpy as jnp

import jeuler

NAME, STEPS, DT = "oscillator, 10,000 steps", 10_000, 1e-3


def field(t, y, stiffness):
    x, v = y
    return v, -stiffness * x


def by_jeuler(y, stiffness):
    return jeuler.solve(field, y, dt=DT, num_steps=STEPS, save_every=STEPS, args=stiffness).y[0][-1]


def by_bare_scan(y, stiffness):
    def step(y, _):
        x, v = y
        return (x + DT * v, v - DT * stiffness * x), None

    return jax.lax.scan(step, y, None, length=STEPS)[0][0]


def by_diffrax(y, stiffness, adjoint=diffrax.RecursiveCheckpointAdjoint):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field), diffrax.Euler(), 0.0, STEPS * DT, DT, y, args=stiffness, adjoint=adjoint(),
        max_steps=STEPS + 1,
    )  # fmt: skip
    return solution.ys[0][0]


def runs(only: str = "") -> dict:
    """(peer, forward or gradient) to a function without arguments; of one peer, or of all."""
    args = (jnp.float32(1.0), jnp.float32(0.0)), jnp.float32(4.0)
    peers = {
        "jeuler": by_jeuler,
        "bare scan, scatter-add": by_bare_scan,
        "diffrax Euler": by_diffrax,
        "diffrax Euler, DirectAdjoint": lambda *a: by_diffrax(*a, adjoint=diffrax.DirectAdjoint),
    }
    made = {}
    for name, final in peers.items():
        if only not in ("", name):
            continue
        for kind, function in enumerate((final, jax.grad(final, argnums=(0, 1)))):
            compiled = jax.jit(function).lower(*args).compile()
            made[name, kind] = lambda compiled=compiled: jax.block_until_ready(compiled(*args))
    return made
