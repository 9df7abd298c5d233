"""Bodies to begin a scene with: where their particles are at rest, and what is joined to what."""

from __future__ import annotations

import numpy as np

from jeuler._core.component import result
from jeuler.meshes.bodies import grid, table


@result
class Body:
    """Particles at rest and how they are joined.

    Args:
      position: (particle, 3), m.
      edges: the pairs for `Springs`, integers (spring, 2).
      faces: the triangles of its surface, for ``plotting.Look``, integers (face, 3).
      lines: neighbours in a row, for `Bending`, integers (triple, 3).
    """

    position: np.ndarray
    edges: np.ndarray
    faces: np.ndarray
    lines: np.ndarray

    @property
    def length(self) -> np.ndarray:
        """Of each edge at rest, (spring,), m."""
        return np.linalg.norm(self.position[self.edges[:, 0]] - self.position[self.edges[:, 1]], axis=1)


def square_cloth(side: int, width: float) -> Body:
    """A level square of side x side particles about the origin, joined along its threads and across its meshes."""
    return Body(*grid((side, side), (width, width)))


def cube(side: int, width: float) -> Body:
    """A cube of side^3 particles about the origin, joined to the next along each axis, with its skin as faces."""
    g = np.arange(side**3).reshape(side, side, side)
    along = np.linspace(-width / 2, width / 2, side)
    faces = []
    for axis in range(3):
        for skin in (g.take([0], axis).squeeze(axis), g.take([-1], axis).squeeze(axis)):
            a, b, c, d = skin[:-1, :-1], skin[1:, :-1], skin[1:, 1:], skin[:-1, 1:]
            faces += [table(a, b, c), table(a, c, d)]
    return Body(
        position=np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3),
        edges=np.concatenate([table(g[:-1], g[1:]), table(g[:, :-1], g[:, 1:]), table(g[:, :, :-1], g[:, :, 1:])]),
        faces=np.concatenate(faces),
        lines=np.zeros((0, 3), int),
    )


def curls(
    strands: int, nodes: int, *, length: float, head: float, curl: float, coils: float, face: float, seed: int = 0
) -> np.ndarray:
    """Curls that lie on a head about the origin and hang down from its widest part: (strand, node, 3), m.

    Args:
      length: of a lock from root to tip, m; the hair in it is longer.
      head: radius of the head, m.
      curl: radius of the coils, m.
      coils: turns of a lock.
      face: the direction in which no hair grows, rad about the vertical axis.
    """
    random = np.random.default_rng(seed)
    around = face + np.linspace(0.9, 2 * np.pi - 0.9, strands) + random.uniform(-0.02, 0.02, strands)
    from_top = random.permutation(np.arccos(np.linspace(0.99, 0.1, strands)))  # rad: where on the head the root is
    s = length * np.linspace(0, 1, nodes)[None, :]
    radius = head + curl + random.uniform(0.0, 0.04, (strands, 1))
    angle = np.minimum(from_top[:, None] + s / radius, np.pi / 2)  # along the head,
    below = np.maximum(s - (np.pi / 2 - from_top[:, None]) * radius, 0)  # then straight down
    outward = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)[:, None]
    sideways = np.stack([-np.sin(around), np.cos(around), 0 * around], axis=1)[:, None]
    down = np.array([0.0, 0.0, -1.0])
    core = radius[..., None] * (np.sin(angle)[..., None] * outward - np.cos(angle)[..., None] * down)
    core = core + below[..., None] * down
    normal = np.sin(angle)[..., None] * outward - np.cos(angle)[..., None] * down
    turn = 2 * np.pi * coils * s[..., None] / length + random.uniform(0, 2 * np.pi, (strands, 1, 1))
    swell = curl * np.minimum(1, 3 * s[..., None] / length)
    return core + swell * (np.cos(turn) * normal + np.sin(turn) * sideways)
