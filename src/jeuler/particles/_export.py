"""Runs of particles as files that other programs open."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler.particles.state import ParticleState, check_run, in_space
from jeuler.solving.dataset import to_dataset

CODES_A_SECOND = 24  # time codes of a file for films


@says_what_to_write()
def export(solution: Any, path: Any, *, edges: Any = ()) -> list[pathlib.Path]:
    """Write a run of particles to files, by the end of the path.

    ".npz" holds the times and each field of the state, as NumPy reads them. ".xyz" is one file of all saved times in
    extended XYZ, for OVITO. ".vtk" is one file for each saved time, run_0000.vtk and so on, for ParaView: particles
    as points, edges as lines. ".ply" is the same in the Stanford format, with colours where the state has them. In
    .xyz, .vtk, .ply and .usd the dead are left out; what lies on a line or in a plane has 0 as the other coordinates.
    ".nc" is NetCDF 3, the dataset of ``solution.to_xarray()``. ".usd", ".usda" and ".usdc" are one file of all saved
    times for Blender, Omniverse and Houdini: points with velocities, numbers, and the state's size, color and opacity,
    edges as curves, 24 time codes a second (extra io).

    Args:
      solution: what `simulate` returned, its ``.y`` a `ParticleState` with leading axis saved.
      path: where to; its folder must be there.
      edges: pairs of particles drawn as lines, integers (edge, 2), such as ``springs.edges``; for .vtk, .ply and
        .usd. One with a dead end is left out.
    Returns: the paths that were written, in the order of time.
    Raises: ValueError, if the solution holds no states, or the path ends otherwise; RuntimeError, for ".usd" without
      usd-core.
    Example:
      >>> import os, tempfile, jax.numpy as jnp, numpy as np, jeuler
      >>> state = jeuler.ParticleState(jnp.zeros((3, 2)), jnp.ones((3, 2)))
      >>> run = jeuler.simulate(jeuler.Scene(), state, dt=0.5, num_steps=2)
      >>> with tempfile.TemporaryDirectory() as folder:
      ...     (path,) = jeuler.export(run, os.path.join(folder, "run.npz"))
      ...     np.load(path)["position"].shape
      (3, 3, 2)
    """
    path = pathlib.Path(path)
    check_run("export", solution)
    writers = {".npz": _write_npz, ".xyz": _write_xyz, ".vtk": _write_vtk, ".ply": _write_ply, ".nc": _write_nc}
    writers |= dict.fromkeys((".usd", ".usda", ".usdc"), _write_usd)
    if path.suffix not in writers:
        raise ValueError(f"export writes {', '.join(writers)}, got {path.name!r}; give the path one of these ends")
    pairs = np.asarray(edges, int).reshape(-1, 2) if len(edges) else np.zeros((0, 2), int)
    particles = solution.y.position.shape[1]
    if pairs.size and not (pairs.min() >= 0 and pairs.max() < particles):
        raise ValueError(f"edges must be indices of the {particles} particles, got {checks.shown(pairs.tolist())}")
    return writers[path.suffix](solution, path, pairs)


def _write_npz(solution: Any, path: pathlib.Path, pairs: np.ndarray) -> list[pathlib.Path]:
    fields: dict[str, Any] = {name: np.asarray(getattr(solution.y, name)) for name in solution.y.fields()}
    np.savez_compressed(path, t=np.asarray(solution.t), **fields)
    return [path]


def _write_nc(solution: Any, path: pathlib.Path, pairs: np.ndarray) -> list[pathlib.Path]:
    to_dataset(solution).to_netcdf(path, engine="scipy")
    return [path]


def _living(state: ParticleState, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Who lives at a saved time, and their positions and velocities, (living, 3)."""
    position, velocity = np.asarray(state.position[n]), np.asarray(state.velocity[n])
    here = np.ones(len(position), bool) if state.alive is None else np.asarray(state.alive[n])
    return here, in_space(position[here]), in_space(velocity[here])


def _write_xyz(solution: Any, path: pathlib.Path, pairs: np.ndarray) -> list[pathlib.Path]:
    with path.open("w", encoding="utf-8") as file:
        for n, t in enumerate(np.asarray(solution.t)):
            here, x, v = _living(solution.y, n)
            file.write(f"{len(x)}\nProperties=id:I:1:pos:R:3:velo:R:3 Time={t:.9g}\n")
            np.savetxt(file, np.column_stack([np.flatnonzero(here), x, v]), fmt=["%d", *["%.9g"] * 6])
    return [path]


