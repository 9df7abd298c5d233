"""Bodies of meshes as they lie, from arrays and files, and meshes to collide with."""

import itertools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler

CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))  # of a cube
TETRAHEDRA = np.array([[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]])
CUBE = jeuler.from_mesh((CORNERS, TETRAHEDRA), density=3.0, ks=10.0).triangles


def outward(triangles):
    """All turned so that their normals leave the cube."""
    a, b, c = np.moveaxis(CORNERS[triangles], 1, 0)
    turned = np.sum(np.cross(b - a, c - a) * ((a + b + c) / 3 - 0.5), axis=1) < 0
    return np.where(turned[:, None], triangles[:, ::-1], triangles)


SOLIDS = (jeuler.mesh_collider((CORNERS, outward(CUBE)), spacing=0.1), jeuler.Box([0.5, 0.5, 0.5], 0.5))


def hills():
    """A hilly sheet of 4 x 5 points, one point of no cell among them."""
    cloth = jeuler.grid_cloth((4, 5), (3.0, 4.0), density=1.0, ks=1.0)
    points = np.asarray(cloth.state.position) + [0, 0, 1] * np.random.default_rng(0).uniform(-0.4, 0.4, (20, 1))
    return np.insert(points, 7, 9.0, axis=0), cloth.triangles + (cloth.triangles >= 7)


def test_a_body_of_tetrahedra_has_its_mass_and_a_closed_skin():
    body = jeuler.from_mesh((CORNERS, TETRAHEDRA), density=3.0, ks=10.0, kd=0.1, bending=1.0)
    np.testing.assert_allclose(body.state.mass, 3 * np.bincount(TETRAHEDRA.ravel(), [1 / 24] * 16 + [1 / 12] * 4))
    assert len(body.springs.edges) == 18
    assert body.bending is None
    assert body.triangles.shape == (12, 3)
    assert (np.bincount(body.triangles.ravel()) >= 3).all()


def test_a_sheet_is_at_rest_as_it_lies_and_is_not_when_it_is_bent():
    points, triangles = hills()
    body = jeuler.from_mesh((points, triangles), density=0.5, ks=10.0, bending=0.1)
    scene = jeuler.Scene(body.forces)
    assert body.state.position.shape == (20, 3)
    assert len(body.bending.quads) == 3 * len(triangles) - len(body.springs.edges), "each edge but the border's"
    np.testing.assert_allclose(scene.force(0.0, body.state), 0, atol=1e-12)
    bent = body.bending(0.0, body.state.position.at[8, 2].add(0.3), 0 * body.state.position, body.state.mass)
    assert jnp.abs(bent).max() > 1e-2
    np.testing.assert_allclose(jnp.sum(bent, axis=0), 0, atol=1e-12)
    area = np.linalg.norm(np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))), axis=1) / 2
    np.testing.assert_allclose(body.state.mass.sum(), 0.5 * area.sum(), rtol=1e-12)


@pytest.mark.parametrize("end", ["stl", "obj", "vtk", "msh"])
def test_files_give_the_body_of_their_arrays(tmp_path, end):
    import meshio
    import trimesh

    path = tmp_path / f"mesh.{end}"
    if end in ("stl", "obj"):
        trimesh.Trimesh(CORNERS, CUBE, process=False).export(path)
        expected = jeuler.from_mesh((CORNERS, CUBE), density=1.0, ks=1.0)
    else:
        kinds = [("triangle", CUBE), ("tetra", TETRAHEDRA)][end == "msh" :]  # tetrahedra go before their skin
        meshio.Mesh(CORNERS, kinds).write(path, **({"file_format": "gmsh"} if end == "msh" else {}))
        expected = jeuler.from_mesh((CORNERS, TETRAHEDRA), density=1.0, ks=1.0)
    body = jeuler.from_mesh(path, density=1.0, ks=1.0)
    assert body.state.position.shape == (8, 3), "one particle a corner"
    np.testing.assert_allclose(np.sort(body.state.mass), np.sort(expected.state.mass), rtol=1e-6)
    lengths = np.sort(body.springs.rest_length), np.sort(expected.springs.rest_length)
    np.testing.assert_allclose(*lengths, rtol=1e-6)


def test_a_cloth_and_a_rope_have_their_masses_and_bend():
    cloth = jeuler.grid_cloth((4, 3), (3.0, 1.0), density=2.0, ks=5.0, bending=0.1)
    assert sorted(set(np.asarray(cloth.state.mass).round(12).tolist())) == [0.25, 0.5, 1.0]
    line = jeuler.rope([0.0, 0.0, 1.0], [0.0, 2.0, 1.0], 6, density=0.5, ks=5.0, bending=0.1)
    np.testing.assert_allclose([cloth.state.mass.sum(), line.state.mass.sum()], [6.0, 1.0])
    assert len(line.bending.triples) == 4
    for body in (cloth, line):
        np.testing.assert_allclose(jeuler.Scene(body.forces).force(0.0, body.state), 0, atol=1e-12)


