"""Lengths and directions of vectors, with derivatives that are finite everywhere."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def direction(d: Array) -> tuple[Array, Array]:
    """Length r and unit vector u = d / r along the last axis; both, and all their derivatives, are 0 at r = 0.

    Ends closer than tiny^(1/3) (2e-13 in float32, 3e-103 in float64) count as coincident: below that, the second
    derivative of r overflows.
    """
    square = jnp.sum(d * d, axis=-1, keepdims=True)
    apart = square > jnp.finfo(d.dtype).tiny ** (2 / 3)
    r = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)
    return r, jnp.where(apart, d / jnp.where(apart, r, 1), 0)


def length(x: Array) -> Array:
    """|x| along the last axis; 0 at x = 0, with all its derivatives."""
    return direction(x)[0][..., 0]


def unit(x: Array) -> Array:
    """x / |x| along the last axis; 0 at x = 0, with all its derivatives."""
    return direction(x)[1]
