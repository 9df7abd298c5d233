"""Solids as triangles, for pictures that are turned by hand or lit by a renderer."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.component import as_component
from jeuler.contact.colliders import Box, Plane, Sphere


def middle(collider: Any, t: float) -> np.ndarray:
    """Where a ball or a box is; empty for all others."""
    if not isinstance(collider, (Sphere, Box)):
        return np.zeros(0)
    return np.asarray(collider.center(t) if callable(collider.center) else collider.center)


def is_shell(collider: Any) -> bool:
    """Whether it is a wall around the particles, of which one sees the far half."""
    return isinstance(collider, Sphere) and collider.inside


def mesh_of(
    collider: Any, t: float, center: np.ndarray, half: np.ndarray, cells: int = 60
) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a solid in space within the view, center and half (3,): points (point, 3), triangles (face, 3).

    A ball or a box by its own shape, all others by their upper side; no points where there is none.
    """
    if isinstance(collider, Sphere):
        return ball(middle(collider, t), float(collider.radius), cells)
    if isinstance(collider, Box):
        half = np.broadcast_to(np.asarray(collider.half_size), 3)
        return block(middle(collider, t), half, cells // 2 if cells > 60 else 1)
    x, y, z = upper_side(collider, t, center, half, cells)
    return heights_as_mesh(x, y, z)


def fine_mesh_of(collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """As `mesh_of`, finer near the middle of the view and farther out; and whether it is the ground."""
    if isinstance(collider, (Sphere, Box)):
        return *mesh_of(collider, t, center, half, cells=120), False
    wide = half[:2].max()
    u = np.linspace(-1, 1, 401)
    x, y = np.meshgrid(*(center[k] + 12 * wide * (0.06 * u + 0.94 * u**3) for k in range(2)), indexing="ij")
    if isinstance(collider, Plane):
        point, normal = np.asarray(collider.point), np.asarray(collider.normal)
        if abs(normal[2]) < 1e-6 * np.linalg.norm(normal):
            return np.zeros((0, 3)), np.zeros((0, 3), int), True
        z = point[2] - ((x - point[0]) * normal[0] + (y - point[1]) * normal[1]) / normal[2]
    else:
        z = highest_zero(collider, t, x, y, center[2] - 2 * wide, center[2] + 2 * wide)
    return *heights_as_mesh(x, y, z), True


def highest_zero(collider: Any, t: float, x: np.ndarray, y: np.ndarray, low: float, high: float) -> np.ndarray:
    """The height at which a ray from above meets a solid, by steps of its distance; NaN where it meets none."""
    z = np.full(x.shape, high)
    for _ in range(40):
        z = z - np.maximum(distances(collider, t, np.stack([x, y, z], axis=-1)), 0)
    return np.where((z > low) & (z < high), z, np.nan)


def ball(center: np.ndarray, radius: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * cells + 1), np.linspace(0, np.pi, cells + 1), indexing="ij")
    points = center + radius * np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)], axis=-1)
    return points.reshape(-1, 3), grid_triangles(a.shape)[:, ::-1]


def block(center: np.ndarray, half: np.ndarray, cells: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Six sides with corners of their own, so that edges stay sharp where normals are smoothed."""
    points: list[np.ndarray] = []
    triangles: list[np.ndarray] = []
    u, v = np.meshgrid(*[np.linspace(-1, 1, cells + 1)] * 2, indexing="ij")
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners = np.roll(np.stack([np.full_like(u, side), side * u, v], axis=-1), axis, axis=-1)
            triangles.append(grid_triangles(u.shape) + u.size * len(points))
            points.append(center + half * corners.reshape(-1, 3))
    return np.concatenate(points), np.concatenate(triangles)


def grid_triangles(shape: tuple[int, ...]) -> np.ndarray:
    """Two triangles for each mesh of a grid of points, (face, 3)."""
    g = np.arange(shape[0] * shape[1]).reshape(shape)
    a, b, c, d = (part.ravel() for part in (g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def heights_as_mesh(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (point, 3) and triangles (face, 3) of heights over a grid, without those that are not finite."""
    there = np.isfinite(z)
    triangles = grid_triangles(z.shape)
    number = np.cumsum(there) - 1
    return np.stack([x, y, z], axis=-1)[there], number[triangles[there.ravel()[triangles].all(axis=1)]]


def upper_side(
    collider: Any, t: float, center: np.ndarray, half: np.ndarray, cells: int = 60
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each place (x, y) of a grid, the highest z at which the distance is 0, NaN where there is none."""
    reach = (5.0 if isinstance(collider, Plane) else 2.0) * half
    x, y = (np.linspace(center[k] - reach[k], center[k] + reach[k], cells + 1) for k in range(2))
    z = np.linspace(center[2] - 1.3 * half[2], center[2] + 1.3 * half[2], 96)
    d = distances(collider, t, np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1))
    inside = d <= 0
    top = d.shape[2] - 1 - np.argmax(inside[:, :, ::-1], axis=2)
    there = inside.any(axis=2) & (top < d.shape[2] - 1)
    i, j = np.indices(top.shape)
    low = np.minimum(top, d.shape[2] - 2)
    below, above = d[i, j, low], d[i, j, low + 1]
    share = np.where(there, below / np.where(below == above, 1, below - above), 0)
    height = np.where(there, z[low] + share * (z[1] - z[0]), np.nan)
    x, y = np.meshgrid(x, y, indexing="ij")
    return x, y, height


def distances(collider: Any, t: float, points: np.ndarray) -> np.ndarray:
    """The distance at points (..., dim)."""
    collider = as_component(collider)
    flat = jnp.asarray(points.reshape(-1, points.shape[-1]))
    return np.asarray(_distances(collider, jnp.asarray(t, flat.dtype), flat)).reshape(points.shape[:-1])


@jax.jit
def _distances(collider: Any, t: Any, points: Any) -> Any:
    return jax.vmap(collider, (None, 0))(t, points)
