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
ROUNDING = 0.25  # part of these by which a time of the grid may miss a break through rounding


def checked_breaks(breaks: Any, dtype: Any) -> Array:
    """The breaks as one sorted array, or one ValueError."""
    traced = any(map(checks.is_traced, jax.tree.leaves(breaks)))  # in a list too
    given = jnp.asarray(breaks, dtype) if traced else checks.reals("breaks", breaks, "times, s", dtype)
    if given.ndim > 1:
        raise ValueError(f"breaks must be times of shape (break,), s, got shape {given.shape}")
    if not traced and not np.all(np.isfinite(given)):
        raise ValueError(f"breaks must be finite times, s, got {breaks!r}")
    return jnp.sort(jnp.atleast_1d(jnp.asarray(given)))


def margin(breaks: Array, first: Array, last: Array) -> Array:
    """How far "just before" is for each of the breaks, in a step between these times, s."""
    largest = jnp.maximum(jnp.abs(breaks), jnp.maximum(jnp.abs(first), jnp.abs(last)))
    return lax.stop_gradient(SIDE * jnp.finfo(breaks.dtype).eps * largest)


@jax.custom_jvp
def _with_slope(x: Array, slope: Array) -> Array:
    """x, whose derivative is multiplied by the slope."""
    return x


@_with_slope.defjvp
def _with_slope_jvp(primals, tangents):
    return primals[0], tangents[0] * primals[1]


def told_apart(breaks: Array, start: Array, end: Array) -> Array:
    """The breaks, the derivative by each that has another at its time, to rounding, within the run being NaN.

    What f does between the two is never seen, so nothing tells which of them moves the jump.
    """
    if breaks.size < 2:
        return breaks
    first, last = jnp.minimum(start, end), jnp.maximum(start, end)
    gap = margin(breaks, first, last)
    near = jnp.abs(breaks[:, None] - breaks) <= gap
    within = (breaks >= first - gap) & (breaks <= last + gap)
    return _with_slope(breaks, jnp.where((jnp.sum(near, axis=1) > 1) & within, jnp.nan, jnp.ones_like(breaks)))


def between(f: VectorField, breaks: Array, start: Array, end: Array) -> VectorField:
    """f on the step from start to end, forwards or backwards: evaluated just inside of an end that is a break."""
    first, last = jnp.minimum(start, end), jnp.maximum(start, end)
    gap = margin(breaks, first, last)
    after = jnp.max(jnp.where(jnp.abs(breaks - first) <= gap, breaks + gap, -jnp.inf))
    before = jnp.min(jnp.where(jnp.abs(breaks - last) <= gap, breaks - gap, jnp.inf))

    def inside(t, y, args):
        return f(jnp.minimum(jnp.maximum(t, after), before), y, args)

    return inside


def split_at(advance: Callable, breaks: Array) -> Callable:
    """``advance(f, t, state, dt, args)`` that ends a step at each break within it and goes on from there.

    A break that is a time of the grid, to rounding, belongs to the step that begins there, as the end of a first piece
    of no length. That moves nothing, but its derivative counts: (f just before - f just after) for each of the break.
    """

    def split(f, t, state, dt, args):
        end, direction = t + dt, jnp.sign(dt)  # dt may be negative
        first, last = jnp.minimum(t, end), jnp.maximum(t, end)
        gap = margin(breaks, first, last)
        apart = (breaks < first - gap) | (breaks > last + gap)  # False for a break that is NaN: then the state is

        def piece(carry, stop_and_whether_inside):
            (begin, state), (stop, inside) = carry, stop_and_whether_inside
            h = stop - begin
            some = inside | (h != 0)
            here = between(f, breaks, jnp.where(h != 0, begin, begin - dt), stop)
            moved = advance(here, begin, state, jnp.where(some, h, dt), args)
            return (stop, jax.tree.map(lambda a, b: jnp.where(some, a, b), moved, state)), None

        def in_pieces(state):
            met = jnp.where(dt < 0, breaks[::-1], breaks)
            ahead, rounding = (met - t) * direction, margin(met, first, last) * ROUNDING
            inside = (ahead >= -rounding) & ((end - met) * direction > rounding)
            at_break = met + lax.stop_gradient(jnp.where(ahead < 0, t - met, 0))
            stops = jnp.where(inside | jnp.isnan(met), at_break, jnp.where(ahead < 0, t, end))
            return lax.scan(piece, (t, state), (jnp.append(stops, end), jnp.append(inside, False)))[0][1]

        return lax.cond(jnp.all(apart), lambda state: advance(f, t, state, dt, args), in_pieces, state)

    return split
