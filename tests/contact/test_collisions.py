"""Contact: exact values and gradients through bounces, rest, friction, thin obstacles, moving colliders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Collisions, SampledPath
from jeuler.contact.colliders import Box, Plane, Sphere
from jeuler.contact.contacts import Contacts
from jeuler.contact.paths import free_path

G = 9.81
FLOOR = Plane([0.0, 0.0], [0.0, 1.0])
EXPLICIT_AND_SYMPLECTIC = pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.symplectic_euler_step])


def ball(position, velocity, mass=1.0):
    return jeuler.ParticleState(jnp.atleast_2d(jnp.asarray(position)), jnp.atleast_2d(jnp.asarray(velocity)), mass)


def on_floor(height=0.1, speed=0.0, g=G, *, num_steps, dt=1e-3, step=jeuler.symplectic_euler_step, **contact):
    """A ball of radius 0.1 over a floor."""
    scene = jeuler.Scene(
        forces=(jeuler.Gravity(jnp.array([0.0, -1.0]) * g),),
        effects=(Collisions((FLOOR,), radius=0.1, **contact),),
    )
    state = jeuler.ParticleState(jnp.array([[0.0, 1.0]]) * height, jnp.array([[1.0, 0.0]]) * speed)
    return jeuler.simulate(scene, state, dt=dt, num_steps=num_steps, step=step)


@pytest.mark.parametrize(("num_steps", "pairs"), [(1, [(0, 1)]), (7, "near")])
def test_two_elastic_balls_and_the_gradient_of_where_the_second_ends(num_steps, pairs):
    def end(q):
        state = jeuler.ParticleState(q[:2, None], q[2:, None])
        scene = jeuler.Scene(effects=(Collisions(pairs=pairs, radius=0.1, restitution=1.0),))
        return jeuler.simulate(scene, state, dt=1 / num_steps, num_steps=num_steps).y.position[-1, 1, 0]

    q = np.array([0.0, 0.52, 1.0, 0.0])
    value, gradient = jax.jit(jax.value_and_grad(end))(q)
    np.testing.assert_allclose(value, 1.2, rtol=1e-14)
    np.testing.assert_allclose(gradient, [1, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(q), [1, 0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("num_steps", [10, 33])
def test_ball_between_two_walls_bounces_many_times_exactly(num_steps):
    """Unfolding the reflections gives the end: 12 bounces, two of them in some steps."""
    walls = Collisions((Plane([0.0], [1.0]), Plane([1.0], [-1.0])), radius=0.1, restitution=1.0, max_bounces=4)

    @jax.jit
    @jax.value_and_grad
    def end(q):
        state = jeuler.ParticleState(q[None, :1], q[None, 1:])
        scene = jeuler.Scene(effects=(walls,))
        return jeuler.simulate(scene, state, dt=10 / num_steps, num_steps=num_steps).y.position[-1, 0, 0]

    def unfolded(x, v):
        u = (x - 0.1 + 10 * v) % 1.6
        return 0.1 + min(u, 1.6 - u)

    value, gradient = end(np.array([0.3, 1.0]))
    np.testing.assert_allclose(value, unfolded(0.3, 1.0), rtol=1e-12)
    np.testing.assert_allclose(gradient, [1, 10], rtol=1e-12)


def test_newtons_cradle_in_one_step():
    """Five touching balls: the first one's velocity goes to the last."""
    position = jnp.array([[-0.5], [0.0], [0.2], [0.4], [0.6]])
    velocity = jnp.zeros((5, 1)).at[0].set(1.0)
    pairs = [(k, k + 1) for k in range(4)]
    cradle = Collisions(pairs=pairs, radius=0.1, restitution=1.0, max_bounces=4)
    state = jeuler.ParticleState(position, velocity)
    end = jeuler.simulate(jeuler.Scene(effects=(cradle,)), state, dt=1.0, num_steps=1).y
    np.testing.assert_allclose(end.velocity[-1, :, 0], [0, 0, 0, 0, 1], atol=1e-14)
    np.testing.assert_allclose(end.position[-1, :, 0], [-0.2, 0, 0.2, 0.4, 1.3], atol=1e-14)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("masses", [(1.0, 2.0), (1.0, 1.0), (2.0, 1.0)])
