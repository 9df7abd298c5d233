"""Batches of small systems: `jax.vmap`, vmap with the axis last, and jeuler with its own treatment of batches.

    python benchmarks/batches.py             a table; some minutes
    python benchmarks/batches.py Lorenz      the rows whose name has this in it

Forward / gradient, ms, the least of `ROUNDS` interleaved rounds: 100 steps of symplectic Euler, 1,000 of Euler for
Lorenz's equations.

- plain: `vmap(run)`, with `jeuler._jax.members` switched off: what JAX makes of it.
- axis last: `vmap(run, in_axes=-1, out_axes=-1)` of arrays whose last axis is the batch, members switched off.
- jeuler: `vmap(run)` as it is; the gradient is that of the batch.
- of gradients: the gradient column alone, `vmap(grad(run))`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler._jax import members

ROUNDS = 11
Problem = tuple[Callable, tuple[Any, ...], tuple[Any, ...]]  # of one member; arguments; 0 where they have the batch


def chains(count: int, own: bool, length: int = 16) -> Problem:
    """Chains of springs, with one stiffness for all, or one a member."""
    edges = np.stack([np.arange(length - 1), np.arange(1, length)], axis=1)
    return springs(count, own, edges, np.eye(3)[0] * np.arange(length)[:, None])


def cloths(count: int, side: int = 8) -> Problem:
    """Small nets."""
    k = np.arange(side * side).reshape(side, side)
    pairs = [(k[:-1], k[1:]), (k[:, :-1], k[:, 1:]), (k[:-1, :-1], k[1:, 1:]), (k[1:, :-1], k[:-1, 1:])]
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
    points = np.stack([k // side, k % side, 0 * k], -1).reshape(-1, 3).astype(float)
    return springs(count, False, edges, points)


def springs(count: int, own: bool, edges: np.ndarray, points: np.ndarray) -> Problem:
    noise = 0.01 * np.random.default_rng(1).normal(size=(count, *points.shape))
    position = jnp.asarray(points + noise, jnp.float32)
    ks = jnp.full(count, 100.0, jnp.float32) if own else jnp.float32(100.0)

    def run(position, velocity, ks):
        scene = jeuler.Scene((jeuler.Springs(edges, ks, 0.1, 0.9),))
        state = jeuler.ParticleState(position, velocity)
        return jeuler.simulate(scene, state, dt=1e-3, num_steps=100, save_every=100).y.position[-1]

    return run, (position, 0 * position, ks), (0, 0, 0 if own else None)


def lorenz(count: int, own: bool) -> Problem:
    """Lorenz's equations, with the same parameters for all, or with those of each."""
    start = jnp.asarray(1 + 0.1 * np.random.default_rng(2).normal(size=(count, 3)), jnp.float32)
    p = jnp.asarray([10.0, 28.0, 8 / 3], jnp.float32)

    def field(t, y, p):
        return jnp.stack([p[0] * (y[1] - y[0]), y[0] * (p[1] - y[2]) - y[1], y[0] * y[1] - p[2] * y[2]])

    def run(y, p):
        return jeuler.solve(field, y, args=p, dt=1e-3, num_steps=1000, save_every=1000).y[-1]

    return run, (start, jnp.tile(p, (count, 1)) if own else p), (0, 0 if own else None)


ROWS: dict[str, Callable[[], Problem]] = {
    "1,024 chains of 16, shared ks": lambda: chains(1024, own=False),
    "1,024 chains of 16, one ks a member": lambda: chains(1024, own=True),
    "1,024 chains of 4, one ks a member": lambda: chains(1024, own=True, length=4),
    "1,024 Lorenz systems": lambda: lorenz(1024, own=False),
    "1,024 Lorenz systems, own parameters": lambda: lorenz(1024, own=True),
    "256 cloths of 8x8": lambda: cloths(256),
}


def compiled(function: Callable, arguments: tuple) -> Callable[[], Any]:
    """The compiled program of these arguments, to be run."""
    program = jax.jit(function).lower(*arguments).compile()
    return lambda: jax.block_until_ready(program(*arguments))


def programs(run: Callable, arguments: tuple, axes: tuple) -> Iterator[tuple[str, Callable, Callable]]:
    """Name, forward run and gradient of each way to run a batch."""
    numbers = tuple(range(len(arguments)))

    def gradient(batch: Callable) -> Callable:
        return jax.grad(lambda *x: jnp.sum(batch(*x) ** 2), argnums=numbers)

    last = tuple(None if axis is None else -1 for axis in axes)
    moved = tuple(x if axis is None else jnp.moveaxis(x, 0, -1) for x, axis in zip(arguments, axes, strict=True))
    first_batch, last_batch = jax.vmap(run, axes), jax.vmap(run, last, -1)
    members.MANY, many = sys.maxsize, members.MANY
    try:
        yield "plain", compiled(first_batch, arguments), compiled(gradient(first_batch), arguments)
        jax.clear_caches()
        yield "axis last", compiled(last_batch, moved), compiled(gradient(last_batch), moved)
    finally:
        members.MANY = many
    jax.clear_caches()
    forward = compiled(first_batch, arguments)
    yield "jeuler", forward, compiled(gradient(first_batch), arguments)
    each = jax.vmap(jax.grad(lambda *x: jnp.sum(run(*x) ** 2), argnums=numbers), axes)
    yield "of gradients", forward, compiled(each, arguments)


def seconds(program: Callable) -> float:
    begun = time.perf_counter()
    program()
    return time.perf_counter() - begun


def row(name: str) -> str:
    """One line of the table."""
    ways = list(programs(*ROWS[name]()))
    for way in ways:
        seconds(way[1]), seconds(way[2])
    rounds = [[(seconds(forward), seconds(gradient)) for _, forward, gradient in ways] for _ in range(ROUNDS)]
    cells = []
    for k, (way, *_) in enumerate(ways):
        forward, gradient = (1e3 * min(each[k][j] for each in rounds) for j in (0, 1))
        cells.append(f"{gradient:.3g}" if way == "of gradients" else f"{forward:.3g} / {gradient:.3g}")
    return f"| {name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    print("| | plain | axis last | jeuler | of gradients |\n|---|--:|--:|--:|--:|")
    for name in ROWS:
        if all(word in name for word in sys.argv[1:]):
            print(row(name), flush=True)
