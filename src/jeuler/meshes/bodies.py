"""Particles, springs, bending and masses of a mesh as it lies, of a grid of cloth, of a rope."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.forces import Bending, Springs, Torsion
from jeuler.meshes.reading import points_and_cells
from jeuler.particles import ParticleState


@result
class MeshBody:
    """A body to begin a scene with.

    Args:
      state: its particles at rest, with their masses.
      springs: along the edges of its cells, as long as they lie.
      bending: `Torsion` about the edges between two triangles, `Bending` along threads, or None.
      triangles: of its surface, integers (triangle, 3); none for a rope.
    Example:
      >>> import jeuler
      >>> line = jeuler.rope([0.0, 0.0], [1.0, 0.0], 5, density=0.4, ks=100.0)
      >>> scene = jeuler.Scene((jeuler.Gravity([0.0, -9.81]), *line.forces))
      >>> jeuler.simulate(scene, line.state, dt=0.01, num_steps=10).y.position.shape
      (11, 5, 2)
    """

    state: ParticleState
    springs: Springs
    bending: Torsion | Bending | None
    triangles: np.ndarray

    @property
    def forces(self) -> tuple[Any, ...]:
        """The springs, and the bending if there is any."""
        return (self.springs,) if self.bending is None else (self.springs, self.bending)


@says_what_to_write()
def from_mesh(mesh: Any, *, density: float, ks: Any, kd: Any = 0.0, bending: Any = 0.0) -> MeshBody:
    """Particles, springs and bending of a mesh of triangles or tetrahedra, at rest as it lies.

        m_i = sum over its cells of density (area / 3 or volume / 4),   L = |p_i - p_j|,   rest angles as they are

    Args:
      mesh: a path, read by trimesh (.stl, .obj, .ply, .off, .glb, .gltf) or else by meshio (.msh, .vtk, .vtu; extra
        io), or a pair (points (point, 3), cells (cell, 3 or 4)). Points of no cell are left out.
      density: kg/m^2 of triangles, kg/m^3 of tetrahedra.
      ks: stiffness of each edge, () or (spring,), N/m.
      kd: damping, () or (spring,), N s/m.
      bending: stiffness of `Torsion` about the edges between two triangles, () or (quad,), N m/rad^2; with 0 there is
        none. Of tetrahedra there is none.
    Returns: a `MeshBody`.
    Raises: ValueError, if there is no such file, cells are no triangles or tetrahedra of the points, one has no area or
      volume, or the density is not above 0; RuntimeError, without the library that reads the file.
    Example:
      >>> import numpy as np, jeuler
      >>> square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]
      >>> body = jeuler.from_mesh(square, density=3.0, ks=100.0, bending=0.1)
      >>> body.state.mass.tolist(), [round(length, 2) for length in body.springs.rest_length.tolist()]
      ([1.0, 0.5, 1.0, 0.5], [1.0, 1.41, 1.0, 1.0, 1.0])

    Source: E. Grinspun et al., Discrete Shells, SCA 2003 (bending about edges).
    """
    checks.above_zero("from_mesh: density", density, "kg/m^2 or kg/m^3")
    points, cells = points_and_cells("from_mesh: mesh", mesh)
    size = measure(points, cells)
    empty = np.flatnonzero(size <= 1e-12 * size.max())
    if len(empty):
        raise ValueError(
            f"from_mesh: cells must have an area or a volume, got none for {cells[empty[0]].tolist()}; take it out"
        )
    corners = cells.shape[1]
    mass = np.bincount(cells.ravel(), np.repeat(density * size / corners, corners), len(points))
    first, second = np.triu_indices(corners, 1)
    edges = np.unique(np.sort(np.stack([cells[:, first], cells[:, second]], axis=-1).reshape(-1, 2), axis=1), axis=0)
    triangles = cells if corners == 3 else skin(cells)
    folds = None
    if corners == 3 and not _is_zero(bending):
        quads = folded(cells)
        folds = Torsion(quads, bending, dihedral(points[quads])) if len(quads) else None
    return _body(points, mass, edges, folds, triangles, ks, kd)


@says_what_to_write()
def grid_cloth(
    shape: tuple[int, int], size: tuple[float, float], *, density: float, ks: Any, kd: Any = 0.0, bending: Any = 0.0
) -> MeshBody:
    """A level cloth of rows of particles about the origin, joined along its threads and across its meshes.

    Args:
      shape: particles along x and along y, two integers of at least 2.
      size: its width along x and along y, m.
      density: kg/m^2.
      ks: () or (spring,), N/m.
      kd: () or (spring,), N s/m.
      bending: stiffness of `Bending` along the threads, N m/rad^2; with 0 there is none.
    Returns: a `MeshBody`; particle (i, j) has the index i shape[1] + j.
    Raises: ValueError, if a number is out of its range.
    Example:
      >>> import jeuler
      >>> cloth = jeuler.grid_cloth((3, 4), (1.0, 1.5), density=0.2, ks=50.0)
      >>> cloth.state.position.shape, len(cloth.springs.edges), round(float(cloth.state.mass.sum()), 3)
      ((12, 3), 29, 0.3)
    """
    nx, ny = (checks.count("grid_cloth: shape", n, least=2) for n in shape)
    checks.above_zero("grid_cloth: density", density, "kg/m^2")
    for width in size:
        checks.above_zero("grid_cloth: size", width, "m")
    points, edges, triangles, lines = grid((nx, ny), size)
    along = [np.r_[0.5, np.ones(n - 2), 0.5] / (n - 1) for n in (nx, ny)]
    mass = density * size[0] * size[1] * np.outer(*along).ravel()
    threads = None if _is_zero(bending) or not len(lines) else Bending(lines, bending)
    return _body(points, mass, edges, threads, triangles, ks, kd)


@says_what_to_write()
def rope(
    start: Any, end: Any, particles: int, *, density: float, ks: Any, kd: Any = 0.0, bending: Any = 0.0
) -> MeshBody:
    """A straight rope from one point to another.

    Args:
      start, end: (dim,), m.
      particles: their number, at least 2.
      density: kg/m.
      ks: of each link, () or (spring,), N/m.
      kd: () or (spring,), N s/m.
      bending: stiffness of `Bending`, N m/rad^2; with 0 there is none.
    Returns: a `MeshBody` without triangles.
    Raises: ValueError, if a number is out of its range.
    Example:
      >>> import jeuler
      >>> line = jeuler.rope([0.0, 0.0], [1.0, 0.0], 5, density=0.4, ks=100.0)
      >>> [round(mass, 3) for mass in line.state.mass.tolist()], line.springs.rest_length.tolist()
      ([0.05, 0.1, 0.1, 0.1, 0.05], [0.25, 0.25, 0.25, 0.25])
    """
    n = checks.count("rope: particles", particles, least=2)
    checks.above_zero("rope: density", density, "kg/m")
    start, end = np.asarray(start, float), np.asarray(end, float)
    if start.ndim != 1 or start.shape != end.shape or np.array_equal(start, end):
        raise ValueError(f"rope: start and end must be two different points (dim,), got {start} and {end}")
    number = np.arange(n)
    points = start + np.linspace(0, 1, n)[:, None] * (end - start)
    mass = density * np.linalg.norm(end - start) * np.r_[0.5, np.ones(n - 2), 0.5] / (n - 1)
    lines = np.stack([number[:-2], number[1:-1], number[2:]], axis=1)
    bends = None if _is_zero(bending) or n < 3 else Bending(lines, bending)
    edges = np.stack([number[:-1], number[1:]], axis=1)
    return _body(points, mass, edges, bends, np.zeros((0, 3), int), ks, kd)


def _body(points: Any, mass: Any, edges: Any, bending: Any, triangles: Any, ks: Any, kd: Any) -> MeshBody:
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    state = ParticleState(jnp.asarray(points), jnp.zeros_like(jnp.asarray(points)), mass=jnp.asarray(mass))
    return MeshBody(state, Springs(edges, ks, kd, length), bending, triangles)


def _is_zero(x: Any) -> bool:
    return isinstance(x, (int, float)) and x == 0


def grid(shape: tuple[int, int], size: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, edges, triangles and neighbours in a row (triple, 3) of a level grid about the origin."""
    g = np.arange(shape[0] * shape[1]).reshape(shape)
    x, y = np.meshgrid(*(np.linspace(-w / 2, w / 2, n) for n, w in zip(shape, size, strict=True)), indexing="ij")
    a, b, c, d = g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]
    return (
        np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3),
        np.concatenate([table(g[:-1], g[1:]), table(g[:, :-1], g[:, 1:]), table(a, c), table(d, b)]),
        np.concatenate([table(a, b, c), table(a, c, d)]),
        np.concatenate([table(g[:-2], g[1:-1], g[2:]), table(g[:, :-2], g[:, 1:-1], g[:, 2:])]),
    )


