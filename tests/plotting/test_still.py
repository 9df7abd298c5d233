"""Stills: light, shadow, hair and bodies as geometry, and one picture where PyVista is installed."""

import importlib.util

import jax.numpy as jnp
import numpy as np
import pytest

from jeuler import ParticleState, Scene
from jeuler.contact import Box, Collisions, Plane, Sphere
from jeuler.plotting import Camera, Hair, Look, still
from jeuler.plotting.hair import splines
from jeuler.plotting.light import light_through
from jeuler.plotting.models import Shadows, bake, copies, exposed, model, sky_directions
from jeuler.plotting.studio import bird, round_body, runner
from jeuler.plotting.surfaces import fine_mesh_of

UP = np.array([0.0, 0.0, 1.0])


def test_light_falls_off_behind_others_and_not_beside_them():
    points = np.array([[0.0, 0, 2], [0.0, 0, 0], [5.0, 0, 0]])
    light = light_through(points, np.full(3, 0.5), UP, 1.0)
    assert light[1] < 0.8 < light[0]
    assert light[2] > 0.8
    assert np.all((light > 0) & (light <= 1))


def test_a_spline_goes_through_its_nodes_and_a_straight_one_stays_straight():
    nodes = np.random.default_rng(0).normal(size=(3, 5, 3))
    assert np.allclose(splines(nodes, 4)[:, ::4], nodes)
    line = np.linspace(0, 1, 5)[None, :, None] * np.ones(3)
    assert np.allclose(splines(line, 4)[0], np.linspace(0, 1, 17)[:, None])


def test_strands_start_on_the_head_and_gather_at_their_tips():
    guides = np.stack([np.stack([UP, 1.5 * UP, 2 * UP + [k, 0, 0]]) for k in (0.0, 0.3)])
    hair = Hair.grown(np.arange(6).reshape(2, 3), guides, strands=30, spread=0.1)
    curves = hair.curves(guides.reshape(-1, 3))
    assert np.allclose(np.linalg.norm(curves[:, 0], axis=1), 1)
    assert np.allclose(curves[:, -1] - guides[hair.nearest, -1], hair.clump * hair.offset)


@pytest.mark.parametrize("shape", [round_body, runner, bird], ids=lambda f: f.__name__)
def test_bodies_are_one_wide_and_look_where_they_go(shape):
    one = shape()
    assert 0.8 < np.ptp(one.points, axis=0).max() <= 1.12
    turned = copies(one, np.array([[1.0, 2, 3]]), np.array([2.0]), np.ones((1, 4)), np.array([[0.0, 1, 0]]))
    back = (turned.points - [1, 2, 3]) / 2
    assert np.allclose(back[:, 1], one.points[:, 0])
    assert np.allclose(np.linalg.norm(turned.normals, axis=1), 1, atol=1e-6)


def test_what_is_under_a_roof_is_dark_and_light_is_never_above_one():
    floor = np.array([[0.0, 0, 0], [5.0, 0, 0], [0.0, 5, 0]])
    ground = model(floor, np.array([[0, 1, 2]]), np.ones(4), casts=False)

    def roof(way):  # a map in which only the place about the origin is covered
        height = np.full((3, 3), -np.inf)
        height[1, 1] = 100.0
        return Shadows(np.eye(3), np.array([-1.5, -1.5]), 1.0, height)

    (rgba,) = bake([ground], roof, UP, np.array([0.0, 0.0, 50.0]), 0.1)
    assert rgba[0, 0] < 0.2 < 0.5 < rgba[1, 0]
    assert exposed(np.array([0.3, 50.0])).tolist() == [0.3, 1.0]
    assert sky_directions()[:, 2].min() > 0


def test_the_ground_is_found_from_above():
    ground, _, is_ground = fine_mesh_of(lambda t, p: p[2] - 0.1 * jnp.sin(p[0]), 0.0, np.zeros(3), np.ones(3))
    assert is_ground
    assert np.abs(ground[:, 2] - 0.1 * np.sin(ground[:, 0])).max() < 0.01
    plane, _, _ = fine_mesh_of(Plane([0.0, 0.0, 1.0], [1.0, 0.0, 1.0]), 0.0, np.zeros(3), np.ones(3))
    assert np.allclose(plane.sum(axis=1) - plane[:, 1], 1)
    assert len(fine_mesh_of(Plane([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 0.0, np.zeros(3), np.ones(3))[1]) == 0


def test_bad_input_says_what_to_do():
    with pytest.raises(ValueError, match=r"\(particle, 3\), got \(2, 2\)"):
        still(ParticleState(np.zeros((2, 2)), np.zeros((2, 2))))
    with pytest.raises(ValueError, match="Look.particles"):
        Look(particles="clouds")


@pytest.mark.skipif(importlib.util.find_spec("pyvista") is None, reason="needs the library pyvista")
def test_a_still_shows_balls_solids_and_the_shadow_on_the_ground(tmp_path):
    state = ParticleState([[0.0, 0.0, 0.5]], np.zeros((1, 3)), size=np.ones(1), color=[[1.0, 0.0, 0.0]])
    solids = (Plane([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), Sphere([1.0, 1.0, 0.2], 0.2), Box([-1.0, 1.0, 0.1], [0.1] * 3))
    camera = Camera(center=[0.0, 0.0, 0.3], width=4.0, elevation=30.0)
    picture = still(state, Scene(effects=(Collisions(solids),)), tmp_path / "ball.png", size=(160, 100), camera=camera)
    assert picture.shape == (100, 160, 3)
    assert (tmp_path / "ball.png").exists()
    rgb = picture.astype(int)
    red = (rgb[..., 0] > 80) & (rgb[..., 1] < 60)
    assert 100 < red.sum() < 4000
    ground = rgb[~red].sum(axis=1)
    assert np.percentile(ground, 2) < 0.75 * np.percentile(ground, 90), "the shadow"