@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.rk4_step])
def test_plastic_impacts_against_a_wall_go_on_until_nothing_moves(step, masses, dtype):
    """One ball pushes another into the wall: each two impacts leave 2/3 of the speed if its mass is twice the other's."""
    wall = Collisions((Plane([0.0, 0.0], [1.0, 0.0]),), pairs=[(0, 1)], radius=0.1)

    def end(velocity):
        state = jeuler.ParticleState(np.array([[0.1, 0.3], [0.36, 0.3]], dtype), velocity, np.array(masses, dtype))
        solution = jeuler.simulate(jeuler.Scene(effects=(wall,)), state, dt=0.02, num_steps=6, step=step)
        y = solution.y
        return y.position[-1], (y.velocity[-1], solution.unresolved_contacts)

    velocity = np.array([[0.0, 0.0], [-1.0, 0.0]], dtype)
    slopes, (last, unresolved) = jax.jacrev(end, has_aux=True)(velocity)
    small = 1e2 * np.finfo(dtype).eps
    np.testing.assert_allclose(end(velocity)[0], [[0.1, 0.3], [0.3, 0.3]], atol=small)
    np.testing.assert_allclose(last, 0, atol=small)
    np.testing.assert_allclose(slopes[:, 0, :, 0], 0, atol=small)  # of places along the wall's normal
    assert unresolved == 0


@pytest.mark.parametrize("max_bounces", [1, 30, 31, 32, 33, 63, 64, 191])
def test_as_many_rounds_as_asked_for_are_followed_and_differentiated(max_bounces):
    """A ball goes to and fro between walls in one step: the last bounce that is followed, and one more, which is counted."""
    walls = (Plane([0.0], [1.0]), Plane([1.0], [-1.0]))
    box = Collisions(walls, restitution=1.0, max_bounces=max_bounces)

    def end(speed):
        state = jeuler.ParticleState(jnp.array([[0.5]]), speed[None, None])
        solution = jeuler.simulate(jeuler.Scene(effects=(box,)), state, dt=1.0, num_steps=1)
        return solution.y.position[-1, 0, 0], solution.unresolved_contacts

    bounces = min(max_bounces, 60)
    (place, left), slope = jax.value_and_grad(end, has_aux=True)(bounces + 0.25)
    sign = (-1) ** bounces
    np.testing.assert_allclose((place, slope), (0.5 + 0.25 * sign, sign), rtol=1e-12)
    assert left == 0
    if max_bounces < 60:
        assert end(jnp.float64(max_bounces + 1.25))[1] == 1


