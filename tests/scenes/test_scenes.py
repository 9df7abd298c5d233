"""The example scenes run, stay finite, and do what a person would expect of them."""

import ast
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import scenes
from jeuler._jax.haste import jit_in_haste
from jeuler.plotting.render import colliders_of

# fewer steps than the film has: long enough to see the point
SHORT = {
    "fountain": 64,
    "smoke_column": 60,
    "fireworks": 72,
    "cloth_on_sphere": 448,
    "charge": 80,
    "rain_on_pegs": 480,
    "flock": 24,
    "dam_break": 120,
}


def run(name, **changes):
    """The scene and its states; compiled in haste, as its program takes longer to compile than to run."""
    setup = getattr(scenes, name)(**changes)
    steps = SHORT.get(name, setup.num_steps)
    if name == "smoke_column":
        solution = setup.run(num_steps=steps, save_every=steps // 4)
    else:
        how = {"dt": setup.dt, "num_steps": steps, "save_every": steps // 4, "step": setup.step}
        simulate = jit_in_haste(lambda *of: jeuler.simulate(*of, key=jax.random.key(0), **how), "great")
        solution = simulate(setup.scene, setup.state)
    assert int(solution.first_nonfinite) == -1
    return setup, solution.y


def test_the_water_rises_falls_and_stays_above_the_ground():
    _, y = run("fountain")
    height = np.where(y.alive, y.position[..., 2], np.nan)[1:]
    assert 1.2 < np.nanmax(height) < 7.8**2 / (2 * 9.81) + 0.2, "no higher than without drag"
    old = y.alive[-1] & (y.age[-1] > 0.8)
    assert np.mean(y.position[-1, :, 0][old]) > 0.04, "the wind carries it off"
    assert np.nanmin(height) > -0.02
    assert int(y.missed_births[-1]) == 0


def test_smoke_rises_turns_and_fades():
    _, y = run("smoke_column")
    alive = np.asarray(y.alive[-1])
    x, v, age = (np.asarray(z[-1])[alive] for z in (y.position, y.velocity, y.age))
    assert np.corrcoef(age, x[:, 2])[0, 1] > 0.8
    assert np.corrcoef(age, np.asarray(y.opacity[-1])[alive])[0, 1] < -0.8
    assert np.mean(x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]) > 0, "counterclockwise"


def test_rockets_burst_into_stars_of_their_colour_where_they_burn_out():
    _, y = run("fireworks")
    star = np.asarray(y.alive[-1] & (y.generation[-1] == 1))
    born, missed = int(y.births[-1]), int(y.missed_births[-1])
    assert (born > 300, missed) == (True, 0)
    palette = {tuple(color) for color in np.asarray(y.color[-1])[star].round(4)}
    assert 1 < len(palette) <= 5, "each burst has the colour of its rocket"
    assert np.asarray(y.position[-1])[star][:, 2].mean() > 10.0, "high in the air"
    way = np.linalg.norm(np.asarray(y.trail[-1]), axis=-1)
    assert np.all(np.diff(way[star], axis=1) > -1.0)
    assert way[star].max() > 1.0, "a trail behind each"


def test_curls_keep_their_length_and_their_curl():
    setup, y = run("curly_hair", guides=4, strands=40)
    _, springs, _, _, head, _ = setup.scene.forces
    end = np.asarray(y.position[-1])
    edges = np.asarray(springs.edges)
    length = np.linalg.norm(end[edges[:, 0]] - end[edges[:, 1]], axis=1)
    assert np.abs(length / springs.rest_length - 1).max() < 0.3
    strand = end.reshape(4, -1, 3)
    reach = np.linalg.norm(strand[:, -1] - strand[:, 0], axis=1)
    assert np.all(reach < 0.85 * length.reshape(4, -1).sum(axis=1)), "a straight hair would reach as far as it is long"
    drawn = setup.look["hair"].curves(end)
    assert drawn.shape == (40, 157, 3)
    assert np.allclose(drawn[:, 0], (strand[:, 0][setup.look["hair"].nearest] + setup.look["hair"].offset), atol=1e-6)
    depth = jax.vmap(head.collider, (None, 0))(setup.dt * setup.num_steps, y.position[-1])
    assert float(depth.min()) > -0.003, "no hair is in the head"


def test_the_cloth_lies_on_the_ball_and_not_in_it():
    _, y = run("cloth_on_sphere", side=16)
    r = np.linalg.norm(y.position[-1], axis=-1)
    assert r.min() > 0.59
    assert np.sum(r < 0.66) > 10
    assert np.min(y.position[-1, :, 2]) < 0.2, "its corners hang"


def test_the_jelly_tumbles_down_the_stairs_as_a_cube_and_strains_less_than_sixty_percent():
    setup, y = run("jelly_on_stairs", side=4)
    start, end = np.asarray(y.position[0]), np.asarray(y.position[-1])
    assert end.mean(axis=0)[2] < start.mean(axis=0)[2] - 1
    spread = [np.linalg.norm(p - p.mean(axis=0), axis=1) for p in (start, end)]
    assert np.abs(spread[1] / spread[0] - 1).max() < 0.25
    springs = setup.scene.forces[2]
    strain = jax.vmap(springs.strain)(jnp.zeros(len(y.position)), y)
    assert float(jnp.abs(strain).max()) < 0.6
    turn = np.linalg.svd((end - end.mean(axis=0)).T @ (start - start.mean(axis=0)))
    angle = np.arccos(np.clip((np.trace(turn[0] @ turn[2]) - 1) / 2, -1, 1))
    assert angle > 0.5, "rad"


def test_the_crowd_advances_within_its_speed_limit_and_enters_no_rock_and_no_one_else():
    setup, y = run("charge", agents=600)
    speed = np.linalg.norm(y.velocity[-1], axis=-1)
    assert np.all(speed <= setup.scene.effects[0].limit * (1 + 1e-5))
    assert np.mean(y.position[-1, :, 0]) > np.mean(y.position[0, :, 0]) + 10
    assert int(y.missed_neighbours[-1]) == 0
    rocks = np.array(scenes.charge.__globals__["ROCKS"])
    place = np.asarray(y.position[..., :2])
    apart = np.linalg.norm(place[:, :, None] - rocks[:, :2], axis=-1) - rocks[:, 2]
    assert apart.min() > 0.45
    for x in place[1:]:
        d = np.linalg.norm(x[:, None] - x, axis=-1) + 9 * np.eye(len(x))
        assert d.min() > 0.45, "a trunk is 0.43 m wide"


def test_the_rain_heaps_up_to_a_bell_in_bins_and_never_enters_a_peg():
    setup, y = run("rain_on_pegs", rows=5, drops=300)
    alive, rests = np.asarray(y.alive[-1]), np.asarray(y.shape[-1] == 5)
    x = np.asarray(y.position[-1])
    board = setup.scene.effects[1].colliders[0]
    distance = jax.vmap(board, (None, 0))(0.0, jnp.asarray(x[alive]))
    assert float(distance.min()) > 0.012 - 2e-3
    assert rests.sum() > 30
    at_rest = x[rests]
    places = np.round(at_rest / 0.0125).astype(int)
    assert len(np.unique(places, axis=0)) == len(at_rest), "one drop a place"
    counts = np.bincount(np.floor(at_rest[:, 0] / 0.2).astype(int) + 20, minlength=40)
    assert counts[18:22].sum() > 0.5 * rests.sum(), "the middle holds most"
    assert abs(np.mean(at_rest[:, 0])) < 3 * np.std(at_rest[:, 0]) / np.sqrt(len(at_rest)) + 0.05


def test_the_flock_keeps_its_distance_goes_one_way_and_stays_together():
    _, y = run("flock", birds=300)
    assert int(y.missed_neighbours[-1]) == 0
    speed = np.linalg.norm(y.velocity[-1], axis=1)
    assert speed.max() <= 18.0 + 1e-4
    rows = np.asarray(y.neighbours[-1])
    x, way = np.asarray(y.position[-1]), np.asarray(y.velocity[-1]) / speed[:, None]
    near = (rows >= 0) & (np.linalg.norm(x[:, None] - x[rows], axis=2) < 3.0)
    alike = np.einsum("id,ijd->ij", way, way[rows])[near].mean()
    assert alike > np.mean(way @ way.T) + 0.1, "those that see each other go one way"
    assert np.linalg.norm(x - x.mean(axis=0), axis=1).max() < 60


def test_the_dam_breaks_runs_along_the_trough_and_stays_in_it_with_all_its_water():
    setup, y = run("dam_break", across=3)
    assert [type(solid).__name__ for solid in colliders_of(setup.scene)] == ["Plane"], "no wall hides the water"
    x, size = np.asarray(y.position), 0.05
    assert int(y.missed_neighbours[-1]) == 0
    assert x[..., 2].min() > 0.4 * size
    assert x[..., 1].min() > 0.4 * size
    assert x[-1, :, 0].max() > x[0, :, 0].max() + 0.08, "it runs"
    assert x[-1, :, 2].mean() < 0.8 * x[0, :, 2].mean(), "it falls"
    density = setup.scene.forces[1].densities(jnp.asarray(x[-1]), y.neighbours[-1])
    assert float(jnp.max(density)) < 1300, "kg/m^3"


@pytest.mark.parametrize("scene", scenes.ALL, ids=lambda scene: scene.__name__)
def test_a_scene_is_ten_to_twenty_lines(scene):
    """Lines of code as a person counts them: one a statement, in scene and in the forces that it writes itself."""
    (function,) = ast.parse(inspect.getsource(scene)).body
    statements = [node for node in ast.walk(function) if isinstance(node, ast.stmt)]
    assert len(statements) - 2 <= 20, "without its head and its docstring"