def test_a_mesh_to_collide_with_has_the_distance_of_its_solid():
    """A cube against the formula, within, beside and beyond its grid; and how the distance grows."""
    solid, truth = SOLIDS
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.15, 1.15, (200, 3)))
    found, slope = jax.jit(jax.vmap(jax.value_and_grad(solid, argnums=1), (None, 0)))(0.0, points)
    right, along = jax.jit(jax.vmap(jax.value_and_grad(truth, argnums=1), (None, 0)))(0.0, points)
    np.testing.assert_allclose(found, right, atol=0.05)
    beside = np.asarray((right > 0) & (jnp.abs(along).max(axis=1) > 1 - 1e-9) & (right < 0.1))
    assert beside.sum() > 20
    np.testing.assert_allclose(slope[beside & (np.abs(points - 0.5).min(axis=1) < 0.4)].max(), 1, atol=1e-6)
    for far in ([3.0, 0.5, 0.5], [3.0, -2.0, 0.5]):
        d = float(solid(0.0, jnp.array(far)))
        assert 0 < d <= float(truth(0.0, jnp.array(far))) + 1e-12
    away = jax.grad(lambda h: solid(0.0, jnp.array([0.5, 0.5, 1.05 + h])))(0.0)
    np.testing.assert_allclose(away, 1, rtol=1e-9)


def test_a_ball_bounces_off_a_mesh_and_slides_on_it_as_on_the_formula_of_its_solid():
    def run(solid):
        bounce = jeuler.Collisions((solid,), radius=0.1, restitution=0.5, friction=0.1)
        scene = jeuler.Scene((jeuler.Gravity([0.0, 0.0, -9.81]),), (bounce,))
        ball = jeuler.ParticleState([[0.4, 0.5, 1.4]], [[0.3, 0.0, 0.0]])
        return jeuler.simulate(scene, ball, dt=0.05, num_steps=16).y.position[:, 0]

    on_mesh, on_box = map(run, SOLIDS)
    np.testing.assert_allclose(on_mesh, on_box, atol=1e-9)
    assert 1.1 - 1e-9 < on_mesh[:, 2].min() < 1.101
    assert on_mesh[-1, 0] > 0.45


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: jeuler.from_mesh("no.stl", density=1.0, ks=1.0), "no file"),
        (lambda: jeuler.from_mesh(3, density=1.0, ks=1.0), "a path or a pair"),
        (lambda: jeuler.from_mesh((CORNERS, [[0, 1]]), density=1.0, ks=1.0), "triangles"),
        (lambda: jeuler.from_mesh((CORNERS, [[0, 1, 8]]), density=1.0, ks=1.0), "indices of the 8"),
        (lambda: jeuler.from_mesh((CORNERS, [[0, 1, 1]]), density=1.0, ks=1.0), "different corners"),
        (lambda: jeuler.from_mesh((CORNERS[:, :2], [[0, 1, 2]]), density=1.0, ks=1.0), r"\(point, 3\)"),
        (
            lambda: jeuler.from_mesh(([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]]), density=1.0, ks=1.0),
            "no|none for",
        ),
        (lambda: jeuler.from_mesh((CORNERS, CUBE), density=0.0, ks=1.0), "density"),
        (lambda: jeuler.grid_cloth((1, 3), (1.0, 1.0), density=1.0, ks=1.0), "shape"),
        (lambda: jeuler.rope([0.0], [0.0], 3, density=1.0, ks=1.0), "two different points"),
        (lambda: jeuler.mesh_collider((CORNERS, outward(CUBE)[1:]), spacing=0.2), "closed"),
        (lambda: jeuler.mesh_collider((CORNERS, np.vstack([CUBE[:1, ::-1], CUBE[1:]])), spacing=0.2), "closed"),
        (lambda: jeuler.mesh_collider((CORNERS, TETRAHEDRA), spacing=0.2), "tetrahedra"),
        (lambda: jeuler.GridDistance([0.0], 1.0, [1.0, -1.0, -0.5]), "larger grid"),
        (lambda: jeuler.GridDistance([0.0, 0.0], 1.0, [1.0, -1.0, 0.5]), "an axis"),
    ],
)
def test_what_cannot_be_a_body_is_said(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def test_without_the_library_that_reads_a_file_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    (tmp_path / "a.stl").write_text("")
    with pytest.raises(RuntimeError, match=r"trimesh.*jeuler\[io\]"):
        jeuler.from_mesh(tmp_path / "a.stl", density=1.0, ks=1.0)