def table(*columns: np.ndarray) -> np.ndarray:
    """Index arrays of like shape as the columns of a table, (row, column)."""
    return np.stack(columns, axis=-1).reshape(-1, len(columns))


def measure(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The area of each triangle, m^2, or the volume of each tetrahedron, m^3."""
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    if cells.shape[1] == 3:
        return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    return np.abs(np.linalg.det(sides)) / 6


def skin(tetrahedra: np.ndarray) -> np.ndarray:
    """The faces that are those of one tetrahedron alone, integers (triangle, 3)."""
    faces = np.concatenate([tetrahedra[:, k] for k in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])])
    _, first, times = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[times == 1])]


def folded(triangles: np.ndarray) -> np.ndarray:
    """(i, j, k, l) for each edge j-k between two triangles (i, j, k) and (j, k, l), integers (quad, 4)."""
    sides = np.concatenate(
        [triangles[:, k] for k in ([0, 1, 2], [1, 2, 0], [2, 0, 1])]
    )  # the edge, and who is opposite
    edge = np.sort(sides[:, :2], axis=1)
    order = np.lexsort((edge[:, 1], edge[:, 0]))
    edge, opposite = edge[order], sides[order, 2]
    same = np.flatnonzero((edge[1:] == edge[:-1]).all(axis=1))
    return np.column_stack([opposite[same], edge[same], opposite[same + 1]])


def dihedral(corners: np.ndarray) -> np.ndarray:
    """The angle of `Torsion` of each quad, of its corners (quad, 4, 3): rad."""
    a, b, c = np.moveaxis(np.diff(corners, axis=1), 1, 0)
    m, n = np.cross(a, b), np.cross(b, c)
    return np.arctan2(np.linalg.norm(b, axis=1) * np.sum(a * n, axis=1), np.sum(m * n, axis=1))