def _lines(here: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """The pairs between the living, by their numbers among these."""
    return (np.cumsum(here) - 1)[pairs[here[pairs].all(axis=1)]]


def _write_vtk(solution: Any, path: pathlib.Path, pairs: np.ndarray) -> list[pathlib.Path]:
    """Legacy VTK, https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html."""
    written = []
    for n, t in enumerate(np.asarray(solution.t)):
        here, x, v = _living(solution.y, n)
        own = path.with_name(f"{path.stem}_{n:04d}{path.suffix}")
        with own.open("w", encoding="utf-8") as file:
            file.write(
                f"# vtk DataFile Version 3.0\nt = {t:.9g} s\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(x)} double\n"
            )
            np.savetxt(file, x, fmt="%.9g")
            lines = _lines(here, pairs)
            file.write(f"CELLS {len(x) + len(lines)} {2 * len(x) + 3 * len(lines)}\n")
            np.savetxt(file, np.column_stack([np.ones(len(x), int), np.arange(len(x))]), fmt="%d")
            np.savetxt(file, np.column_stack([np.full(len(lines), 2), lines]), fmt="%d")
            file.write(f"CELL_TYPES {len(x) + len(lines)}\n" + "1\n" * len(x) + "3\n" * len(lines))
            file.write(f"POINT_DATA {len(x)}\nVECTORS velocity double\n")
            np.savetxt(file, v, fmt="%.9g")
        written.append(own)
    return written


def _write_ply(solution: Any, path: pathlib.Path, pairs: np.ndarray) -> list[pathlib.Path]:
    """The Stanford format as text: G. Turk, The PLY Polygon File Format, 1994."""
    written = []
    color = solution.y.color
    for n, t in enumerate(np.asarray(solution.t)):
        here, x, v = _living(solution.y, n)
        table, names = [x, v], [f"double {name}" for name in ("x", "y", "z", "vx", "vy", "vz")]
        if color is not None:
            table.append(np.rint(255 * np.clip(np.asarray(color[n])[here], 0, 1)))
            names += [f"uchar {name}" for name in ("red", "green", "blue")]
        lines = _lines(here, pairs)
        head = ["ply", "format ascii 1.0", f"comment t = {t:.9g} s", f"element vertex {len(x)}"]
        head += [f"property {name}" for name in names]
        if len(pairs):
            head += [f"element edge {len(lines)}", "property int vertex1", "property int vertex2"]
        own = path.with_name(f"{path.stem}_{n:04d}{path.suffix}")
        with own.open("w", encoding="ascii") as file:
            file.write("\n".join([*head, "end_header"]) + "\n")
            np.savetxt(file, np.column_stack(table), fmt="%.9g")
            np.savetxt(file, lines, fmt="%d")
        written.append(own)
    return written


def _write_usd(solution: Any, path: pathlib.Path, pairs: np.ndarray) -> list[pathlib.Path]:
    """By the library that owns the format, https://openusd.org/release/api/class_usd_geom_points.html."""
    try:
        from pxr import Usd, UsdGeom, Vt
    except ImportError:
        raise RuntimeError("export to .usd needs usd-core, which is not installed; pip install 'jeuler[io]'") from None
    stage = Usd.Stage.CreateInMemory()
    stage.SetTimeCodesPerSecond(CODES_A_SECOND)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/run")
    stage.SetDefaultPrim(root.GetPrim())
    points, curves = UsdGeom.Points.Define(stage, "/run/particles"), None
    if len(pairs):
        curves = UsdGeom.BasisCurves.Define(stage, "/run/edges")
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    codes = CODES_A_SECOND * np.asarray(solution.t, float)
    stage.SetStartTimeCode(codes.min())
    stage.SetEndTimeCode(codes.max())
    for n, code in enumerate(codes):
        here, x, v = _living(solution.y, n)

        def of(name, n=n, here=here):
            value = getattr(solution.y, name)
            return None if value is None else np.asarray(value[n], np.float32)[here]

        size, color, opacity = map(of, ("size", "color", "opacity"))
        x = Vt.Vec3fArray.FromNumpy(np.asarray(x, np.float32))
        points.CreatePointsAttr().Set(x, code)
        points.CreateVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(np.asarray(v, np.float32)), code)
        points.CreateIdsAttr().Set(Vt.Int64Array.FromNumpy(np.flatnonzero(here).astype(np.int64)), code)
        if size is not None:
            points.CreateWidthsAttr().Set(Vt.FloatArray.FromNumpy(size), code)
        if color is not None:
            points.CreateDisplayColorPrimvar("vertex").Set(Vt.Vec3fArray.FromNumpy(color), code)
        if opacity is not None:
            points.CreateDisplayOpacityPrimvar("vertex").Set(Vt.FloatArray.FromNumpy(opacity), code)
        if curves is not None:
            ends = np.asarray(x)[_lines(here, pairs).ravel()]
            curves.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(ends), code)
            curves.CreateCurveVertexCountsAttr().Set(Vt.IntArray([2] * (len(ends) // 2)), code)
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError(f"{path} could not be written; its folder must be there and open to writing")
    return [path]
