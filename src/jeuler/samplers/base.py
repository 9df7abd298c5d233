"""Samplers: ``sampler(key, count) -> (count, ...)``, what an `Emitter` draws the attributes of newborns from.

Each is a smooth function of its parameters and of uniform numbers that do not depend on them (reparameterised
sampling), so gradients reach the parameters.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter
from jeuler._core.component import as_component, as_float, component, store_as_float
from jeuler._core.limits import check_limits
from jeuler._jax import random_rows


class Sampler:
    """What the samplers share: ``at(u)``, a smooth function of uniform numbers u, (numbers, count), in [0, 1)."""

    numbers: Any  # that a particle takes; None where a function of the user's own draws them from a key
    at: Any

    def __call__(self, key: Array, count: int) -> Array:
        return self.at(jax.random.uniform(key, (self.numbers, count), jnp.result_type(*jax.tree.leaves(self))))


def numbers_of(sampler: Any) -> int | None:
    """How many uniform numbers a particle takes: none for a plain value; None where a function draws from a key."""
    return getattr(sampler, "numbers", None) if callable(sampler) else 0


def draw(sampler: Any, key: Array, count: int) -> Array:
    """``count`` values of a sampler, or of a plain number or array, which every particle gets."""
    if callable(sampler):
        return sampler(key, count)
    value = jnp.asarray(sampler)
    return jnp.broadcast_to(value, (count, *value.shape))


def draw_named(samplers: dict[str, Any], key: Array, count: int, dtype: Any) -> dict[str, Array]:
    """``count`` values of each sampler. What one draws depends on the key and its own name, not on the others."""
    rows = {name: numbers_of(sampler) or 0 for name, sampler in samplers.items()}
    named = [zlib.crc32(f"{name} {k}".encode()) for name in rows for k in range(rows[name])]
    u = random_rows.uniform_rows(key, named, count, dtype)
    values, first = {}, 0
    for name, sampler in samplers.items():
        if rows[name]:
            values[name] = sampler.at(u[first : first + rows[name]])
        else:
            own_key = jax.random.fold_in(key, zlib.crc32(name.encode()))
            values[name] = draw(sampler, own_key, count)
        first += rows[name]
    return values


def as_sampler(name: str, x: Any) -> Any:
    """A sampler as a pytree of floating arrays; numbers and arrays become arrays, None stays."""
    checks.refuse_class(f"{name} must be a sampler or a value", x)
    if not callable(x):
        try:
            return as_float(x)
        except (TypeError, ValueError):
            raise ValueError(
                f"{name} must be a sampler such as Uniform(...), a number or an array, got {checks.shown(x)}"
            ) from None
    checks.function(name, x, "(key, count) -> (count, ...)", "a sampler draws all newborns at once")
    return as_component(x)


@component()
class Uniform(Sampler):
    """Uniform between two bounds, each component by itself.

        x = low + (high - low) u,   u uniform in [0, 1)

    Args:
      low: () or (component,). Differentiable.
      high: () or (component,), not below low. Differentiable.
    Returns: called as ``sampler(key, count)``, (count,) or (count, component).
    Raises: ValueError, if low is above high, or their shapes do not fit together.
    Example:
      >>> import jax, jeuler
      >>> x = jeuler.Uniform(1.0, 2.0)(jax.random.key(0), 100)
      >>> x.shape, bool((x >= 1).all() and (x < 2).all())
      ((100,), True)
    """

    low: Parameter
    high: Parameter

    limits: ClassVar[dict[str, Any]] = {"low": ("", ""), "high": ("", "")}

    def __post_init__(self) -> None:
        store_as_float(self, "low", "high")
        checks.fit_together("Uniform", low=self.low, high=self.high)
        checks.in_order("Uniform.low", self.low, "Uniform.high", self.high)
        check_limits(self)

    @property
    def numbers(self) -> int:
        return math.prod(jnp.broadcast_shapes(self.low.shape, self.high.shape))

    def at(self, u: Array) -> Array:
        shape = jnp.broadcast_shapes(self.low.shape, self.high.shape)
        return self.low + (self.high - self.low) * u.T.reshape(-1, *shape)


@component()
class Normal(Sampler):
    """Normal (Gaussian), each component by itself.

        x = mean + deviation n,   n standard normal

    Args:
      mean: () or (component,). Differentiable.
      deviation: standard deviation, () or (component,), >= 0. Differentiable.
    Returns: called as ``sampler(key, count)``, (count,) or (count, component).
    Raises: ValueError, if a deviation is negative, or the shapes do not fit together.
    Example:
      >>> import jax, jeuler
      >>> jeuler.Normal([0.0, 1.0], 0.1)(jax.random.key(0), 5).shape
      (5, 2)

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983,
      sect. 2 (attributes drawn at birth).
    """

    mean: Parameter
    deviation: Parameter

    limits: ClassVar[dict[str, Any]] = {"mean": ("", ""), "deviation": (">= 0", "")}

    def __post_init__(self) -> None:
        store_as_float(self, "mean", "deviation")
        checks.fit_together("Normal", mean=self.mean, deviation=self.deviation)
        check_limits(self)

    @property
    def numbers(self) -> int:
        return math.prod(jnp.broadcast_shapes(self.mean.shape, self.deviation.shape))

    def at(self, u: Array) -> Array:
        shape = jnp.broadcast_shapes(self.mean.shape, self.deviation.shape)
        return self.mean + self.deviation * standard_normal(u).T.reshape(-1, *shape)


@component()
class Choice(Sampler):
    """One of the rows of a table, each as likely: a palette of colours, a set of sizes.

    Args:
      values: (choice, ...). Differentiable; which row is drawn is not.
    Returns: called as ``sampler(key, count)``, (count, ...).
    Raises: ValueError, if there is no row to choose from.
    Example:
      >>> import jax, jeuler
      >>> sorted(set(jeuler.Choice([1.0, 5.0])(jax.random.key(0), 50).tolist()))
      [1.0, 5.0]
    """

    values: Parameter

    def __post_init__(self) -> None:
        store_as_float(self, "values")
        if not self.values.ndim or not len(self.values):
            raise ValueError(f"Choice.values must have shape (choice, ...), one row at least, got {self.values.shape}")

    numbers = 1

    def at(self, u: Array) -> Array:
        row = (u[0] * len(self.values)).astype(jnp.int32)
        return self.values[jnp.minimum(row, len(self.values) - 1)]  # the product may round up


def standard_normal(u: Array) -> Array:
    """Standard normal numbers of uniform ones in [0, 1): the inverse of the distribution; u = 0 is moved off -inf."""
    above = np.nextafter(np.array(-1, u.dtype), np.array(0, u.dtype))
    return jnp.asarray(np.sqrt(2), u.dtype) * jax.lax.erf_inv(jnp.maximum(2 * u - 1, above))