@pytest.mark.parametrize("colliders", [(), (Plane([0.0, 0.0], [1.0, 0.0]),)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_approach_that_may_be_rounding_is_no_impact(dtype, colliders):
    """Extrapolated steps leave twelve units in the last place between elastic balls that touch."""
    eps, dt = np.finfo(dtype).eps, 1 / 64
    touching = Collisions(colliders, pairs=[(0, 1)], radius=0.125, restitution=1.0, friction=0.3)
    position = np.array([[0.125, 0.5], [0.375, 0.5]], dtype)

    def end(velocity):
        run = jeuler.simulate(
            jeuler.Scene(effects=(touching,)), jeuler.ParticleState(position, velocity), dt=dt, num_steps=1
        )
        return run.y.velocity[-1]

    velocity = np.array([[12 * eps / dt, 0.0], [0.0, 0.0]], dtype)
    np.testing.assert_allclose(end(velocity), 0, atol=np.max(velocity))
    np.testing.assert_allclose(jax.jacrev(end)(velocity).reshape(4, 4), np.eye(4), atol=eps)


def test_balls_keep_momentum_and_elastic_ones_energy():
    mass = jnp.array([1.0, 2.0, 5.0])
    state = jeuler.ParticleState(
        jnp.array([[0.0, 0.0], [1.0, 0.05], [2.0, -0.05]]), jnp.array([[3.0, 0.0], [0.0, 0.0], [-2.0, 0.1]]), mass
    )
    balls = Collisions(pairs=[(0, 1), (1, 2), (0, 2)], radius=0.2, restitution=1.0)
    run = jeuler.simulate(jeuler.Scene(effects=(balls,)), state, dt=0.05, num_steps=40).y
    momentum = jnp.sum(mass[:, None] * run.velocity, axis=1)
    energy = jnp.sum(mass[:, None] * run.velocity**2, axis=(1, 2))
    assert jnp.max(jnp.abs(run.velocity[-1] - run.velocity[0])) > 1
    np.testing.assert_allclose(momentum, jnp.broadcast_to(momentum[0], momentum.shape), atol=1e-13)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-13)


@EXPLICIT_AND_SYMPLECTIC
def test_ball_at_rest_stays_at_rest_with_finite_gradients(step):
    @jax.jit
    def position(height, g):
        return on_floor(height, g=g, num_steps=200, restitution=0.5, friction=0.3, step=step).y.position

    rest = position(0.1, G)
    assert jnp.max(jnp.abs(rest - rest[0])) == 0
    gradient = jax.jit(jax.grad(lambda *q: jnp.sum(position(*q)[-1]), argnums=(0, 1)))(0.1, G)
    assert np.isfinite(gradient).all()


def test_ball_comes_to_rest_where_the_bounces_accumulate():
    """e = 1/2 from 0.2 m: at rest after sqrt(2 h/g) (1 + e) / (1 - e) = 0.6 s, on the floor."""
    run = on_floor(0.3, num_steps=1000, restitution=0.5).y
    assert jnp.all(run.position[:, 0, 1] >= 0.1 - 1e-12)
    assert jnp.max(jnp.abs(run.position[560:600, 0, 1] - 0.1)) > 0
    np.testing.assert_allclose(run.position[650:, 0, 1], 0.1, atol=1e-12)
    np.testing.assert_array_equal(run.velocity[650:], 0)


@EXPLICIT_AND_SYMPLECTIC
def test_elastic_bounces_keep_the_energy(step):
    """15 bounces in 10 s at dt = 1e-3: within 0.5 %, either way."""
    run = on_floor(0.6, num_steps=10000, restitution=1.0, step=step).y
    energy = G * run.position[:, 0, 1] + run.velocity[:, 0, 1] ** 2 / 2
    np.testing.assert_allclose(energy, energy[0], rtol=5e-3)


def test_gradient_through_a_bounce_under_gravity():
    """x(T) = r + v* (T - t*) - g (T - t*)^2 / 2 with t* = sqrt(2 h/g), v* = sqrt(2 g h): and dx/dh of it."""

    @jax.jit
    def end(height):
        return on_floor(height, num_steps=2000, dt=3e-4, restitution=1.0).y.position[-1, 0, 1]

    def exact(height):
        fall = jnp.sqrt(2 * (height - 0.1) / G)
        left = 0.6 - fall
        return 0.1 + G * fall * left - G * left**2 / 2

    np.testing.assert_allclose(end(0.6), exact(0.6), rtol=2e-3)
    np.testing.assert_allclose(jax.grad(end)(0.6), jax.grad(exact)(0.6), rtol=2e-3)
    h = 1e-6
    np.testing.assert_allclose(jax.grad(end)(0.6), (end(0.6 + h) - end(0.6 - h)) / (2 * h), rtol=1e-7)


def test_sliding_ball_stops_where_friction_says():
    """v^2 / (2 mu g), and its derivative v / (mu g)."""

    @jax.jit
    def end(speed):
        return on_floor(speed=speed, num_steps=600, friction=0.3).y.position[-1, 0, 0]

    np.testing.assert_allclose(end(1.0), 1 / (2 * 0.3 * G), rtol=5e-3)
    np.testing.assert_allclose(jax.grad(end)(1.0), 1 / (0.3 * G), rtol=5e-3)


@EXPLICIT_AND_SYMPLECTIC
def test_ball_holds_on_a_slope_below_the_friction_angle_and_slides_above(step):
    def end(friction):
        slope = Plane([0.0, 0.0], [-0.5, np.sqrt(0.75)])  # 30 degrees, tan = 0.577
        scene = jeuler.Scene((jeuler.Gravity([0.0, -G]),), (Collisions((slope,), friction=friction),))
        return jeuler.simulate(scene, ball([0.0, 0.0], [0.0, 0.0]), dt=1e-3, num_steps=300, step=step).y.position[-1, 0]

    along = -jnp.array([np.sqrt(0.75), 0.5])
    np.testing.assert_allclose(end(0.6), 0, atol=2e-5)  # one explicit step's slip at most
    expected = G * (0.5 - 0.3 * np.sqrt(0.75)) * 0.3**2 / 2
    np.testing.assert_allclose(end(0.3) @ along, expected, rtol=2e-2)


def smooth_disc(t, point):
    return jnp.sqrt(jnp.sum(point**2)) - 0.1


@pytest.mark.parametrize(
    ("collider", "end"),
    [
        (Box([0.0, 0.0], [0.001, 1.0]), (-0.602, 0.05)),
        (Sphere([0.0, 0.0], 0.1), None),
        (smooth_disc, None),
    ],
)
def test_fast_thin_crossing_is_not_missed_within_a_step(collider, end):
    """100 m/s at dt = 0.01 s: one metre a step through two millimetres."""
    scene = jeuler.Scene(effects=(Collisions((collider,), radius=0.05, restitution=1.0),))
    run = jeuler.simulate(scene, ball([-0.5, 0.05], [100.0, 0.0]), dt=1e-2, num_steps=1).y
    if end is None:  # a disc of 0.15 m met at height 0.05: the normal there, and the mirrored path
        normal = np.array([-np.sqrt(0.15**2 - 0.05**2), 0.05]) / 0.15
        met = np.array([normal[0] * 0.15, 0.05])
        velocity = 100 * (np.array([1.0, 0.0]) - 2 * normal[0] * normal)
        end = met + velocity * (0.01 - (met[0] + 0.5) / 100)
    np.testing.assert_allclose(run.position[-1, 0], end, rtol=1e-9)
    np.testing.assert_allclose(jnp.linalg.norm(run.velocity[-1]), 100, rtol=1e-12)


def test_ball_that_only_begins_to_fall_close_above_the_floor_is_not_missed():
    """Gaps of 1e-9 to 1e-3 m and speeds around 0, 40 mm a step of falling: the way to the impact begins almost flat."""
    scene = jeuler.Scene((jeuler.Gravity([0.0, -10.0]),), (Collisions((FLOOR,), radius=0.1, restitution=0.5),))

    def height(gap, up):
        state = ball(jnp.stack([0 * gap, 0.1 + gap]), jnp.stack([0 * up, up]))
        end = jeuler.simulate(scene, state, dt=0.02, num_steps=1, step=jeuler.rk4_step)
        return end.y.position[-1, 0, 1] - 0.1, end.unresolved_contacts

    gap, up = np.meshgrid(np.logspace(-9, -3, 61), np.linspace(-0.02, 0.09, 111))
    end, unresolved = jax.jit(jax.vmap(height))(gap.ravel(), up.ravel())
    assert (end > -1e-9).all()
    assert not unresolved.any()


def test_inside_of_a_sphere_holds():
    scene = jeuler.Scene(effects=(Collisions((Sphere([0.0, 0.0], 1.0, inside=True),), restitution=1.0),))
    run = jeuler.simulate(scene, ball([0.3, 0.1], [2.0, 1.7]), dt=0.1, num_steps=200).y
    assert jnp.max(jnp.linalg.norm(run.position[:, 0], axis=-1)) <= 1 + 1e-12
    np.testing.assert_allclose(jnp.linalg.norm(run.velocity[:, 0], axis=-1), np.hypot(2.0, 1.7), rtol=1e-12)


def test_moving_wall_hits_a_ball():
    """A wall at 2 m/s meets a resting ball at x = 1: elastic, it leaves with 4 m/s and ends at 1 + 4 (T - 1/2)."""
    wall = Plane(SampledPath([0.0, 10.0], [[0.0], [20.0]]), [1.0])
    scene = jeuler.Scene(effects=(Collisions((wall,), restitution=1.0),))
    run = jeuler.simulate(scene, ball([1.0], [0.0]), dt=0.3, num_steps=3).y
    np.testing.assert_allclose(run.velocity[-1, 0, 0], 4, rtol=1e-9)
    np.testing.assert_allclose(run.position[-1, 0, 0], 1 + 4 * 0.4, rtol=1e-9)


def test_a_pinned_particle_is_a_wall_and_is_not_moved():
    balls = Collisions((FLOOR,), pairs=[(0, 1)], radius=0.1, restitution=1.0)
    state = jeuler.ParticleState([[0.0, 0.1], [1.0, 0.1]], [[0.0, 0.0], [-1.0, 0.0]], mass=[jnp.inf, 1.0])
    run = jeuler.simulate(jeuler.Scene(effects=(balls,)), state, dt=0.5, num_steps=3).y
    np.testing.assert_array_equal(run.position[:, 0], run.position[:1, 0].repeat(4, 0))
    np.testing.assert_allclose(run.position[-1, 1, 0], 0.9, rtol=1e-12)


def test_second_derivative_through_a_bounce_off_a_sphere():
    """The deflection by a disc depends on the height of the path in a curved way."""
    scene = jeuler.Scene(effects=(Collisions((Sphere([0.0, 0.0], 0.1),), radius=0.05, restitution=1.0),))

    def end(height):
        state = jeuler.ParticleState(jnp.stack([-0.5, height])[None], jnp.array([[100.0, 0.0]]))
        return jeuler.simulate(scene, state, dt=1e-2, num_steps=1).y.position[-1, 0, 1]

    h = 1e-5
    value_and_slope = jax.jit(jax.value_and_grad(end))
    (above, slope_above), (_, slope), (below, slope_below) = map(value_and_slope, (0.05 + h, 0.05, 0.05 - h))
    np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.hessian(end))(0.05), (slope_above - slope_below) / (2 * h), rtol=1e-6)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("step", [jeuler.symplectic_euler_step, jeuler.linearly_implicit_euler_step])
