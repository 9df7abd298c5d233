"""Files of runs: what is read back is what was written."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jeuler
from jeuler import ParticleState, Scene, Solution


def run():
    alive = jnp.array([[True, True, True], [True, False, True]])
    position = jnp.arange(12.0).reshape(2, 3, 2)
    state = ParticleState(position, -position, mass=jnp.ones((2, 3)), alive=alive, extra={"heat": position[..., 0]})
    return Solution(jnp.array([0.0, 0.5]), state, jnp.int32(-1))


def test_npz_holds_every_field(tmp_path):
    (path,) = jeuler.export(run(), tmp_path / "run.npz")
    found = np.load(path)
    assert set(found) == {"t", "position", "velocity", "mass", "alive", "heat"}
    np.testing.assert_array_equal(found["position"], run().y.position)


def test_xyz_has_the_living_at_each_time(tmp_path):
    (path,) = jeuler.export(run(), tmp_path / "run.xyz")
    lines = path.read_text().splitlines()
    assert (lines[0], lines[5]) == ("3", "2")
    assert lines[6].endswith("Time=0.5")
    assert lines[7:] == ["0 6 7 0 -6 -7 0", "2 10 11 0 -10 -11 0"]


def test_vtk_has_points_and_the_lines_between_the_living(tmp_path):
    first, second = jeuler.export(run(), tmp_path / "run.vtk", edges=[[0, 1], [0, 2]])
    assert (first.name, second.name) == ("run_0000.vtk", "run_0001.vtk")
    assert "CELLS 5 12\n1 0\n1 1\n1 2\n2 0 1\n2 0 2\nCELL_TYPES 5\n1\n1\n1\n3\n3\n" in first.read_text()
    text = second.read_text()
    assert "POINTS 2 double\n6 7 0\n10 11 0\nCELLS 3 7\n1 0\n1 1\n2 0 1\nCELL_TYPES 3\n1\n1\n3\nPOINT_DATA 2\n" in text


def test_ply_has_points_colours_and_the_lines_between_the_living(tmp_path):
    red = jnp.tile(jnp.array([1.0, 0.2, 0.0]), (2, 3, 1))
    coloured = Solution(run().t, run().y.replace(color=red), jnp.int32(-1))
    first, second = jeuler.export(coloured, tmp_path / "run.ply", edges=[[0, 1], [0, 2]])
    assert (first.name, second.name) == ("run_0000.ply", "run_0001.ply")
    head, body = second.read_text().split("end_header\n")
    assert head.startswith("ply\nformat ascii 1.0\ncomment t = 0.5 s\nelement vertex 2\nproperty double x\n")
    assert head.endswith("property uchar blue\nelement edge 1\nproperty int vertex1\nproperty int vertex2\n")
    assert body == "6 7 0 -6 -7 0 255 51 0\n10 11 0 -10 -11 0 255 51 0\n0 1\n"
    assert "element edge" not in jeuler.export(run(), tmp_path / "bare.ply")[0].read_text()


def test_nc_is_the_dataset_as_xarray_reads_it(tmp_path):
    (path,) = jeuler.export(run(), tmp_path / "run.nc")
    made = run().to_xarray()
    with xarray.open_dataset(path, engine="scipy") as found:
        assert found.identical(made)
        assert found.alive.dtype == bool
        assert found.position.dims == ("time", "particle", "dim")
        assert found.heat.dims == ("time", "particle")
        np.testing.assert_array_equal(found.position.sel(time=0.5), run().y.position[1])
    assert made.attrs == {"first_nonfinite": -1, "unresolved_contacts": 0}


@pytest.mark.parametrize("end", ["usd", "usda"])
def test_usd_opens_with_its_own_library(tmp_path, end):
    pytest.importorskip("pxr", reason="needs the library usd-core")
    from pxr import Usd, UsdGeom

    red = jnp.tile(jnp.array([1.0, 0.2, 0.0]), (2, 3, 1))
    state = run().y.replace(color=red, size=jnp.full((2, 3), 0.1))
    (path,) = jeuler.export(Solution(run().t, state, jnp.int32(-1)), tmp_path / f"run.{end}", edges=[[0, 1], [0, 2]])
    stage = Usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 12.0, 24.0)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    points = UsdGeom.Points(stage.GetPrimAtPath("/run/particles"))
    at = 12.0
    np.testing.assert_array_equal(points.GetPointsAttr().Get(at), [[6, 7, 0], [10, 11, 0]])
    np.testing.assert_array_equal(points.GetVelocitiesAttr().Get(at), [[-6, -7, 0], [-10, -11, 0]])
    assert list(points.GetIdsAttr().Get(at)) == [0, 2]
    np.testing.assert_allclose(points.GetWidthsAttr().Get(at), [0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose(points.GetDisplayColorPrimvar().Get(at), red[0, :2], rtol=1e-6)
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/run/edges"))
    assert [list(curves.GetCurveVertexCountsAttr().Get(t)) for t in (0.0, at)] == [[2, 2], [2]]
    np.testing.assert_array_equal(curves.GetPointsAttr().Get(at), [[6, 7, 0], [10, 11, 0]])


def test_vtk_and_ply_open_with_libraries_of_their_own(tmp_path):
    import meshio
    import plyfile

    edges = [[0, 1], [0, 2]]
    mesh = meshio.read(jeuler.export(run(), tmp_path / "run.vtk", edges=edges)[1])
    np.testing.assert_array_equal(mesh.points, [[6, 7, 0], [10, 11, 0]])
    np.testing.assert_array_equal(mesh.point_data["velocity"], [[-6, -7, 0], [-10, -11, 0]])
    assert mesh.cells_dict["line"].tolist() == [[0, 1]]
    ply = plyfile.PlyData.read(str(jeuler.export(run(), tmp_path / "run.ply", edges=edges)[1]))
    assert ply["vertex"]["vx"].tolist() == [-6.0, -10.0]
    assert [list(edge) for edge in ply["edge"].data] == [[0, 1]]


def test_a_run_of_another_pytree_is_a_dataset_by_its_paths():
    def fall(t, y, args):
        return {"height": y["speed"], "speed": -9.81 + 0 * y["speed"]}

    y0 = {"height": jnp.zeros((2, 3)), "speed": jnp.ones((2, 3))}
    made = jeuler.solve(fall, y0, dt=0.1, num_steps=2).to_xarray()
    assert made.height.dims == ("time", "height_1", "height_2")
    assert jeuler.solve(lambda t, y, a: y, 1.0, dt=0.1, num_steps=2).to_xarray().y.dims == ("time",)
    batch = jax.vmap(lambda y: jeuler.solve(lambda t, y, a: y, y, dt=0.1, num_steps=2))(jnp.ones(2))
    with pytest.raises(ValueError, match="one member of a batch"):
        batch.to_xarray()


def test_what_cannot_be_written_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(RuntimeError, match=r"jeuler\[io\]"):
        jeuler.export(run(), tmp_path / "run.usd")
    with pytest.raises(ValueError, match=r"\.npz, \.xyz, \.vtk, \.ply, \.nc, \.usd, \.usda, \.usdc, got 'run\.obj'"):
        jeuler.export(run(), tmp_path / "run.obj")
    with pytest.raises(ValueError, match="edges"):
        jeuler.export(run(), tmp_path / "run.vtk", edges=[[0, 3]])
    single = jeuler.simulate(Scene(), ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1))), dt=0.1, num_steps=1)
    with pytest.raises(ValueError, match="ParticleState"):
        jeuler.export(Solution(single.t, single.y.position, single.first_nonfinite), tmp_path / "run.npz")
