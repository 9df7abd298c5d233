"""What touches: stacks, overlaps, friction that holds, edges, contacts at the end of a step; and what is counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Box, Collisions, Plane
from jeuler.contact.impacts import drives
from jeuler.contact.paths import free_path

FLOOR = Plane([0.0, 0.0], [0.0, 1.0])
GRAVITY = jeuler.Gravity([0.0, -9.8])


def run(contact, position, velocity, *, dt, num_steps, forces=(GRAVITY,), effects=(), mass=1.0, **how):
    state = jeuler.ParticleState(jnp.asarray(position), jnp.asarray(velocity), mass=mass)
    return jeuler.simulate(jeuler.Scene(forces, (*effects, contact)), state, dt=dt, num_steps=num_steps, **how)


def test_three_and_ten_stacked_balls_stay_where_they_are():
    """33 s."""
    three, ten = np.arange(3), np.arange(3, 13)
    position = np.concatenate([np.stack([k + 0 * n, 0.1 + 0.2 * (n - n[0])], 1) for k, n in enumerate((three, ten))])
    pairs = [(k, k + 1) for k in range(12) if k != 2]
    stacks = Collisions((FLOOR,), pairs=pairs, radius=0.1)
    end = run(stacks, position, 0 * position, dt=1 / 60, num_steps=2000, save_every=100)
    np.testing.assert_allclose(end.y.position, np.broadcast_to(position, end.y.position.shape), atol=1e-9)
    assert int(end.unresolved_contacts) == 0


def test_packed_heap_stays_and_one_that_falls_together_comes_to_rest():
    """More contacts than degrees of freedom, and more impacts in a step than are followed: they are counted."""
    rows = [(0.1 + 0.1 * (j % 2) + 0.2 * i, 0.1 + 0.1 * np.sqrt(3) * j) for j in range(6) for i in range(5 - j % 2)]
    packed = np.array(rows[:24])
    loose = np.array([[0.11 + 0.25 * i + 0.01 * (j % 2), 0.11 + 0.21 * j] for i in range(4) for j in range(6)])
    box = (FLOOR, Plane([0.0, 0.0], [1.0, 0.0]), Plane([1.0, 0.0], [-1.0, 0.0]))
    pairs = np.stack(np.triu_indices(24, 1), 1)
    heap = Collisions(box, pairs=pairs, radius=0.1, restitution=0.3, friction=0.3, max_bounces=4)
    how = {"dt": 0.01, "num_steps": 100, "save_every": 10, "step": jeuler.symplectic_euler_step}
    fall = jax.jit(lambda position: run(heap, position, 0 * position, **how))
    for position in packed, loose:
        end = fall(position)
        x, v = end.y.position, end.y.velocity
        energy = 9.8 * jnp.sum(x[..., 1], axis=1) + jnp.sum(v**2, axis=(1, 2)) / 2
        assert jnp.all(jnp.diff(energy) <= 1e-5 * energy[0])
        gap = jnp.linalg.norm(x[:, pairs[:, 0]] - x[:, pairs[:, 1]], axis=-1) - 0.2
        assert jnp.min(gap) > -1e-6
        assert jnp.all((x[..., 1] > 0.0999) & (x[..., 0] > 0.0999) & (x[..., 0] < 0.9001))
        assert jnp.max(jnp.abs(v[-1])) < 1e-5
        if position is packed:
            np.testing.assert_allclose(x, np.broadcast_to(packed, x.shape), atol=1e-7)
            assert int(end.unresolved_contacts) == 0


def test_overlapping_balls_part_and_do_not_fly_off():
    pair = Collisions(pairs=[(0, 1)], radius=0.1)
    end = run(pair, [[0.0], [0.19]], [[1.0], [np.nextafter(1.0, 0)]], dt=0.1, num_steps=1, forces=()).y
    np.testing.assert_allclose(end.position[-1, :, 0], [0.095, 0.295], atol=1e-12)
    np.testing.assert_allclose(end.velocity[-1, :, 0], 1, atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_gradient_of_two_elastic_balls_that_meet_at_the_end_of_a_step(dtype):
    def end(q):
        state = jeuler.ParticleState(q[:2, None], q[2:, None])
        scene = jeuler.Scene(effects=(Collisions(pairs=[(0, 1)], radius=0.1, restitution=1.0),))
        return jeuler.simulate(scene, state, dt=q.dtype.type(0.01), num_steps=100).y.position[-1, 1, 0]

    several = jnp.array(
        [[0.0, 0.52, 1.0, 0.0], [0.0, 0.3, 1.0, 0.0], [0.1, 0.4, 0.5, -0.5], [0.0, 0.2, 1.0, 0.5]], dtype
    )
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(end)))(several)
    np.testing.assert_allclose(value, several[:, 0] + 0.2 + several[:, 2], rtol=1e-5)
    np.testing.assert_allclose(gradient, np.broadcast_to([1, 0, 1, 0], (4, 4)), atol=1e-5)


def test_normal_impact_keeps_the_tangential_gradient():
    def end(speed):
        bouncing = Collisions((FLOOR,), restitution=0.8)
        return run(bouncing, [[0.0, 1.0]], jnp.stack([speed, 0.0])[None], dt=0.01, num_steps=100).y.position[-1, 0, 0]

    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(end)))(jnp.array([0.0, 1e-9, 0.5])), 1, rtol=1e-12)


@pytest.mark.parametrize(
    "step", [jeuler.euler_step, jeuler.symplectic_euler_step, jeuler.rk4_step, jeuler.implicit_euler_step]
)
def test_friction_below_its_limit_moves_nothing_and_has_gradient_zero(step):
    angle = np.deg2rad(20.0)
    normal = np.array([-np.sin(angle), np.cos(angle)])

    def end(friction, restitution):
        block = Collisions((Plane([0.0, 0.0], normal),), friction=friction, restitution=restitution, radius=0.1)
        last = run(block, 0.1 * normal[None], np.zeros((1, 2)), dt=0.01, num_steps=1000, save_every=1000, step=step)
        return jnp.sum(last.y.position[-1, 0] @ jnp.array([np.cos(angle), np.sin(angle)]))

    moved, slope = jax.jit(jax.vmap(jax.value_and_grad(end), (None, 0)))(0.5, jnp.array([0.0, 0.3, 0.8]))
    np.testing.assert_allclose(moved, 0, atol=1e-9)
    np.testing.assert_allclose(slope, 0, atol=1e-9)


@pytest.mark.parametrize(
    "step",
    [jeuler.euler_step, jeuler.symplectic_euler_step, jeuler.implicit_euler_step, jeuler.linearly_implicit_euler_step],
    ids=lambda step: step.__name__,
)
def test_a_load_that_rest_alone_does_not_determine_is_counted_where_it_slides(step):
    """A ball stands on one that slides into a wall, and is dragged against that wall: what the wall's friction carries
    of it, any share up to its limit, does not rub on the lower ball. At rest, and without friction, all shares do the
    same."""
    balls, wall = jnp.array([[0.1, 0.1], [0.1, 0.3]]), Plane([0.0, 0.0], [1.0, 0.0])

    @jax.jit
    @jax.vmap
    def unresolved(speed, friction):
        corner = Collisions((FLOOR, wall), [(1, 0)], radius=0.1, restitution=0.5, friction=friction)
        velocity = jnp.zeros((2, 2)).at[0, 0].set(speed)
        return run(corner, balls, velocity, dt=0.02, num_steps=1, mass=0.5, step=step).unresolved_contacts

    counts = unresolved(jnp.array([-0.5, 0.0, -0.5]), jnp.array([0.3, 0.3, 0.0]))
    assert counts[0] > 0
    np.testing.assert_array_equal(counts[1:], 0)


def test_point_slides_over_a_flush_edge():
    end = run(Collisions((FLOOR, Box([2.0, -1.0], 1.0))), [[0.0, 0.0]], [[1.0, 0.0]], dt=0.01, num_steps=200).y
    np.testing.assert_allclose(end.position[-1, 0], [2.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(end.velocity[-1, 0], [1.0, 0.0], atol=1e-9)


def thin_wall(place):
    return lambda t, p: jnp.abs(p[0] - place) - 1e-4


def test_many_bounces_in_a_step_are_followed_or_counted():
    walls = thin_wall(0.0), thin_wall(1.0)
    end = run(Collisions(walls, restitution=1.0), [[0.5]], [[50.0]], dt=0.1, num_steps=2, forces=())
    assert np.all((end.y.position >= 0) & (end.y.position <= 1))
    np.testing.assert_allclose(np.abs(end.y.velocity[-1]), 50, rtol=1e-9)
    assert int(end.unresolved_contacts) == 0
    few = Collisions(walls, restitution=1.0, max_bounces=2)
    assert int(run(few, [[0.5]], [[50.0]], dt=0.1, num_steps=2, forces=()).unresolved_contacts) > 0


def test_cradle_of_eight_touching_balls():
    position = np.concatenate([[0.0], 0.5 + 0.2 * np.arange(7)])[:, None]
    velocity = np.eye(8)[:, :1]
    cradle = Collisions(pairs=[(k, k + 1) for k in range(7)], radius=0.1, restitution=1.0)
    end = run(cradle, position, velocity, dt=0.1, num_steps=10, forces=())
    np.testing.assert_allclose(end.y.velocity[-1, :, 0], np.eye(8)[7], atol=1e-9)
    assert int(end.unresolved_contacts) == 0


@pytest.mark.parametrize("mass", [np.inf, 1.0])
def test_prescribed_paddle_is_not_pushed(mass):
    paddle = jeuler.PrescribedMotion([0], lambda t: jnp.stack([0.3 * t])[None])
    ball = Collisions(pairs=[(0, 1)], radius=0.1, restitution=1.0)
    how = {"forces": (), "effects": (paddle,), "mass": jnp.array([mass, 1.0])}
    end = run(ball, [[0.0], [0.5]], np.zeros((2, 1)), dt=0.013, num_steps=150, **how).y
    np.testing.assert_allclose(end.velocity[-1, :, 0], [0.3, 0.6], rtol=1e-9)


@pytest.mark.parametrize(("far", "counted"), [(100.0, 0), (1e6, 3)])
def test_contacts_far_from_the_origin_in_float32_are_counted(far, counted):
    position = jnp.array([[far, 0.1]], jnp.float32)
    end = run(Collisions((FLOOR,), radius=0.1), position, 0 * position, dt=jnp.float32(0.01), num_steps=3)
    assert end.y.position.dtype == jnp.float32
    assert int(end.unresolved_contacts) == counted


def test_surface_that_is_nan_is_announced():
    end = run(Collisions((lambda t, p: p[1] * jnp.nan,)), [[0.0, 3.0]], [[0.0, -5.0]], dt=0.1, num_steps=10)
    assert int(end.first_nonfinite) == 1


def test_bounce_almost_along_a_floor_is_not_missed():
    """A ball that falls by 0.07 mm in a step while it goes 7 mm along: it meets the floor at s = 0.497 and stays."""
    floor = Collisions((FLOOR,), radius=0.1, restitution=0.5)
    start = [[0.7, 0.1 + 6.7e-5]], [[-1.355, -0.0149]]
    end = run(floor, *start, dt=0.005, num_steps=1, step=jeuler.rk4_step)
    np.testing.assert_allclose(end.y.position[-1, 0], [0.7 - 1.355 * 0.005, 0.1], atol=1e-12)
    np.testing.assert_allclose(end.y.velocity[-1, 0], [-1.355, 0], atol=1e-12)
    assert int(end.unresolved_contacts) == 0


def test_ball_that_is_hit_off_the_floor_falls_from_then_on():
    """A ball at rest on the floor is hit from below its middle at half the step: then the floor holds it no longer."""
    contact = Collisions((FLOOR,), pairs=[(0, 1)], radius=[0.1, 0.005], restitution=1.0)
    way, half, g = np.array([0.8, 0.6]), 0.005, np.array([0.0, -9.8])
    velocity = way - half * g  # so that it is ``way`` as they meet, with centres along it
    meeting = np.array([0.0, 0.1]) - 0.105 * way
    start = [[0.0, 0.1], meeting - half * velocity - half**2 / 2 * g], [[0.0, 0.0], velocity]
    end = run(contact, *start, dt=2 * half, num_steps=1, step=jeuler.rk4_step)
    np.testing.assert_allclose(end.y.velocity[-1, 0], way + half * g, atol=1e-12)
    np.testing.assert_allclose(end.y.position[-1, 0], [0.8 * half, 0.1 + 0.6 * half - 4.9 * half**2], atol=1e-12)


@pytest.mark.parametrize(
    "step",
    [
        jeuler.euler_step,
        jeuler.rk4_step,
        jeuler.implicit_euler_step,
        jeuler.linearly_implicit_euler_step,
        jeuler.extrapolated_euler(3, step=jeuler.linearly_implicit_euler_step),
    ],
    ids=lambda step: step.__name__,
)
def test_ball_that_slides_into_a_wall_stays_on_its_floor(step):
    """What holds it up is the floor's push, whose direction the wall leaves alone; not its friction, which the wall turns."""
    corner = Collisions((FLOOR, Plane([0.0, 0.0], [1.0, 0.0])), radius=0.1, restitution=1.0, friction=0.3)
    end = run(corner, [[0.1, 0.1], [0.35, 0.1]], [[-1.0, 0.0], [-1.0, 0.0]], dt=1 / 30, num_steps=12, step=step)
    np.testing.assert_allclose(end.y.position[:, :, 1], 0.1, atol=1e-12)
    assert (end.y.position[-1, :, 0] > end.y.position[0, :, 0] - 0.2).all()
    assert (end.y.velocity[2, 0, 0] > 0) & (np.abs(end.y.velocity[-1, :, 0]) < 0.5).all()