def test_pairs_without_a_third_are_solved_alone_as_among_others(step, restitution):
    """Two pairs of other masses that springs draw together, one with a pinned ball; and beside them a wall far away,
    with which each ball may have several contacts at once."""
    position = jnp.array([[0.0, 0.0], [0.26, 0.05], [2.0, 0.0], [2.3, 0.1]])
    velocity = jnp.array([[0.5, 0.0], [-0.2, 0.1], [0.0, 0.0], [-0.6, 0.0]])
    mass = jnp.array([1.0, 0.5, jnp.inf, 2.0])
    springs = jeuler.Springs([[0, 1], [2, 3]], 30.0, 0.5, jnp.array([0.15, 0.15]))
    away = Plane([-50.0, 0.0], [1.0, 0.0])

    def run(position, velocity, friction, colliders):
        contact = Collisions(colliders, [(0, 1), (2, 3)], radius=0.1, restitution=restitution, friction=friction)
        scene = jeuler.Scene((springs,), (contact,))
        state = jeuler.ParticleState(position, velocity, mass)
        return jeuler.simulate(scene, state, dt=0.01, num_steps=40, step=step)

    def sums(colliders):
        def weighted(*numbers):
            end = run(*numbers, colliders)
            weights = jnp.arange(1.0, 9.0).reshape(4, 2)
            return jnp.sum(weights * end.y.position[-1] + end.y.velocity[-1] / weights), end.unresolved_contacts

        gradient = jax.jit(jax.value_and_grad(weighted, argnums=(0, 1, 2), has_aux=True))
        return gradient(position, velocity, 0.3)

    (alone, count), gradient = sums(())
    (among, _), of_among = sums((away,))
    assert count == 0
    np.testing.assert_allclose(alone, among, rtol=1e-9)
    for one, other in zip(gradient, of_among, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("speed", "counted"), [(0.9, 0), (1.0, 1), (1.1, 0)])
