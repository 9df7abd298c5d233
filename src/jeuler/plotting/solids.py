"""Colliders as a picture shows them: spheres and boxes by their own shape, all others by where distance is 0."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colors

from jeuler.contact.colliders import Sphere
from jeuler.plotting.surfaces import distances, is_shell, middle, upper_side

FILL, EDGE = "#d9d4c7", "#8a8578"


def draw_colliders(ax: Any, colliders: list[Any], t: float, view: Any) -> list[Any]:
    """Draw signed distances ``collider(t, point) -> ()`` within the view; returns the artists.

    In space the ground comes first, then balls and boxes from the far ones to the near ones.
    """
    if len(view.center) == 2:
        return [artist for c in colliders for artist in _in_plane(ax, c, t, view.center, view.half)]
    toward = view.toward_viewer(t)
    ground = [c for c in colliders if not middle(c, t).size]
    solids = [c for c in colliders if middle(c, t).size]
    solids.sort(key=lambda c: -np.inf if is_shell(c) else float(middle(c, t) @ toward))
    artists = [artist for c in ground for artist in _height(ax, c, t, view.center, view.half)]
    for depth, solid in enumerate(solids):
        draw = _ball if isinstance(solid, Sphere) else _box
        artists.append(draw(ax, solid, middle(solid, t), toward, 0.1 + depth / (1 + len(solids))))
    return artists


def shaded(rgba: np.ndarray, corners: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Colours (face, 4) in a light that comes from above, on the viewer's left; corners (face, corner, 3).

    A thin surface is lit alike on both its sides.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    normal = normal * np.where(normal @ toward < 0, -1.0, 1.0)[:, None]
    left = np.array([toward[1], -toward[0], 0.0])
    light = 0.8 * np.array([0.0, 0.0, 1.0]) + 0.5 * left + 0.4 * toward
    strength = 0.45 + 0.6 * np.clip(normal @ (light / np.linalg.norm(light)), 0, 1)
    return np.concatenate([np.clip(rgba[:, :3] * strength[:, None], 0, 1), rgba[:, 3:]], axis=1)


def in_sight(colliders: list[Any], t: float, position: np.ndarray, toward: np.ndarray, far: float) -> np.ndarray:
    """Which particles no solid hides from a viewer in the direction ``toward``: (particle,), by steps along the ray."""
    steps = far * np.linspace(0.01, 1.0, 40) ** 1.5
    ray = np.nan_to_num(position)[:, None] + steps[:, None] * toward
    nearest = np.min([distances(collider, t, ray).min(axis=1) for collider in colliders], axis=0)
    return nearest > -0.002 * far


def _in_plane(ax: Any, collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> list[Any]:
    """The solid part, filled, with its outline."""
    x, y = (np.linspace(center[k] - 1.05 * half[k], center[k] + 1.05 * half[k], 700) for k in range(2))
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


def _ball(ax: Any, ball: Any, center: np.ndarray, toward: np.ndarray, zorder: float) -> Any:
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(0, np.pi, 31))
    grid = np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)], axis=-1) * float(ball.radius) + center
    faces = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)
    near = (faces.mean(axis=1) - center) @ toward > 0
    return _polygons(ax, faces[~near if is_shell(ball) else near], toward, zorder)


def _box(ax: Any, box: Any, center: np.ndarray, toward: np.ndarray, zorder: float) -> Any:
    half, faces = np.broadcast_to(np.asarray(box.half_size), 3), []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corners = np.tile(center, (4, 1)).astype(float)
        corners[:, axis] += half[axis] * (1 if toward[axis] > 0 else -1)  # of two sides one is seen
        corners[:, u] += half[u] * np.array([-1, 1, 1, -1])
        corners[:, v] += half[v] * np.array([-1, -1, 1, 1])
        faces.append(corners)
    return _polygons(ax, np.array(faces), toward, zorder, edge=EDGE)


def _polygons(ax: Any, faces: np.ndarray, toward: np.ndarray, zorder: float, edge: Any = None) -> Any:
    """Faces (face, corner, 3), lit; without an edge they have that of their own colour, which closes the seams."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    color = shaded(np.tile(colors.to_rgba(FILL), (len(faces), 1)), faces, toward)
    solid = Poly3DCollection(faces, facecolors=color, edgecolors=edge or color, linewidths=0.4, zorder=zorder)
    return ax.add_collection3d(solid)


def _height(ax: Any, collider: Any, t: float, center: np.ndarray, half: np.ndarray) -> list[Any]:
    """The upper side of any other solid."""
    x, y, height = upper_side(collider, t, center, half)
    if not np.isfinite(height).any():
        return []
    return [ax.plot_surface(x, y, height, color=FILL, alpha=0.85, linewidth=0, antialiased=True, zorder=0)]
