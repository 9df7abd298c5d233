"""Triangles and tetrahedra from files, by libraries that read them, or from arrays."""

from __future__ import annotations

import os
import pathlib
from typing import Any

import numpy as np

from jeuler._core import checks

SURFACES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")  # read by trimesh; all others by meshio


def points_and_cells(name: str, mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """The points (point, 3) and the triangles (cell, 3) or tetrahedra (cell, 4) of a file, or of a pair of arrays.

    Points of no cell are left out. Tetrahedra go before triangles where a file has both.
    """
    if isinstance(mesh, (str, os.PathLike)):
        points, cells = _read(pathlib.Path(mesh))
    elif isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        points, cells = (
            np.asarray(mesh[0], float),
            checks.integers(f"{name}: cells", mesh[1], "integers (cell, 3 or 4)"),
        )
    else:
        raise ValueError(f"{name} must be a path or a pair (points, cells), got {checks.shown(mesh)}")
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"{name}: points must be finite numbers of shape (point, 3), got shape {points.shape}")
    if cells.ndim != 2 or cells.shape[1] not in (3, 4) or not len(cells):
        raise ValueError(f"{name}: cells must be triangles (cell, 3) or tetrahedra (cell, 4), got shape {cells.shape}")
    if cells.min() < 0 or cells.max() >= len(points):
        raise ValueError(
            f"{name}: cells must be indices of the {len(points)} points, got {cells.min()} to {cells.max()}"
        )
    ordered = np.sort(cells, axis=1)
    twice = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(twice):
        raise ValueError(f"{name}: cells must have different corners, got {cells[twice[0]].tolist()}; take it out")
    used, numbers = np.unique(cells, return_inverse=True)
    return np.asarray(points[used], float), numbers.reshape(cells.shape)


def _read(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    if not path.exists():
        raise ValueError(f"there is no file {str(path)!r} to read a mesh from")
    library = "trimesh" if path.suffix.lower() in SURFACES else "meshio"
    try:
        if library == "trimesh":
            import trimesh

            read: Any = trimesh.load(path, force="mesh")  # joins points at one place
            return np.asarray(read.vertices, float), np.asarray(read.faces, int)
        import meshio
    except ImportError:
        raise RuntimeError(
            f"a mesh of {path.suffix!r} is read by {library}, which is not installed; pip install 'jeuler[io]'"
        ) from None
    found = meshio.read(path)
    kinds = found.cells_dict
    points = np.pad(found.points, [(0, 0), (0, 3 - found.points.shape[1])])
    if "tetra" in kinds:
        return points, np.asarray(kinds["tetra"], int)
    quads = np.asarray(kinds.get("quad", np.zeros((0, 4), int)), int)
    parts = [np.asarray(kinds.get("triangle", np.zeros((0, 3), int)), int), quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return points, np.concatenate(parts)