def test_an_impact_with_friction_exactly_at_its_limit_is_counted(speed, counted):
    """|v_t| = friction (1 + restitution) |v_n| = 1: whether it sticks, rounding decides; it has no other contact."""
    contact = Collisions((FLOOR,), radius=0.1, restitution=1.0, friction=0.5)
    state = ball([0.0, 0.6], [speed, -1.0])
    run = jeuler.simulate(jeuler.Scene(effects=(contact,)), state, dt=0.25, num_steps=4)
    assert run.unresolved_contacts == counted


@pytest.mark.parametrize("capacity", [None, 2])
def test_near_pairs_are_those_that_can_meet_and_others_are_counted(capacity):
    """On a grid with equal, touching and coinciding balls; the dead and pairs that cannot move are no pairs."""
    x = 0.2 * np.stack(np.meshgrid(*[np.arange(7.0)] * 2), axis=-1).reshape(-1, 2)
    x[20], x[30] = x[19], [np.nan, 0.0]
    mass, alive = np.where(np.arange(49) % 3 == 0, np.inf, 1.0), np.arange(49) != 8
    way = np.where(np.arange(49) == 3, 0.02, 0.01)[:, None] * [1.0, 0.0]
    balls = Collisions(pairs="near", radius=0.1, capacity=capacity)

    @jax.jit
    def those(x):
        contacts = Contacts(balls, jnp.zeros(()), jnp.ones(()), x, jnp.asarray(mass), jnp.asarray(alive))
        contacts.near(free_path(x, jnp.asarray(way), 0 * x, 1.0))
        return jnp.stack([contacts.i, contacts.j], axis=1), contacts.listed, contacts.left_out

    pairs, listed, left_out = those(x)
    found = [(i, j) for i, j in pairs[np.asarray(listed)].tolist()]
    i, j = np.triu_indices(49, 1)
    d = np.linalg.norm(x[i] - x[j], axis=1) - 0.2
    due = (d <= 4 * 0.02) & alive[i] & alive[j] & ~(np.isinf(mass[i]) & np.isinf(mass[j]))
    truth = {(a, b) for a, b in np.stack([i, j], axis=1)[due].tolist()}
    if capacity is None:
        assert sorted(truth) == found, "in the order of named pairs"
        assert int(left_out) == 0
    else:
        assert set(found) < truth
        assert int(left_out) >= len(truth) - len(found)


