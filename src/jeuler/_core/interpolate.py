"""Cubic Hermite interpolation: values and slopes at the nodes, anything between."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array


def hermite(s: Array, width: Array, x0: Array, x1: Array, v0: Array, v1: Array) -> Array:
    """The cubic through (x0, slope v0) at s = 0 and (x1, slope v1) at s = 1, for an interval of the given width.

        x(s) = (1 + 2 s)(1 - s)^2 x0 + s (1 - s)^2 width v0 + s^2 (3 - 2 s) x1 + s^2 (s - 1) width v1

    Written about x0, so that large coordinates lose no digits.
    """
    rise = s * s * (3 - 2 * s)
    return x0 + rise * (x1 - x0) + s * (1 - s) * width * ((1 - s) * v0 - s * v1)


def slopes(times: Array, values: Array) -> Array:
    """Second-order finite differences on any grid, time along axis 0; one-sided of second order at the ends."""
    h = jnp.diff(times)[(..., *(None,) * (values.ndim - 1))]
    secant = jnp.diff(values, axis=0) / h
    if len(times) == 2:
        return jnp.concatenate([secant, secant])
    middle = (h[1:] * secant[:-1] + h[:-1] * secant[1:]) / (h[1:] + h[:-1])
    return jnp.concatenate([2 * secant[:1] - middle[:1], middle, 2 * secant[-1:] - middle[-1:]])


def interpolate(t: Any, times: Array, values: Array, node_slopes: Array) -> Array:
    """The piecewise cubic at time t; before the first and after the last node, the value there."""
    t = jnp.clip(t, times[0], times[-1])
    k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    width = times[k + 1] - times[k]
    s = (t - times[k]) / width
    return hermite(s, width, values[k], values[k + 1], node_slopes[k], node_slopes[k + 1])
