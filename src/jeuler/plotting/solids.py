"""Colliders as a picture shows them: spheres and boxes by their own shape, all others by where distance is 0."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler import _tree

FILL, EDGE = "#d9d4c7", "#8a8578"


def draw_collider(ax: Any, collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> list[Any]:
    """Draw a signed distance ``collider(t, point) -> ()`` within center +- half; returns the artists."""
    return _in_plane(ax, collider, t, center, half) if len(center) == 2 else _in_space(ax, collider, t, center, half)


def distances(collider: Any, t: float, points: np.ndarray) -> np.ndarray:
    """The distance at points (..., dim)."""
    collider = _tree.as_component(collider)
    flat = jnp.asarray(points.reshape(-1, points.shape[-1]))
    return np.asarray(_distances(collider, jnp.asarray(t, flat.dtype), flat)).reshape(points.shape[:-1])


@jax.jit
def _distances(collider: Any, t: Any, points: Any) -> Any:
    return jax.vmap(collider, (None, 0))(t, points)


def in_sight(colliders: list, t: float, position: np.ndarray, toward: np.ndarray, far: float) -> np.ndarray:
    """Which particles no solid hides from a viewer in the direction ``toward``: (particle,), by steps along the ray."""
    steps = far * np.linspace(0.01, 1.0, 40) ** 1.5
    ray = np.nan_to_num(position)[:, None] + steps[:, None] * toward
    nearest = np.min([distances(collider, t, ray).min(axis=1) for collider in colliders], axis=0)
    return nearest > -0.002 * far


def _in_plane(ax: Any, collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> list[Any]:
    """The solid part, filled, with its outline."""
    x, y = (np.linspace(center[k] - 1.5 * half[k], center[k] + 1.5 * half[k], 200) for k in range(2))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    d = distances(collider, t, points)
    if not (d.min() < 0 < d.max()):
        return []
    limits = ax.get_xlim(), ax.get_ylim()
    artists = [
        ax.contourf(x, y, d, levels=[d.min() - 1, 0], colors=[FILL], zorder=0),
        ax.contour(x, y, d, levels=[0], colors=[EDGE], linewidths=0.8, zorder=1),
    ]
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])
    return artists


def _in_space(ax: Any, collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> list[Any]:
    kind = type(collider).__name__
    if kind == "Sphere":
        middle = np.asarray(collider.center(t) if callable(collider.center) else collider.center)
        a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 40), np.linspace(0, np.pi, 20))
        ball = np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)]) * float(collider.radius)
        return [_surface(ax, *(ball + middle[:, None, None]))]
    if kind == "Box":
        middle = np.asarray(collider.center(t) if callable(collider.center) else collider.center)
        return _box(ax, middle, np.broadcast_to(np.asarray(collider.half_size), 3))
    return _height(ax, collider, t, center, half)


def _surface(ax: Any, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Any:
    return ax.plot_surface(x, y, z, color=FILL, alpha=0.85, linewidth=0, antialiased=True, zorder=0)


def _box(ax: Any, middle: np.ndarray, half: np.ndarray) -> list[Any]:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            corners = np.tile(middle, (4, 1)).astype(float)
            corners[:, axis] += side * half[axis]
            corners[:, u] += half[u] * np.array([-1, 1, 1, -1])
            corners[:, v] += half[v] * np.array([-1, -1, 1, 1])
            faces.append(corners)
    solid = Poly3DCollection(faces, facecolors=FILL, edgecolors=EDGE, linewidths=0.4, alpha=0.85, zorder=0)
    return [ax.add_collection3d(solid)]


def _height(ax: Any, collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> list[Any]:
    """The upper side of any other solid: for each place (x, y), the highest z at which the distance is 0."""
    x, y = (np.linspace(center[k] - 1.5 * half[k], center[k] + 1.5 * half[k], 60) for k in range(2))
    z = np.linspace(center[2] - 1.3 * half[2], center[2] + 1.3 * half[2], 96)
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    d = distances(collider, t, points)
    inside = d <= 0
    top = d.shape[2] - 1 - np.argmax(inside[:, :, ::-1], axis=2)
    there = inside.any(axis=2) & (top < d.shape[2] - 1)
    if not there.any():
        return []
    i, j = np.indices(top.shape)
    low = np.minimum(top, d.shape[2] - 2)
    below, above = d[i, j, low], d[i, j, low + 1]
    share = np.where(there, below / np.where(below == above, 1, below - above), 0)
    height = np.where(there, z[low] + share * (z[1] - z[0]), np.nan)
    return [_surface(ax, *np.meshgrid(x, y, indexing="ij"), height)]
