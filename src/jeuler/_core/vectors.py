"""Lengths and directions of vectors, with derivatives that are finite everywhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import jax.numpy as jnp
from jax import Array

from jeuler._core.choice import where


def total(terms: Iterable[Array]) -> Array:
    """The sum of one array or more, without the 0 that ``sum`` begins with."""
    first, *others = terms
    return sum(others, first)


def dot(x: Sequence[Array], y: Sequence[Array]) -> Array:
    """x.y of vectors given as one array a component."""
    return total(a * b for a, b in zip(x, y, strict=True))


def apart(square: Array) -> Array:
    """Whether ends at this squared distance count as apart, not coincident: from tiny^(1/3) on, 2e-13 in float32 and
    3e-103 in float64. Below that, the second derivative of r overflows."""
    return square > jnp.finfo(square.dtype).tiny ** (2 / 3)


def direction(d: Array) -> tuple[Array, Array]:
    """Length r and unit vector u = d / r along the last axis; both, with all derivatives, are 0 where ends coincide."""
    r, not_0 = _root(d)
    return where(not_0, r, 0), where(not_0, d / r, 0)


def length(x: Array) -> Array:
    """|x| along the last axis; 0 at x = 0, with all its derivatives."""
    r, not_0 = _root(x)
    return where(not_0, r, 0)[..., 0]


def unit(x: Array) -> Array:
    """x / |x| along the last axis; 0 at x = 0, with all its derivatives."""
    r, not_0 = _root(x)
    return where(not_0, x / r, 0)


def _root(d: Array) -> tuple[Array, Array]:
    """|d| along the last axis, kept, 1 where it is 0; and where it is not."""
    square = jnp.sum(d * d, axis=-1, keepdims=True)
    not_0 = apart(square)
    return jnp.sqrt(where(not_0, square, 1)), not_0
