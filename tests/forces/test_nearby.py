"""Rows of neighbours and the forces by them: against all pairs, in free and periodic space, with births and overflow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Flocking, Fluid, Neighbours, ParticleState, Scene, SoftRepulsion
from jeuler._core.triangles import nearest_weights
from jeuler._core.vectors import length


def rows_of(near, x, **fields):
    end = jeuler.simulate(Scene(effects=(near,)), ParticleState(x, 0 * x, **fields), dt=0.1, num_steps=0).y
    return np.asarray(end.neighbours[0]), int(end.missed_neighbours[0])


@pytest.mark.parametrize(("dim", "box"), [(3, None), (2, (3.0, 4.0))])
def test_rows_hold_those_within_reach_each_once(dim, box, random):
    x = random.uniform(-2.0, 2.0, (200, dim))
    x[0] = x[1]  # in the same place
    d = x[:, None] - x
    d = d if box is None else d - np.array(box) * np.round(d / np.array(box))
    near = (np.linalg.norm(d, axis=2) < 0.7) & ~np.eye(200, dtype=bool)
    rows, missed = rows_of(Neighbours(0.5, 0.2, capacity=60, box=box), x)
    assert missed == 0
    for row, truth in zip(rows, near, strict=True):
        assert sorted(row[row >= 0]) == np.flatnonzero(truth).tolist()
    if dim == 2:
        alive = np.arange(200) % 2 == 0
        rows, missed = rows_of(Neighbours(0.5, 0.2, capacity=2, box=box), x, alive=jnp.asarray(alive))
        due = (near & alive & alive[:, None]).sum(axis=1)
        assert np.array_equal((rows[alive] >= 0).sum(axis=1), np.minimum(due, 2)[alive])
        assert missed >= np.maximum(due - 2, 0).sum() > 0, "what found no place is counted"


def of_all_pairs(t, p, v, m):
    d = p[:, None] - p
    square = jnp.sum(d * d, axis=2)
    here = (square > 0) & (square < 0.3**2)
    r = jnp.sqrt(jnp.where(here, square, 1))
    approach = jnp.sum((v[:, None] - v) * d, axis=2) / r
    return jnp.sum(jnp.where(here, (0.3 - r) * (50.0 - 2.0 / 0.3 * approach) / r, 0)[:, :, None] * d, axis=1)


def test_a_run_and_its_gradient_are_those_of_all_pairs(random):
    """Over many steps, in which rows are made again; one by one and in a batch."""
    x, v = random.uniform(-1, 1, (50, 2)), random.normal(size=(50, 2))
    near = Neighbours(0.3, 0.1, capacity=20)

    def end(scene, scale):
        run = jeuler.simulate(
            scene, ParticleState(scale * x, v), dt=4e-3, num_steps=50, step=jeuler.symplectic_euler_step
        )
        return jnp.sum(run.y.position[-1] ** 2), run.y

    def both(scene):
        found = jax.jit(jax.value_and_grad(lambda scale: end(scene, scale), has_aux=True))
        return found(1.0), jax.jit(jax.vmap(lambda scale: end(scene, scale)[0]))(np.array([0.9, 1.0]))

    ours = Scene((SoftRepulsion(near, 0.3, 50.0, 2.0),), (near,))
    ((_, run), slope), batch = both(ours)
    ((value, truth), right), truths = both(Scene((of_all_pairs,)))
    assert run.missed_neighbours[-1] == 0
    assert (np.diff(run.neighbours_made_at[:, 0, 0]) != 0).sum() > 5, "made again on the way, and not at each step"
    assert (np.diff(run.neighbours_made_at[:, 0, 0]) == 0).sum() > 5
    np.testing.assert_allclose(run.position, truth.position, atol=1e-12)
    np.testing.assert_allclose(slope, right, rtol=1e-10)
    np.testing.assert_allclose(batch, truths, rtol=1e-12)
    assert value == truths[1]


def test_stages_of_a_long_step_miss_nobody(random):
    """Particles move by several skins within a step, in which a method reads the forces more than once."""
    x, v = random.uniform(-1, 1, (20, 2)), 4 * random.normal(size=(20, 2))
    near = Neighbours(0.3, 0.02, capacity=19)

    def end(scene, scale):
        run = jeuler.simulate(scene, ParticleState(scale * x, v), dt=0.02, num_steps=6, step=jeuler.rk4_step)
        return jnp.sum(run.y.position[-1] ** 2)

    def both(scene):
        return jax.jit(jax.value_and_grad(lambda scale: end(scene, scale)))(1.0)

    ours, truth = both(Scene((SoftRepulsion(near, 0.3, 50.0, 2.0),), (near,))), both(Scene((of_all_pairs,)))
    np.testing.assert_allclose(ours, truth, rtol=1e-9)


def test_a_row_that_is_too_short_at_a_stage_is_not_a_number():
    """Three meet in the middle of the step alone, where a row has one place."""
    near = Neighbours(0.3, 0.02, capacity=1)
    x, v = np.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]), np.array([[2.0, 0.0], [0.0, 0.0], [-2.0, 0.0]])
    scene = Scene((SoftRepulsion(near, 0.3, 1.0),), (near,))
    run = jeuler.simulate(scene, ParticleState(x, v), dt=1.0, num_steps=1, step=jeuler.rk4_step)
    assert int(run.first_nonfinite) == 1


def test_action_equals_reaction_and_a_lattice_has_its_density(random):
    near = Neighbours(0.15, 0.05, capacity=60)
    fluid = Fluid(near, mass=0.01, density=0.5, stiffness=9.0, viscosity=0.1)
    scene = Scene((fluid, SoftRepulsion(near, 0.15, 50.0, 2.0)), (near,))
    grid = 0.05 * np.stack(np.meshgrid(*[np.arange(20.0)] * 2), axis=-1).reshape(-1, 2)
    state = ParticleState(grid, random.normal(size=grid.shape))
    first = jax.tree.map(lambda x: x[0], jeuler.simulate(scene, state, dt=1e-3, num_steps=0).y)
    assert first.missed_neighbours == 0
    for force in scene.forces_by_name(0.0, first).values():
        assert jnp.abs(force).max() > 0.1
        np.testing.assert_allclose(jnp.sum(force, axis=0), 0, atol=1e-11)
    middle = 10 * 20 + 10
    np.testing.assert_allclose(fluid.densities(first.position, first.neighbours)[middle], 0.01 / 0.05**2, rtol=0.01)


def test_a_flock_goes_one_way_and_newborns_are_seen():
    near = Neighbours(2.0, 0.2, capacity=8)
    flock = Flocking(near, separation=0.1, alignment=3.0, cohesion=0.1)
    pair = jeuler.Emitter(0.0, [0.5, 0.0], [0.0, 1.0], bursts=((0.5, 1),), max_births=1)
    pool = ParticleState(jnp.zeros((2, 2)), jnp.zeros((2, 2)), alive=jnp.array([True, False]))
    scene = Scene((flock,), (pair, near))
    run = jeuler.simulate(scene, pool, dt=0.1, num_steps=30, key=jax.random.key(0)).y
    assert not run.velocity[:5].any(), "alone, nothing acts"
    np.testing.assert_allclose(run.velocity[-1, 0, 1], run.velocity[-1, 1, 1], atol=0.05)
    assert run.velocity[-1, 0, 1] > 0.3


def test_what_cannot_be_right_is_said():
    near = Neighbours(0.3, 0.1, capacity=4)
    state = ParticleState(jnp.zeros((2, 2)), jnp.zeros((2, 2)))
    scene = Scene((SoftRepulsion(near, 0.2, 1.0),), (near,))
    assert np.isnan(scene.force(0.0, state)).all(), "rows were never made"
    for wrong, match in (
        (lambda: SoftRepulsion(0.3, 0.2, 1.0), "must be a Neighbours"),
        (
            lambda: jeuler.simulate(Scene((SoftRepulsion(near, 0.4, 1.0),), (near,)), state, dt=0.1, num_steps=1),
            "cutoff",
        ),
        (lambda: jeuler.simulate(Scene((SoftRepulsion(near, 0.2, 1.0),)), state, dt=0.1, num_steps=1), "neighbours"),
        (lambda: Neighbours(0.3, 0.1, 4, box=[1.0, 2.0]).check(5, 2), "at least 3"),
        (lambda: Neighbours(0.3, 0.0, 4), "skin"),
    ):
        with pytest.raises(ValueError, match=match):
            wrong()


def test_a_newborn_in_a_slot_of_zeros_feels_nobody_before_it_has_a_row():
    """Slot 0 is near; the zeros of a dead row are no neighbours."""
    near = Neighbours(1.0, 0.2, capacity=3)
    burst = jeuler.Emitter(0.0, [0.5], [0.0], bursts=((0.0, 1),), max_births=1)
    pool = ParticleState(jnp.zeros((2, 1)), jnp.zeros((2, 1)), alive=jnp.array([True, False]))
    scene = Scene((SoftRepulsion(near, 1.0, 8.0),), (burst, near))
    run = jeuler.simulate(scene, pool, dt=0.1, num_steps=2, key=jax.random.key(0)).y
    assert not run.velocity[1].any()
    np.testing.assert_allclose(run.velocity[2, :, 0], [-0.4, 0.4])


def test_the_nearest_point_of_a_triangle_is_the_nearest_of_many():
    """Beside each side and corner, above the inside, on it; and of a triangle without area."""
    corners = np.array(
        [[[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 0.9, 0.3]], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.4, 0.0, 0.0]]]
    )
    p = np.concatenate([np.random.default_rng(0).uniform(-1, 2, (60, 3)), corners[0], corners.mean(axis=1)])
    a, b = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    a, b = a[a + b <= 1 + 1e-9], b[a + b <= 1 + 1e-9]
    for triangle in corners:
        w = np.asarray(nearest_weights(jnp.asarray(p), jnp.broadcast_to(triangle, (len(p), 3, 3))))
        np.testing.assert_allclose(w.sum(axis=1), 1, atol=1e-12)
        assert w.min() >= 0
        found = np.linalg.norm(p - w @ triangle, axis=1)
        sampled = np.linalg.norm(p[:, None] - np.stack([1 - a - b, a, b], axis=1) @ triangle, axis=2).min(axis=1)
        assert (found <= sampled + 1e-12).all()
        np.testing.assert_allclose(found, sampled, atol=0.012)


def test_a_particle_is_pushed_off_a_sheet_with_no_momentum_or_torque_made():
    """Above each kind of place of a triangle and far from its owner; the force is the slope of its energy."""
    sheet = jeuler.grid_cloth((3, 3), (2.0, 2.0), density=1.0, ks=1.0)
    x = np.concatenate([sheet.state.position, [[-0.6, -0.7, 0.06], [0.3, 0.3, -0.05], [1.05, 0.4, 0.02]]])
    triangles = sheet.triangles
    v = np.random.default_rng(0).normal(size=x.shape)

    def near(cutoff):
        return Neighbours(cutoff, 0.1, capacity=11, cell_capacity=12)

    def force(x, kd=0.0, cutoff=1.8):
        effect = near(cutoff)
        contact = jeuler.TriangleContact(effect, triangles, thickness=0.1, ks=50.0, kd=kd)
        state = ParticleState(x, v)
        made = effect(0.0, jnp.asarray(0.1), state, state.replace(**with_rows(len(x), 11)), None)
        return contact(0.0, x, jnp.asarray(v), 1.0, made.neighbours)

    def energy(x):
        corners = jnp.broadcast_to(x[triangles], (len(x), *triangles.shape, 3))
        w = nearest_weights(x[:, None], corners)
        r = length(x[:, None] - jnp.sum(w[..., None] * corners, axis=2))
        own = (triangles[None] == np.arange(len(x))[:, None, None]).any(axis=2)
        return jnp.sum(jnp.where(own, 0, jnp.maximum(0.1 - r, 0) ** 2)) * 25.0

    x = jnp.asarray(x)
    found = jax.jit(force)(x)
    np.testing.assert_allclose(found, -jax.jit(jax.grad(energy))(x), atol=1e-12)
    assert (jnp.abs(found[9:]).max(axis=1) > 1).all(), "all three are pushed"
    damped = jax.jit(lambda x: force(x, kd=2.0))(x)
    for f in (found, damped):
        np.testing.assert_allclose(jnp.sum(f, axis=0), 0, atol=1e-12)
        np.testing.assert_allclose(jnp.sum(jnp.cross(x, f), axis=0), 0, atol=1e-12)
    assert jnp.isnan(jax.jit(lambda x: force(x, cutoff=1.4))(x)).all(), "a side is longer than the cutoff less s"


def with_rows(particles, capacity):
    """The fields of a state whose rows were never made."""
    return {
        "neighbours": jnp.full((particles, capacity), -2, jnp.int32),
        "neighbours_made_at": jnp.zeros((particles, 3)),
        "has_neighbours": jnp.zeros(particles, bool),
        "missed_neighbours": jnp.zeros(1, jnp.int32),
    }
