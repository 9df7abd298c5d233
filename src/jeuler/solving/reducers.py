"""What is kept of the results of an ensemble whose members are too many to store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.component import result

PyTree = Any


class Reducer(Protocol):
    """What `ensemble` asks of a reducer. Results have a leading axis (member, ...), and so has ``kept``, booleans.

    Only members that are kept count. ``merge`` joins the states of two devices.
    """

    def start(self, results: PyTree, kept: Array) -> PyTree: ...

    def add(self, state: PyTree, results: PyTree, kept: Array) -> PyTree: ...

    def merge(self, a: PyTree, b: PyTree) -> PyTree: ...

    def value(self, state: PyTree) -> Any: ...


@result
class MomentsValue:
    """Count of members, and mean and variance of each result over them."""

    count: int
    mean: PyTree
    variance: PyTree


def _as_floats(results: PyTree) -> PyTree:
    """Floating-point numbers of 32 bits or more: halves are too few to add up, and integers and booleans have means."""

    def floats(x):
        return x.astype(jnp.result_type(x, jnp.float32) if jnp.issubdtype(x.dtype, jnp.inexact) else float)

    return jax.tree.map(floats, results)


def _of_members(kept: Array, x: Array) -> Array:
    return kept.reshape(-1, *(1,) * (x.ndim - 1))


@result
class Moments:
    """Mean and variance of each number of the results, over the members that were not lost.

        mean = sum x / n,   variance = sum (x - mean)^2 / (n - 1)

    Batches are joined by the differences of their means, so that a large mean does not spoil a small variance.

    Args: none, a reducer of `ensemble`.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> found = jeuler.ensemble(lambda x: x, jnp.arange(5.0), reduce=jeuler.Moments()).reduced
      >>> found.count, float(found.mean), float(found.variance)
      (5, 2.0, 2.5)

    Source: T. F. Chan, G. H. Golub, R. J. LeVeque, Updating Formulae and a Pairwise Algorithm for Computing Sample
      Variances, 1979, eq. 2.1.
    """

    def start(self, results: PyTree, kept: Array) -> PyTree:
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), _as_floats(results))
        return jnp.int32(0), zeros, zeros

    def add(self, state: PyTree, results: PyTree, kept: Array) -> PyTree:
        count = jnp.sum(kept, dtype=jnp.int32)

        def mean(x):
            return jnp.sum(jnp.where(_of_members(kept, x), x, 0), axis=0) / jnp.maximum(count, 1)

        def squares(x, mean):
            return jnp.sum(jnp.where(_of_members(kept, x), x - mean, 0) ** 2, axis=0)

        results = _as_floats(results)
        means = jax.tree.map(mean, results)
        return self.merge(state, (count, means, jax.tree.map(squares, results, means)))

    def merge(self, a: PyTree, b: PyTree) -> PyTree:
        (n, mean_a, squares_a), (m, mean_b, squares_b) = a, b
        total = n + m

        def part(dtype):
            return m.astype(dtype) / jnp.maximum(total, 1).astype(dtype)

        def mean(x, y):
            return x + (y - x) * part(x.dtype)

        def squares(s, r, x, y):
            return s + r + (y - x) ** 2 * n.astype(x.dtype) * part(x.dtype)

        means = jax.tree.map(mean, mean_a, mean_b)
        return total, means, jax.tree.map(squares, squares_a, squares_b, mean_a, mean_b)

    def value(self, state: PyTree) -> MomentsValue:
        """`MomentsValue`; NaN where no member, or one alone, is left."""
        count = int(state[0])
        _, mean, squares = state
        mean = jax.tree.map(lambda x: np.where(count, np.asarray(x), np.nan), mean)
        variance = jax.tree.map(
            lambda x: np.asarray(x) / (count - 1) if count > 1 else np.full(x.shape, np.nan), squares
        )
        return MomentsValue(count, mean, variance)


@result
class QuantilesValue:
    """Quantiles, (quantile, ...) of each result; half the width of a bin; how many values lay outside all bins."""

    quantiles: PyTree
    resolution: PyTree
    outside: PyTree


@result
class Quantiles:
    """Quantiles of each number of the results, from a histogram of each, over the members that were not lost.

    The bins reach over ``bounds``, or over three times the range of the first batch. Values outside are counted in the
    outermost bins. A quantile lies in the right bin, whose half width is ``resolution``.

    Args:
      at: the quantiles, numbers from 0 to 1.
      bounds: the least and the greatest value, the same for all results; None to take them from the first batch.
      bins: how many.
    Raises: ValueError, if a quantile is not from 0 to 1, the bounds do not rise, or there are no bins.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> median = jeuler.Quantiles((0.5,), bounds=(0.0, 1.0))
      >>> found = jeuler.ensemble(lambda x: x, jnp.linspace(0.0, 1.0, 1001), reduce=median).reduced
      >>> round(float(found.quantiles[0]), 2)
      0.5
    """

    at: Sequence[float] = (0.05, 0.25, 0.5, 0.75, 0.95)
    bounds: tuple[float, float] | None = None
    bins: int = 1024

    def __post_init__(self) -> None:
        if not all(0 <= q <= 1 for q in self.at):
            raise ValueError(f"Quantiles.at must be numbers from 0 to 1, got {self.at}")
        checks.count("Quantiles.bins", self.bins, least=1)
        if self.bounds is not None and not self.bounds[0] < self.bounds[1]:
            raise ValueError(f"Quantiles.bounds must be (least, greatest), got {self.bounds}")
        object.__setattr__(self, "at", tuple(self.at))

    def start(self, results: PyTree, kept: Array) -> PyTree:
        def of(x):
            mask = _of_members(kept, x)
            low = jnp.min(jnp.where(mask, x, jnp.inf), axis=0)
            high = jnp.max(jnp.where(mask, x, -jnp.inf), axis=0)
            span = jnp.maximum(high - low, 1e-6 * jnp.maximum(jnp.abs(high), 1e-30))
            low, high = low - span, high + span
            if self.bounds is not None:
                low, high = (jnp.full_like(low, bound) for bound in self.bounds)
            zeros = jnp.zeros(x.shape[1:], jnp.int32)
            return low, high, jnp.zeros((*x.shape[1:], self.bins), jnp.int32), zeros

        return jax.tree.map(of, _as_floats(results))

    def add(self, state: PyTree, results: PyTree, kept: Array) -> PyTree:
        def of(x, old):
            low, high, counts, outside = old
            mask = _of_members(kept, x)
            place = jnp.floor((x - low) / (high - low) * self.bins)
            place = jnp.where(mask, jnp.clip(place, 0, self.bins - 1), 0).astype(jnp.int32)
            rows = jnp.arange(low.size).reshape(low.shape) * self.bins
            ones = jnp.broadcast_to(mask, x.shape).astype(jnp.int32)
            flat = counts.ravel().at[(place + rows).ravel()].add(ones.ravel())
            beyond = jnp.sum(mask & ((x < low) | (x > high)), axis=0, dtype=jnp.int32)
            return low, high, flat.reshape(counts.shape), outside + beyond

        return jax.tree.map(of, _as_floats(results), state)

    def merge(self, a: PyTree, b: PyTree) -> PyTree:
        def of(a, b):
            return a[0], a[1], a[2] + b[2], a[3] + b[3]

        return jax.tree.map(of, a, b, is_leaf=lambda x: isinstance(x, tuple) and len(x) == 4 and hasattr(x[2], "ndim"))

    def value(self, state: PyTree) -> QuantilesValue:
        """`QuantilesValue`; NaN where no member is left."""
        at = np.asarray(self.at)

        def of(old):
            low, high, counts, _ = map(np.asarray, old)
            below = np.cumsum(counts, axis=-1)
            total = below[..., -1:]
            wanted = at * total
            place = np.sum(below[..., None, :] < np.maximum(wanted, 1e-9)[..., None], axis=-1)
            before = np.take_along_axis(np.concatenate([0 * total, below], -1), place, -1)
            within = np.take_along_axis(counts, np.minimum(place, self.bins - 1), -1)
            part = (wanted - before) / np.maximum(within, 1)
            found = low[..., None] + (place + part) / self.bins * (high - low)[..., None]
            return np.moveaxis(np.where(total > 0, found, np.nan), -1, 0)

        def is_one(x):
            return isinstance(x, tuple) and len(x) == 4 and hasattr(x[2], "ndim")

        def each(function):
            return jax.tree.map(function, state, is_leaf=is_one)

        width = each(lambda old: (np.asarray(old[1]) - np.asarray(old[0])) / self.bins / 2)
        return QuantilesValue(each(of), width, each(lambda old: np.asarray(old[3])))