def test_stack_that_shears_gains_no_energy():
    """The middle ball, between a heavier one and another, slides away: a landing on it is not held by what hardly
    supports it, nor wedged aside (the lower ball got 2.7 m/s so)."""
    middle = Collisions((FLOOR,), [(1, 0), (2, 0), (2, 1)], radius=0.1, restitution=1.0, friction=0.3)
    position, velocity = [[0.2, 0.1], [0.2, 0.3], [0.2, 0.5]], [[0.0, 0.0], [-0.5, 0.0], [0.0, 0.0]]
    mass, gravity = np.array([2.0, 0.5, 1.0]), jeuler.Gravity([0.0, -10.0])
    how = {"forces": (gravity,), "mass": jnp.asarray(mass), "step": jeuler.heun_step}
    end = run(middle, position, velocity, dt=1 / 60, num_steps=24, **how).y
    energy = np.sum(mass * (np.sum(end.velocity**2, axis=-1) / 2 + 10.0 * end.position[..., 1]), axis=1)
    assert (np.diff(energy) < 0.03).all()  # J; of the order of the step: mass (g dt)^2 = 0.1
    assert np.abs(end.velocity[-1]).max() < 0.05


@pytest.mark.parametrize(
    "step",
    [jeuler.symplectic_euler_step, jeuler.rk4_step, jeuler.implicit_euler_step],
    ids=lambda step: step.__name__,
)
def test_a_bounce_turns_friction_around_and_lets_nothing_sink(step):
    """A ball slides from under another into a wall, and back: friction, which has held it back, does not drive it then,
    and what comes to rest on the floor within a step is held there."""
    corner = Collisions((FLOOR, Plane([0.0, 0.0], [1.0, 0.0])), [(1, 0)], radius=0.1, restitution=1.0, friction=0.3)
    position, velocity = [[0.1, 0.1], [0.1, 0.3]], [[-1.0, 0.0], [1.0, 0.0]]
    end = run(corner, position, velocity, dt=0.02, num_steps=12, step=step).y
    energy = np.sum(end.velocity**2 / 2 + 9.8 * end.position * np.array([0.0, 1.0]), axis=(1, 2))
    assert (np.diff(energy) < 1e-9).all()
    assert (end.position[:, 0, 1] > 0.1 - 1e-9).all()


