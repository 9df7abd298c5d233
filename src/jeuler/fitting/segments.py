"""A long record cut into segments: their runs, and the residual of multiple shooting."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler.steps.explicit import Step

PyTree = Any


@dataclasses.dataclass(frozen=True)
class Segments:
    """Which samples each segment has: ``count`` in a row and the first of the next, the last segment filled up.

    Attributes:
      starts: index of the first sample of each, (segment,).
      rows: index of each segment's samples, its end included, (segment, count + 1).
      own: whether a row is the segment's own, (segment, count + 1): its end is the next one's, but for the last.
    """

    starts: np.ndarray
    rows: np.ndarray
    own: np.ndarray

    @classmethod
    def of(cls, samples: int, number: int) -> Segments:
        count = -(-(samples - 1) // number)
        starts = np.arange(0, samples - 1, count)
        rows = starts[:, None] + np.arange(count + 1)
        own = rows < np.append(starts[1:], samples)[:, None]
        return cls(starts, np.minimum(rows, samples - 1), own)


@dataclasses.dataclass(frozen=True)
class Shooting:
    """The residual of multiple shooting. Hashable: its programs are kept by it.

    Attributes:
      f: f(t, y, params) -> dy.
      parts: steps from one sample to the next.
      fixed: whether the first state is known.
    """

    f: Callable[[Any, Array, PyTree], Array]
    step: Step
    parts: int
    fixed: bool

    def starts(self, unknowns: dict[str, Any], data: dict[str, Any]) -> Array:
        """The first state of each segment, (segment, number)."""
        free = unknowns["starts"]
        return jnp.concatenate([data["first"][None], free]) if self.fixed else free

    def runs(self, unknowns: dict[str, Any], data: dict[str, Any]) -> Array:
        """The states at the samples of each segment, its end included, (segment, count + 1, number)."""
        params = unknowns["params"]

        def segment(y: Array, times: Array) -> Array:
            def to_next(y: Array, span: tuple[Array, Array]) -> tuple[Array, Array]:
                t, gap = span
                h = gap / self.parts
                y = lax.fori_loop(0, self.parts, lambda k, y: self.step(self.f, t + k * h, y, h, params), y)
                return y, y

            _, rest = lax.scan(to_next, y, (times[:-1], jnp.diff(times)))
            return jnp.concatenate([y[None], rest])

        return jax.vmap(segment)(self.starts(unknowns, data), data["times"])

    def __call__(self, unknowns: dict[str, Any], data: dict[str, Any]) -> dict[str, Array]:
        """Prediction minus measurement over the noise, and the gaps between segments times their weight."""
        runs = self.runs(unknowns, data)
        gaps = runs[:-1, -1] - self.starts(unknowns, data)[1:]
        return {
            "data": jnp.where(data["observed"], runs - data["values"], 0) / data["sigma"],
            "gaps": data["weight"] * gaps / data["size"],
        }