def test_no_collisions_unless_called_for():
    """Particles pass through each other when no pair is named."""
    state = jeuler.ParticleState([[0.0], [1.0]], [[1.0], [-1.0]])
    run = jeuler.simulate(jeuler.Scene(effects=(Collisions(radius=0.4),)), state, dt=0.5, num_steps=4).y
    np.testing.assert_allclose(run.position[-1, :, 0], [2, -1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"restitution": 1.5}, "restitution must be from 0 to 1"),
        ({"friction": -0.1}, "friction must be from 0"),
        ({"radius": -1.0}, "radius must be from 0"),
        ({"pairs": [(0, 0)]}, "pairs must be different particles"),
        ({"pairs": [(0, 5)]}, "below 1"),
        ({"pairs": [(0.0, 1.0)]}, "integers"),
        ({"pairs": "close"}, 'or "near"'),
        ({"capacity": 4}, 'pairs="near" alone'),
        ({"max_bounces": 0}, "max_bounces"),
        ({"colliders": FLOOR}, "tuple"),
        ({"colliders": (Plane([0.0], [1.0]),)}, "Plane.point must have shape"),
        ({"colliders": (lambda t, p: p,)}, "one signed distance"),
        ({"colliders": (3.0,)}, r"colliders\[0\] must be a function"),
        ({"radius": [0.1, 0.2]}, "Collisions.radius must have shape"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        jeuler.simulate(
            jeuler.Scene(effects=(Collisions(**arguments),)), ball([0.0, 1.0], [0.0, 0.0]), dt=0.1, num_steps=1
        )
