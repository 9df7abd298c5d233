"""A closed mesh as a solid to collide with: its signed distance, on a grid."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.triangles import nearest_weights
from jeuler.contact.grid import GridDistance
from jeuler.meshes.reading import points_and_cells

AT_ONCE = 2**20  # pairs of a point and a triangle
MARGIN = 2  # cells of the grid around the mesh


@says_what_to_write()
def mesh_collider(mesh: Any, *, spacing: float) -> GridDistance:
    """The solid within a closed mesh of triangles, as a `GridDistance`, for `Collisions` and `PenaltyContact`.

    At the points of the grid the distance is that to the nearest triangle, negative where the mesh winds around the
    point. Its making takes points of the grid times triangles.

    Args:
      mesh: a path or a pair (points, triangles), as for `from_mesh`.
      spacing: of the grid, m: what is smaller than that is smoothed away.
    Returns: a collider ``(t, point)``, m.
    Raises: ValueError, if the mesh is none of triangles, is not closed, or turns its triangles in different ways.
    Example:
      >>> import jax.numpy as jnp, numpy as np, jeuler
      >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
      >>> solid = jeuler.mesh_collider((corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), spacing=0.1)
      >>> round(float(solid(0.0, jnp.array([0.3, 0.3, -0.15]))), 4)
      0.15

    Source: A. Jacobson et al., Robust Inside-Outside Segmentation using Generalized Winding Numbers, ACM Transactions
      on Graphics 32, 2013, eq. 6.
    """
    checks.above_zero("mesh_collider: spacing", spacing, "m")
    points, triangles = points_and_cells("mesh_collider: mesh", mesh)
    if triangles.shape[1] != 3:
        raise ValueError("mesh_collider: mesh must be one of triangles, got tetrahedra; take from_mesh(...).triangles")
    low = points.min(axis=0) - MARGIN * spacing
    count = np.ceil((points.max(axis=0) + MARGIN * spacing - low) / spacing).astype(int) + 1
    axes = [low[k] + spacing * np.arange(count[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, winding = signed_parts(grid, points[triangles])
    clear = distance > 1e-3 * spacing  # on a triangle the winding number is none
    if np.abs(winding - np.round(winding))[clear].max(initial=0) > 0.01:
        raise ValueError("mesh_collider: mesh must be closed, with all triangles turned alike; mend it before")
    inside = np.abs(winding) > 0.5
    return GridDistance(low, spacing, np.where(inside, -distance, distance).reshape(tuple(count)))


def signed_parts(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distance of each point from the nearest triangle, and how often these wind around it: (point,) each."""
    rows = max(AT_ONCE // len(corners), 1)
    padded = np.pad(points, [(0, -len(points) % rows), (0, 0)], mode="edge").reshape(-1, rows, 3)
    with jax.enable_x64(True):
        distance, winding = _of_chunks(jnp.asarray(padded, float), jnp.asarray(corners, float))
        return np.asarray(distance).ravel()[: len(points)], np.asarray(winding).ravel()[: len(points)]


@functools.partial(jax.jit)
def _of_chunks(chunks: Array, corners: Array) -> tuple[Array, Array]:
    def one(points):
        p, triangle = points[:, None], corners[None]
        weights = nearest_weights(p, triangle)
        off = p - jnp.sum(weights[..., None] * triangle, axis=-2)
        a, b, c = (triangle[..., k, :] - p for k in range(3))
        la, lb, lc = (jnp.linalg.norm(x, axis=-1) for x in (a, b, c))
        solid = jnp.sum(a * jnp.cross(b, c), axis=-1)
        cosines = (
            la * lb * lc + lc * jnp.sum(a * b, axis=-1) + la * jnp.sum(b * c, axis=-1) + lb * jnp.sum(c * a, axis=-1)
        )
        angle = jnp.sum(jnp.atan2(solid, cosines), axis=1) / (2 * jnp.pi)
        return jnp.sqrt(jnp.min(jnp.sum(off * off, axis=-1), axis=1)), angle

    return lax.map(one, chunks)
