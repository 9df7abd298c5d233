"""What a still is made of: triangles with normals and colours, and the light that falls on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

SKY = 16  # directions from which the sky shines
SKY_LIGHT, SUN_LIGHT = np.array([0.42, 0.48, 0.56]), np.array([0.95, 0.86, 0.72])
BOUNCED = np.array([0.16, 0.14, 0.12])  # light from below


@dataclasses.dataclass
class Model:
    """Triangles of one kind.

    Args:
      points, normals: (point, 3); rgba: (point, 4), from 0 to 1; faces: (face, 3).
      shine: strength of the highlight; soft: how far light goes into the matter, 0 to 1.
      casts: whether it throws a shadow.
    """

    points: np.ndarray
    normals: np.ndarray
    rgba: np.ndarray
    faces: np.ndarray
    shine: float = 0.0
    soft: float = 0.0
    casts: bool = True


def model(points: np.ndarray, faces: np.ndarray, rgba: np.ndarray, **kind: Any) -> Model:
    """With normals that are smooth over the faces about a point."""
    normals = np.zeros_like(points)
    a, b, c = (points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, k], across[:, axis], len(points))
    return Model(points, unit(normals), np.broadcast_to(rgba, (len(points), 4)).astype(float), faces, **kind)


def copies(shape: Model, at: np.ndarray, size: np.ndarray, rgba: np.ndarray, way: np.ndarray | None = None) -> Model:
    """One shape at many places (copy, 3), each of its size and colour, its x axis turned to its way (copy, 3)."""
    frame = np.tile(np.eye(3), (len(at), 1, 1))
    if way is not None:
        x = unit(way)
        y = unit(np.cross([0.0, 0.0, 1.0], x))
        frame = np.stack([x, y, np.cross(x, y)], axis=1)
    points = at[:, None] + size[:, None, None] * np.einsum("pj,cji->cpi", shape.points, frame)
    normals = np.einsum("pj,cji->cpi", shape.normals, frame)
    faces = shape.faces + len(shape.points) * np.arange(len(at))[:, None, None]
    tint = rgba[:, None] * shape.rgba
    return dataclasses.replace(
        shape, points=points.reshape(-1, 3), normals=normals.reshape(-1, 3), rgba=tint.reshape(-1, 4),
        faces=faces.reshape(-1, 3),
    )  # fmt: skip


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)


def frame_along(way: np.ndarray) -> np.ndarray:
    """Three unit vectors at right angles, the last one along the unit vector ``way``: (3, 3)."""
    right = unit(np.cross([0.0, 0.0, 1.0] if abs(way[2]) < 0.9 else [0.0, 1.0, 0.0], way))
    return np.stack([right, np.cross(way, right), way])


def sky_directions(count: int = SKY) -> np.ndarray:
    """Unit vectors over the upper half, as many where the sky is high as it is bright there: (count, 3)."""
    k = np.arange(count) + 0.5
    z, angle = np.sqrt(1 - k / count), k * np.pi * (3 - np.sqrt(5))
    side = np.sqrt(1 - z**2)
    return np.stack([side * np.cos(angle), side * np.sin(angle), z], axis=1)


@dataclasses.dataclass
class Shadows:
    """How deep the light reaches, seen from a direction: what is behind is in the shade.

    Args:
      frame: rows right, up, toward the light; low: (2,), m, the corner of the map; cell: m a pixel.
      height: along the light of what is first, (row, column), -inf where there is nothing.
    """

    frame: np.ndarray
    low: np.ndarray
    cell: float
    height: np.ndarray

    def lit(self, points: np.ndarray, blur: float, samples: int) -> np.ndarray:
        """The share of the light at points (point, 3), by samples on a disc of radius ``blur``, m."""
        place = points @ self.frame.T
        bias = 2.5 * self.cell
        total = np.zeros(len(points))
        for k in range(samples):
            r = blur * np.sqrt((k + 0.5) / samples)
            move = r * np.array([np.cos(2.4 * k), np.sin(2.4 * k)])
            column, row = np.floor((place[:, :2] + move - self.low) / self.cell).astype(int).T
            rows, columns = self.height.shape
            outside = (row < 0) | (row >= rows) | (column < 0) | (column >= columns)
            first = self.height[row.clip(0, rows - 1), column.clip(0, columns - 1)]
            total += outside | (first < place[:, 2] + bias + 0.7 * r)
        return total / samples


def bake(
    models: list[Model], shadows: Callable[[np.ndarray], Shadows], sun: np.ndarray, eye: np.ndarray, reach: float
) -> list[np.ndarray]:
    """The colours of all models, (point, 4): light of the sky and of the sun where nothing is before them.

    shadows: makes the `Shadows` of a direction; reach: half the width of the view, m.
    """
    samples = 4 if sum(len(m.points) for m in models) < 500_000 else 1
    sky, seen = [np.zeros(len(m.points)) for m in models], sky_directions()
    for direction in seen:
        depth = shadows(direction)
        for k, m in enumerate(models):
            facing = np.clip((facing_eye(m, eye) @ direction) * (1 - m.soft) + m.soft, 0, None)
            sky[k] += facing * depth.lit(m.points, 0.02 * reach, samples)
    depth, colours = shadows(sun), []
    for k, m in enumerate(models):
        normals, toward = facing_eye(m, eye), unit(eye - m.points)
        direct = np.clip((normals @ sun) * (1 - m.soft) + m.soft, 0, None)
        shade = depth.lit(m.points, 0.006 * reach, 16)
        half = unit(toward + sun)
        glint = m.shine * (shade * np.clip(np.sum(normals * half, axis=1), 0, 1) ** 40)
        rim = 0.35 * m.shine * (1 - np.abs(np.sum(normals * toward, axis=1))) ** 4
        light = (sky[k] / len(seen) * 1.5)[:, None] * SKY_LIGHT + (direct * shade)[:, None] * SUN_LIGHT
        light = light + (0.5 - 0.5 * normals[:, 2:]) * BOUNCED
        rgb = m.rgba[:, :3] * light + (glint + rim)[:, None]
        colours.append(np.concatenate([exposed(rgb), m.rgba[:, 3:]], axis=1))
    return colours


def facing_eye(m: Model, eye: np.ndarray) -> np.ndarray:
    """Normals on the side that is seen."""
    away = np.sum(m.normals * (eye - m.points), axis=1) < 0
    return np.where(away[:, None], -m.normals, m.normals)


def exposed(rgb: np.ndarray) -> np.ndarray:
    """Light as the film shows it: dark as it is, bright rolled off to white, so that nothing is cut off at 1."""
    knee = 0.6
    return np.where(rgb < knee, rgb, knee + (1 - knee) * (1 - np.exp(-np.maximum(rgb - knee, 0) / (1 - knee))))
