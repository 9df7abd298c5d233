"""A solid by values of its signed distance on a grid."""

from __future__ import annotations

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter
from jeuler._core.component import component, store_as_float
from jeuler._core.vectors import length


@component(parameters=())
class GridDistance:
    """A solid whose signed distance is known at the points of a grid: a mesh, a scan, a drawing.

        d(p) = the values of the 2^dim points around p, weighted linearly along each axis
        outside of the grid, c its nearest point:  d(p) = max(|p - c|, d(c) - |p - c|)

    Between points the distance is right to about spacing^2 over the radius of curvature, and the normal jumps from cell
    to cell by about spacing over it. Outside of the grid d is no more than the distance.

    Args:
      origin: the point of the grid with index 0, (dim,), m.
      spacing: (), m.
      values: the distance at each point, an axis a dimension, at least 2 points along each, m; negative inside. All
        those at the border of the grid are above 0.
    Returns: called as ``(t, point)`` with a point (dim,), the signed distance, (), m.
    Raises: ValueError, if spacing is not above 0, shapes do not fit, or the solid reaches the border of the grid.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> bar = jeuler.GridDistance([-2.0], 1.0, [1.0, 0.0, -1.0, 0.0, 1.0])
      >>> [float(bar(0.0, jnp.array([x]))) for x in (0.0, 1.25, 5.0)]
      [-1.0, 0.25, 3.0]

    Source: M. W. Jones, J. A. Baerentzen, M. Sramek, 3D Distance Fields: A Survey of Techniques and Applications, IEEE
      Transactions on Visualization and Computer Graphics 12, 2006.
    """

    origin: Parameter
    spacing: Parameter
    values: Parameter

    def __post_init__(self) -> None:
        store_as_float(self, "origin", "spacing", "values")
        values, origin = self.values, self.origin
        if jnp.ndim(origin) != 1 or jnp.ndim(values) != len(origin) or min(jnp.shape(values)) < 2:
            raise ValueError(
                f"GridDistance.values must have an axis of at least 2 points for each component of origin, "
                f"got shapes {jnp.shape(values)} and {jnp.shape(origin)}"
            )
        checks.above_zero("GridDistance.spacing", self.spacing, "m")
        if not checks.is_traced(values):
            x = np.asarray(values)
            within = np.zeros(x.shape, bool)
            within[(slice(1, -1),) * x.ndim] = True
            if not np.isfinite(x).all() or x[~within].min() <= 0:
                raise ValueError(
                    "GridDistance.values must be finite, and above 0 at the border of the grid, outside of the solid, "
                    f"got {x[~within].min()} there; take a larger grid"
                )

    def __call__(self, t: Any, point: Array) -> Array:
        values, origin, spacing = (x.astype(point.dtype) for x in (self.values, self.origin, self.spacing))
        most = jnp.asarray(values.shape, point.dtype) - 1
        place = (point - origin) / spacing
        nearest = jnp.clip(place, 0, most)
        cell = jnp.minimum(jnp.floor(nearest), most - 1).astype(int)
        share = nearest - cell
        inner = jnp.zeros((), point.dtype)
        for corner in itertools.product((0, 1), repeat=len(values.shape)):
            at = np.array(corner)
            weight = jnp.prod(jnp.where(at == 1, share, 1 - share))
            inner = inner + weight * values[tuple(cell + at)]
        away = spacing * length(place - nearest)
        return jnp.where(away > 0, jnp.maximum(away, inner - away), inner)

    def check(self, dim: int) -> None:
        checks.shape("GridDistance.origin", jnp.shape(self.origin), (dim,), meaning="one a dimension")
