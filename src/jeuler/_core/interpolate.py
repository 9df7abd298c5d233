"""Interpolation: cubic Hermite, values and slopes at the nodes, anything between; and by a windowed sinc."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
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


REACH, KAISER = 16, 9.0  # samples to each side of the windowed sinc, and the shape of its window


def upsampled(x: np.ndarray, finer: int) -> np.ndarray:
    """Samples along axis 0 on a grid so many times as fine, by a sinc under a Kaiser window: what is band-limited."""
    n = len(x)
    if finer == 1 or n < 2:
        return x
    beyond = [(REACH, REACH), *[(0, 0)] * (x.ndim - 1)]
    extended = np.pad(x, beyond, mode="reflect", reflect_type="odd")
    fine = np.empty(((n - 1) * finer + 1, *x.shape[1:]))
    fine[::finer] = x
    taps = np.arange(1 - REACH, REACH + 1)  # samples about a place between two of them
    for k in range(1, finer):
        place = k / finer - taps
        weights = np.sinc(place) * np.i0(KAISER * np.sqrt(np.maximum(1 - (place / REACH) ** 2, 0))) / np.i0(KAISER)
        windows = np.lib.stride_tricks.sliding_window_view(extended, 2 * REACH, axis=0)[1:n]
        fine[k::finer] = windows @ (weights / weights.sum())
    return fine
