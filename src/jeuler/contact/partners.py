"""Rows of particles for the partners of pairs: gathers and scatters, or slices where the pairs are few and known.

Each gather and scatter is a loop of its own in a compiled program. A handful of slices are part of the arithmetic
around them, which takes a fraction of the time to compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array, lax

THERE: dict[str, Any] = {"mode": "promise_in_bounds", "wrap_negative_indices": False}  # of an index: it needs no check
BY_SLICES, AMONG = 3, 8  # pairs at most, and particles at most, each of which takes a slice

Partners = Array | tuple[int, ...]  # of each pair a particle; a tuple of few


def rows(y: Array, k: Partners) -> Array:
    """y[k] of indices that are there."""
    return joined([row(y, m) for m in k]) if isinstance(k, tuple) else y.at[k].get(**THERE)


def add(y: Array, k: Partners, of_pairs: Array) -> Array:
    """y, (particle, ...), and to each row k what its pairs have, (pair, ...)."""
    return joined_in(jnp.add, y, k, of_pairs) if isinstance(k, tuple) else y.at[k].add(of_pairs, **THERE)


def least(y: Array, k: Partners, of_pairs: Array) -> Array:
    """y, (particle, ...), or less in each row k of which a pair has less, (pair, ...)."""
    return joined_in(jnp.minimum, y, k, of_pairs) if isinstance(k, tuple) else y.at[k].min(of_pairs, **THERE)


def most(y: Array, k: Partners, of_pairs: Array) -> Array:
    """y, (particle, ...), or more in each row k of which a pair has more, (pair, ...)."""
    return joined_in(jnp.maximum, y, k, of_pairs) if isinstance(k, tuple) else y.at[k].max(of_pairs, **THERE)


def put(y: Array, k: Partners, of_pairs: Array, which: Array) -> Array:
    """y, (particle, ...), with what those pairs ``which`` have, (pair, ...), in their rows k; one at most has each."""
    if not isinstance(k, tuple):
        return y.at[jnp.where(which, k, len(y))].set(of_pairs, mode="drop", wrap_negative_indices=False)
    for number, particle in enumerate(k):
        new = jnp.where(row(which, number), row(of_pairs, number), row(y, particle))
        y = joined([new if m == particle else row(y, m) for m in range(len(y))])
    return y


def row(y: Array, m: int) -> Array:
    """y[m : m + 1]."""
    return lax.slice_in_dim(y, m, m + 1)


def joined(rows: list[Array]) -> Array:
    """One array of these rows."""
    return lax.concatenate(rows, 0) if len(rows) > 1 else rows[0]


def joined_in(join: Callable[[Array, Array], Array], y: Array, k: tuple[int, ...], of_pairs: Array) -> Array:
    """y, (particle, ...), and each row k joined with what its pairs have, one after the other."""
    parts = [row(y, m) for m in range(len(y))]
    for number, particle in enumerate(k):
        parts[particle] = join(parts[particle], row(of_pairs, number))
    return joined(parts)
