"""What one step makes of one mode of the linear equation, and the largest dt at which the mode does not grow."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.precision import double_precision
from jeuler.steps.explicit import Step

ROUNDOFF = 1e3 * float(np.finfo(float).eps)  # of |R| - 1, in units of |Re z| + |z|^2
SLOWEST = 1e-12  # growth a step that long runs can tell from roundoff


def amplification(step: Step, z: jax.Array) -> jax.Array:
    """|R(z)|: what one step of size 1 does to y' = z y, the complex z written as a real 2 x 2 matrix."""
    matrix = jnp.array([[z.real, -z.imag], [z.imag, z.real]])
    image = step(lambda t, u, a: a @ u, 0.0, jnp.array([1.0, 0.0]), 1.0, matrix)
    return jnp.hypot(image[0], image[1])


def growth(step: Step, z: jax.Array) -> jax.Array:
    """|R(z)| - 1, also where it is far below roundoff of |R|, if the step says its increment."""
    matrix, start = jnp.array([[z.real, -z.imag], [z.imag, z.real]]), jnp.array([1.0, 0.0])

    def linear(t, u, a):
        return a @ u

    if hasattr(step, "increment"):
        change = step.increment(linear, 0.0, start, 1.0, matrix)
    else:
        change = step(linear, 0.0, start, 1.0, matrix) - start
    square = 2 * change[0] + change[0] ** 2 + change[1] ** 2  # |R|^2 - 1
    return square / (1 + jnp.sqrt(jnp.maximum(1 + square, 0)))


@functools.partial(jax.jit, static_argnames="step")
def _growth(step, unit, s):
    return jax.vmap(jax.vmap(lambda z: growth(step, z)))(unit[:, None] * s)


def _unit_pairs():
    one, zero = jnp.float64(1.0), jnp.float64(0.0)
    return (one, zero), (zero, one)


def treats_all_alike(step: Any) -> bool:
    """Whether the step commutes with a linear change of variables, so that eigenvalues say all about it."""
    return _treats_all_alike(step)


@functools.lru_cache(maxsize=64)
def _treats_all_alike(step: Any) -> bool:
    @jax.jit
    def image(matrix):
        def field(t, y, args):
            return matrix[0, 0] * y[0] + matrix[0, 1] * y[1], matrix[1, 0] * y[0] + matrix[1, 1] * y[1]

        return jnp.array([step(field, 0.0, start, 1.0, None) for start in _unit_pairs()]).T

    with double_precision():
        field = np.array([[0.1, 0.7], [-0.4, -0.3]])
        change = np.array([[1.0, 0.5], [-0.3, 0.8]])
        other = change @ image(np.linalg.solve(change, field @ change)) @ np.linalg.inv(change)
        return bool(np.allclose(image(field), other, rtol=1e-4, atol=1e-4))


def scalar_limits(step: Step, rates: np.ndarray, interval: float = math.inf) -> np.ndarray:
    """The largest stable dt of each eigenvalue, Re <= 0."""
    count, rates = len(rates), filled(rates)
    size = np.abs(rates)
    unit = rates / size
    roundoff = functools.partial(_roundoff, step, unit)
    limits = largest_stable(functools.partial(_growth, step, unit), roundoff, 1 / (size * interval)) / size
    return limits[:count]


def filled(rates: np.ndarray) -> np.ndarray:
    """The same again up to 4, 16, 64, ... of them, so that few programs serve systems of all sizes."""
    return np.resize(rates, next(4**k for k in range(1, 16) if 4**k >= len(rates)))


def growth_at(step: Step, rates: np.ndarray, dt: float) -> float:
    """The largest |R| - 1 of these modes."""
    rates = filled(rates)
    size = np.abs(rates)
    return float(np.max(_growth(step, rates / size, (dt * size)[:, None])))


def growth_shows(step: Step, rates: np.ndarray) -> float:
    """The least dt at which one of these modes grows by `SLOWEST` a step, at least; inf if none does."""
    rates = filled(rates)
    size = np.abs(rates)
    s = np.logspace(-8, 4, 1201)
    shows = np.asarray(_growth(step, rates / size, np.broadcast_to(s, (len(rates), 1201)))) >= SLOWEST
    first = np.where(shows.any(axis=1), s[shows.argmax(axis=1)], np.inf)
    return float(np.min(first / size))


def _roundoff(step: Step, unit: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Below it |R| - 1 says nothing."""
    if not hasattr(step, "increment"):
        return np.full(s.shape, 1e-15)
    return ROUNDOFF * (np.abs(unit.real)[:, None] * s + s**2)


def largest_stable(gain: Callable[..., Any], roundoff: Callable[..., Any], allowed: np.ndarray) -> np.ndarray:
    """For each mode the end of the first stable interval of s = dt |lambda|: 0.0 if it is empty, inf if endless.

    gain, roundoff: |R| - 1 at s, and what is none, all of shape (mode, point). allowed: growth allowed to each mode, in
      units of |lambda|, (mode,).
    """
    points, lasting = 1051, 25  # 50 a decade; above 1 over half a decade is no noise of a solve
    modes = len(allowed)
    s = np.broadcast_to(np.logspace(-13, 8, points), (modes, points))

    def excess(s):
        above = np.asarray(gain(s)) - allowed[:, None] * s
        return np.where(np.isfinite(above), above, np.inf)

    above, none = excess(s), roundoff(s)
    unstable = above > none
    lasts = np.stack([unstable[:, k : points - lasting + k] for k in range(lasting)]).all(axis=0)
    first, ends = np.argmax(lasts, axis=1), np.any(lasts, axis=1)
    limits = np.where(ends, 0.0, np.inf)
    for mode in np.flatnonzero(ends & (first > 0)):
        # growth as s^2 or s^4 is below roundoff at small s: an interval without decay counts only if long
        decays = above[mode, : first[mode]] < -4 * none[mode, : first[mode]]
        if decays.any() or s[mode, first[mode]] > 0.05:
            limits[mode] = s[mode, first[mode]]
    found = (limits > 0) & np.isfinite(limits)
    low, high = (np.where(found, s[range(modes), np.maximum(first - k, 0)], 1.0) for k in (1, 0))
    for _ in range(2 if found.any() else 0):  # twice a grid of as many points between the last two
        s = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, points)
        unstable = excess(s) > roundoff(s)
        first = np.maximum(unstable.argmax(1), 1)
        low, high = s[range(modes), first - 1], s[range(modes), first]
    return np.where(found, low, limits)
