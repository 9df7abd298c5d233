"""How a residual and its Jacobian are come by: compiled, or as part of a program that is being traced."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._jax.haste import Haste, jit_in_haste

COLUMNS_AT_ONCE = 16
SEVERAL = 4  # blocks that are worth threads

Residual = Callable[[Array, Any], Array]
Pair = tuple[Any, Callable[[], Any]]


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """A residual and its Jacobian, in three forms.

    Attributes:
      residual: r(x, data), as a part of a program.
      both: (r, dr/dx), as a part of a program.
      at: the residual at x, and a function that gives its Jacobian there: what a search calls.
    """

    residual: Residual
    both: Callable[[Array, Any], tuple[Array, Array]]
    at: Callable[[Any, Any], Pair]

    def __call__(self, x: Any, data: Any) -> Pair:
        return self.at(x, data)


def evaluations(residual: Residual, compiled: bool, haste: Haste = "none") -> Evaluate:
    """The forms of a residual: traced, or compiled, where a residual and its Jacobian share one program."""
    both = functools.partial(residual_and_jacobian, residual)
    if not compiled:
        return Evaluate(residual, both, functools.partial(_traced, residual, both))
    program = jit_in_haste(functools.partial(columns, residual), haste)
    return Evaluate(jax.jit(residual), jax.jit(both), functools.partial(by_blocks, program))


def _traced(residual: Residual, both: Any, x: Array, data: Any) -> Pair:
    """As part of a program: where there are few parameters, one run for both."""
    if len(x) <= COLUMNS_AT_ONCE:
        r, jacobian = both(x, data)
        return r, lambda: jacobian
    return residual(x, data), lambda: both(x, data)[1]


def columns(residual: Residual, x: Array, data: Any, directions: Array) -> tuple[Array, Array]:
    """r(x) and its derivative in each of the directions, (direction, m), by forward mode."""

    def column(direction):
        return jax.jvp(lambda x: residual(x, data), (x,), (direction,))

    return jax.vmap(column, out_axes=(None, 0))(directions)


def residual_and_jacobian(residual: Residual, x: Array, data: Any) -> tuple[Array, Array]:
    """r(x) and dr/dx by forward mode, some columns at a time; the last block is filled up, not a program of its own."""
    n = len(x)
    if n <= COLUMNS_AT_ONCE:
        r, rows = columns(residual, x, data, jnp.eye(n, dtype=x.dtype))
        return r, rows.T
    blocks = -(-n // COLUMNS_AT_ONCE)
    directions = jnp.eye(blocks * COLUMNS_AT_ONCE, n, dtype=x.dtype).reshape(blocks, COLUMNS_AT_ONCE, n)
    r, rows = lax.map(lambda some: columns(residual, x, data, some), directions)
    return r[0], rows.reshape(blocks * COLUMNS_AT_ONCE, -1)[:n].T


def by_blocks(program: Callable[[Any, Any, np.ndarray], tuple[Any, Any]], x: np.ndarray, data: Any) -> Pair:
    """The residual with the first block of the Jacobian, and a function that gives all of it.

    One program does both, and one of fixed width serves any number of parameters: a second one would take longer to
    compile than most searches take.
    """
    n = len(x)
    r, first = (np.asarray(a, float) for a in program(x, data, directions_of(0, n)))

    def jacobian() -> np.ndarray:
        rows = np.empty((n, len(r)))
        rows[: len(first)] = first

        def block(start: int) -> None:
            more = np.asarray(program(x, data, directions_of(start, n))[1])
            rows[start : start + len(more)] = more[: n - start]

        starts = range(len(first), n, COLUMNS_AT_ONCE)
        if len(starts) < SEVERAL:
            for start in starts:
                block(start)
        else:  # a run of small arrays keeps one core busy
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                list(pool.map(block, starts))
        return rows.T

    return r, jacobian


def directions_of(start: int, n: int) -> np.ndarray:
    """Unit vectors from ``start`` on, as many as one block has, with zeros beyond the last, (block, n)."""
    return np.eye(min(n, COLUMNS_AT_ONCE), n, start)