@pytest.mark.parametrize(("rub", "turned"), [(-0.01, True), (-1e-9, False), (-1e-57, False), (0.0, False)])
def test_only_friction_above_rounding_is_turned_around_by_a_bounce(rub, turned):
    """The direction of a rounding means nothing: turned around, it took the derivative of the support with it."""
    slides, load = jnp.array([[1.0, 0.0]]), jnp.array([[0.0, 0.1]])
    path = free_path(jnp.zeros((1, 2)), 0.02 * slides, load, 0.02, load, rub * slides)
    assert drives(path, path.s, -0.02 * slides).item() == turned


def test_a_scene_does_not_depend_on_the_others_of_its_batch():
    """One of two has more impacts in a step than are followed, and is brought to rest; the other is not touched by it."""
    pairs = [(0, 1), (1, 2)]

    def end(x, v):
        scene = jeuler.Scene(effects=(jeuler.Collisions(pairs=pairs, radius=0.1, restitution=1.0, max_bounces=1),))
        run = jeuler.simulate(scene, jeuler.ParticleState(x, v), dt=0.1, num_steps=4, save_every=4)
        return run.y.position[-1], run.unresolved_contacts

    apart = [[0.0, 0.0], [0.35, 0.0], [5.0, 0.0]]
    crowded = [[0.0, 0.0], [0.2, 0.0], [0.4, 0.0]]
    calm, wild = [[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]], [[40.0, 0.0], [0.0, 0.0], [-40.0, 0.0]]
    x, v = jnp.array([apart, crowded]), jnp.array([calm, wild])
    together, counts = jax.jit(jax.vmap(end))(x, v)
    alone, count = jax.jit(end)(x[0], v[0])
    assert (int(count), int(counts[0])) == (0, 0)
    assert counts[1] > 0
    np.testing.assert_allclose(together[0], alone, rtol=1e-13, atol=1e-13)
