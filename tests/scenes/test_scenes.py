"""The example scenes run, stay finite, and do what a person would expect of them."""

import ast
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler import scenes

# fewer steps than the film has: long enough to see the point
SHORT = {"fountain": 48, "smoke_column": 60, "cloth_on_sphere": 448, "charge": 80, "rain_on_pegs": 160}


def run(name, **changes):
    setup = getattr(scenes, name)(**changes)
    steps = SHORT.get(name, setup.num_steps)
    solution = setup.run(num_steps=steps, save_every=steps // 4)
    assert int(solution.first_nonfinite) == -1
    return setup, solution.y


def test_the_water_rises_falls_and_stays_above_the_ground():
    _, y = run("fountain")
    height = np.where(y.alive, y.position[..., 2], np.nan)[1:]
    assert 1.2 < np.nanmax(height) < 7.2**2 / (2 * 9.81) + 0.2, "no higher than without drag"
    assert np.nanmin(height) > -0.02
    assert int(y.missed_births[-1]) == 0


def test_smoke_rises_turns_and_fades():
    _, y = run("smoke_column")
    alive = np.asarray(y.alive[-1])
    x, v, age = (np.asarray(z[-1])[alive] for z in (y.position, y.velocity, y.age))
    assert np.corrcoef(age, x[:, 2])[0, 1] > 0.8
    assert np.corrcoef(age, np.asarray(y.opacity[-1])[alive])[0, 1] < -0.8
    assert np.mean(x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]) > 0, "counterclockwise"


def test_curls_keep_their_length_and_their_curl():
    setup, y = run("curly_hair", strands=4)
    _, springs, _, _, head, _ = setup.scene.forces
    end = np.asarray(y.position[-1])
    edges = np.asarray(springs.edges)
    length = np.linalg.norm(end[edges[:, 0]] - end[edges[:, 1]], axis=1)
    assert np.abs(length / springs.rest_length - 1).max() < 0.3
    strand = end.reshape(4, -1, 3)
    reach = np.linalg.norm(strand[:, -1] - strand[:, 0], axis=1)
    assert np.all(reach < 0.85 * length.reshape(4, -1).sum(axis=1)), "a straight hair would reach as far as it is long"
    depth = jax.vmap(head.collider, (None, 0))(setup.dt * setup.num_steps, y.position[-1])
    assert float(depth.min()) > -0.003, "no hair is in the head"


def test_the_cloth_lies_on_the_ball_and_not_in_it():
    _, y = run("cloth_on_sphere", side=16)
    r = np.linalg.norm(y.position[-1], axis=-1)
    assert r.min() > 0.59
    assert np.sum(r < 0.66) > 10
    assert np.min(y.position[-1, :, 2]) < 0.2, "its corners hang"


def test_the_jelly_comes_down_the_stairs_as_a_cube():
    _, y = run("jelly_on_stairs", side=4)
    start, end = np.asarray(y.position[0]), np.asarray(y.position[-1])
    assert end.mean(axis=0)[2] < start.mean(axis=0)[2] - 1
    spread = [np.linalg.norm(p - p.mean(axis=0), axis=1) for p in (start, end)]
    assert np.abs(spread[1] / spread[0] - 1).max() < 0.25


def test_the_crowd_advances_within_its_speed_limit_and_goes_around_the_rocks():
    setup, y = run("charge", agents=600)
    speed = np.linalg.norm(y.velocity[-1], axis=-1)
    assert np.all(speed <= setup.scene.effects[0].limit * (1 + 1e-5))
    assert np.mean(y.position[-1, :, 0]) > np.mean(y.position[0, :, 0]) + 10
    rocks = np.array(scenes.charge.__globals__["ROCKS"])
    apart = np.linalg.norm(y.position[-1, :, None, :2] - rocks, axis=-1)
    assert np.mean(apart.min(axis=1) < 1.5) < 0.01


def test_the_rain_spreads_like_galton_and_never_enters_a_peg():
    setup, y = run("rain_on_pegs", rows=5)
    alive = np.asarray(y.alive[-1])
    x = jnp.asarray(y.position[-1])[alive]
    distance = jax.vmap(setup.scene.effects[2].colliders[0], (None, 0))(0.0, x)
    assert float(distance.min()) > 0.012 - 2e-3
    upper, lower = x[x[:, 1] > 1.0], x[x[:, 1] < 0.6]
    assert len(lower) > 20
    assert np.std(lower[:, 0]) > 1.5 * np.std(upper[:, 0])
    assert abs(np.mean(lower[:, 0])) < 3 * np.std(lower[:, 0]) / np.sqrt(len(lower)) + 0.05


@pytest.mark.parametrize("scene", scenes.ALL, ids=lambda scene: scene.__name__)
def test_a_scene_is_ten_to_twenty_lines(scene):
    """Lines of code as a person counts them: one a statement, in scene and in the forces that it writes itself."""
    (function,) = ast.parse(inspect.getsource(scene)).body
    statements = [node for node in ast.walk(function) if isinstance(node, ast.stmt)]
    assert len(statements) - 2 <= 20, "without its head and its docstring"
