"""Times at which the vector field may jump: a step ends there, and f is evaluated on the side that the step is on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks
from jeuler.steps.explicit import VectorField

PyTree = Any
SIDE = 8  # units in the last place that "just before" and "just after" a break are away from it


def checked_breaks(breaks: Any, dtype: Any) -> Array:
    """The breaks as one sorted array, or one ValueError."""
    traced = any(map(checks.is_traced, jax.tree.leaves(breaks)))  # in a list too
    given = jnp.asarray(breaks, dtype) if traced else checks.reals("breaks", breaks, "times, s", dtype)
    if given.ndim > 1:
        raise ValueError(f"breaks must be times of shape (break,), s, got shape {given.shape}")
    if not traced and not np.all(np.isfinite(given)):
        raise ValueError(f"breaks must be finite times, s, got {breaks!r}")
    return jnp.sort(jnp.atleast_1d(jnp.asarray(given)))


def margin(breaks: Array) -> Array:
    """How far "just before" is, for each of the breaks, s."""
    eps = jnp.finfo(breaks.dtype).eps
    return lax.stop_gradient(SIDE * eps * jnp.maximum(jnp.abs(breaks), jnp.max(jnp.abs(breaks), initial=0) / 8))


def between(f: VectorField, breaks: Array, start: Array, end: Array) -> VectorField:
    """f on the steps from start to end: evaluated just after start and just before end where these are breaks."""
    gap = margin(breaks)
    after = jnp.max(jnp.where(jnp.abs(breaks - start) <= gap, breaks + gap, -jnp.inf))
    before = jnp.min(jnp.where(jnp.abs(breaks - end) <= gap, breaks - gap, jnp.inf))

    def inside(t, y, args):
        return f(jnp.minimum(jnp.maximum(t, after), before), y, args)

    return inside


def split_at(advance: Callable, breaks: Array) -> Callable:
    """``advance(f, t, state, dt, args)`` that ends a step at each break within it and goes on from there."""

    def split(f, t, state, dt, args):
        end, gap = t + dt, margin(breaks)
        near = jnp.any((breaks >= t - gap) & (breaks <= end + gap))

        def piece(carry, stop):
            begin, state = carry
            h = stop - begin
            some = h > 0
            moved = advance(between(f, breaks, begin, stop), begin, state, jnp.where(some, h, dt), args)
            return (stop, jax.tree.map(lambda a, b: jnp.where(some, a, b), moved, state)), None

        def in_pieces(state):
            stops = jnp.append(jnp.clip(breaks, t, end), end)
            return lax.scan(piece, (t, state), stops)[0][1]

        return lax.cond(near, in_pieces, lambda state: advance(f, t, state, dt, args), state)

    return split
