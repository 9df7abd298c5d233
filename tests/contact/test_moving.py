"""Surfaces that move and accelerate: what they carry and push stays on them, what they leave flies, and lands again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Box, Collisions, Plane, SampledPath, Sphere
from jeuler.contact.colliders import moves

STEPS = {
    "euler": jeuler.euler_step,
    "symplectic": jeuler.symplectic_euler_step,
    "RK4": jeuler.rk4_step,
    "midpoint": jeuler.implicit_midpoint_step,
    "implicit": jeuler.implicit_euler_step,
    "linearly implicit": jeuler.linearly_implicit_euler_step,
}
UP, DT, NUM_STEPS = np.array([0.0, 1.0]), 0.02, 40
TIMES = np.linspace(0.0, 1.0, 11)


def lift(acceleration):
    """A floor that goes a t^2 / 2 upwards from rest."""
    return Plane(SampledPath(TIMES, acceleration * TIMES[:, None] ** 2 / 2 * UP), UP)


def carried(step, dtype, balls, gravity, acceleration, restitution, above, sideways=0.0):
    """The gaps between the balls and a lift that they stand on, above each other, and the whole run."""
    contact = Collisions(
        (lift(acceleration),), [(k, k + 1) for k in range(balls - 1)], 0.1, restitution=restitution, friction=0.3
    )
    position = (0.1 + 0.2 * jnp.arange(balls, dtype=dtype) + above)[:, None] * UP.astype(dtype)
    velocity = jnp.zeros_like(position).at[:, 0].set(sideways)
    scene = jeuler.Scene((jeuler.Gravity(gravity * UP),), (contact,))
    state = jeuler.ParticleState(position, velocity)
    run = jeuler.simulate(scene, state, dt=DT, num_steps=NUM_STEPS, step=step)
    height = acceleration * run.t**2 / 2
    return run.y.position[..., 1] - height[:, None] - 0.1 - 0.2 * jnp.arange(balls), run


ROWS = [(name, 1, dtype) for name in STEPS for dtype in (np.float64, np.float32)]
ROWS += [("symplectic", 3, np.float64), ("linearly implicit", 3, np.float64), ("euler", 3, np.float32)]


@pytest.mark.parametrize(("name", "balls", "dtype"), ROWS)
def test_a_lift_carries_what_stands_on_it(name, balls, dtype):
    """With gravity or pushed by the lift alone; touching, pressed in by a hair, and one ball that much above."""
    cases = [(g, a, e) for g in (0.0, -9.8) for a in (2.0, -2.0, 0.5) for e in (0.0, 0.5, 1.0) if a > 0 or g < 0]
    above = [0.0, -1e-6] if balls > 1 else [0.0, -1e-6, 1e-6]  # a stack that lands may bounce
    numbers = jnp.array([(*case, h) for case in cases for h in above], dtype)

    with jax.enable_x64(dtype == np.float64):
        gap, run = jax.jit(jax.vmap(lambda n: carried(STEPS[name], dtype, balls, *n)))(numbers)
    rounding = {np.float64: 1e-12, np.float32: 4e-6}[dtype]
    still = numbers[:, 3] != 1e-6  # what is above the lift lands on it
    assert (np.abs(gap[:, 3:]).max(axis=(1, 2)) <= np.where(still, rounding, 1e-5)).all()
    speed = numbers[:, 1, None, None] * run.t[..., None]
    error = np.abs(run.y.velocity[..., 1] - speed)[:, 3:].max(axis=(1, 2))
    assert (error <= np.where(still, 100 * rounding, 1e-3)).all()
    np.testing.assert_array_equal(run.unresolved_contacts, 0)


@pytest.mark.parametrize("name", STEPS)
def test_what_a_wall_pushes_rubs_on_it_and_has_the_derivatives_of_that(name):
    """Along a wall that pushes with m a a ball slows by friction a, as long as it slides: v t - friction a t^2 / 2."""

    def way(speed, acceleration):
        _, run = carried(STEPS[name], np.float64, 1, 0.0, acceleration, 0.0, 0.0, speed)
        return run.y.position[-1, 0, 0]

    speed, acceleration, time = 1.0, 2.0, NUM_STEPS * DT
    value, slopes = jax.jit(jax.value_and_grad(way, argnums=(0, 1)))(speed, acceleration)
    forward = jax.jit(jax.jacfwd(way, argnums=(0, 1)))(speed, acceleration)
    np.testing.assert_allclose(slopes, forward, rtol=1e-9)
    first_order = 0.3 * acceleration * time * DT / 2
    np.testing.assert_allclose(value, speed * time - 0.3 * acceleration * time**2 / 2, atol=1.01 * first_order)
    np.testing.assert_allclose(slopes[0], time, rtol=1e-9)
    np.testing.assert_allclose(slopes[1], -0.3 * time**2 / 2, atol=1.01 * first_order / acceleration)


SURFACES = {  # heights as functions of the time, and the speed of what stands on them at 0.4 s
    "starts at the end of a step": (lambda t: jnp.maximum(t - 0.1, 0), 1.0),
    "starts within a step": (lambda t: jnp.maximum(t - 0.11, 0), 1.0),
    "goes at one speed": (lambda t: 0.5 * t, 0.5),
    "is at one place": (lambda t: 0 * t, 0.0),
    "is elsewhere at once": (lambda t: jnp.where(t > 0.105, 0.05, 0.0), 0.0),
}


@pytest.mark.parametrize("name", ["symplectic", "RK4", "implicit"])
def test_surfaces_as_people_write_them(name):
    """As a function of one's own or a plane whose point is one; as particles of a pool; with restitution and without."""
    for height, speed in SURFACES.values():
        plane = Plane(lambda t, height=height: height(t) * jnp.array([0.0, 1.0]), UP)
        for surface in (plane, lambda t, p, height=height: p[1] - height(t)):
            for restitution, alive in ((0.0, None), (0.5, jnp.array([False, True]))):
                contact = Collisions((surface,), radius=0.1, restitution=restitution)
                position = jnp.array([[0.0, 0.1]] * (1 if alive is None else 2))
                velocity = jnp.zeros_like(position).at[-1, 1].set(jax.grad(height)(0.0))
                state = jeuler.ParticleState(position, velocity, alive=alive)
                scene = jeuler.Scene((jeuler.Gravity(-9.8 * UP),), (contact,))
                run = jeuler.simulate(scene, state, dt=DT, num_steps=20, step=STEPS[name])
                gap = run.y.position[:, -1, 1] - 0.1 - jax.vmap(height)(run.t)
                np.testing.assert_allclose(gap, 0, atol=1e-12)
                np.testing.assert_allclose(run.y.velocity[-1, -1, 1], speed, atol=1e-12)
                assert run.unresolved_contacts == 0


def test_a_lift_carries_many_that_find_each_other_to_first_order():
    row = 0.2 * np.arange(40.0)
    position = np.stack([np.append(row, row[:10]), np.append(np.full(40, 0.1), np.full(10, 0.3))], axis=1)
    contact = Collisions((lift(2.0),), "near", 0.1, restitution=0.3, friction=0.3)
    scene = jeuler.Scene((jeuler.Gravity(-9.8 * UP),), (contact,))
    state = jeuler.ParticleState(position, 0 * position)
    for dt in (DT, DT / 2):
        run = jeuler.simulate(scene, state, dt=dt, num_steps=round(0.4 / dt), step=jeuler.symplectic_euler_step)
        gap = run.y.position[..., 1] - position[:, 1] - run.t[:, None] ** 2
        assert np.abs(gap).max() <= 2.0 * dt**2 / 2 + 1e-6  # by what the lift gains in a step, and the iterations leave
        assert run.unresolved_contacts == 0


def test_what_a_lift_leaves_behind_stays_where_it_is():
    gap, run = carried(jeuler.symplectic_euler_step, np.float64, 1, 0.0, -2.0, 0.5, 0.0)
    np.testing.assert_array_equal(run.y.position, np.broadcast_to([0.0, 0.1], run.y.position.shape))
    assert (np.diff(gap[:, 0]) > 0).all()


def on_a_shaken_table(amplitude, rate, duration, parts=360_000):
    """The height above it of what falls with 9.8 m/s^2 on a table at A sin(w t), and does not bounce, by tiny steps."""
    h, y, v, heights = duration / parts, 0.0, amplitude * rate, [0.0]
    table = amplitude * np.sin(rate * h * np.arange(1, parts + 1))
    speed = amplitude * rate * np.cos(rate * h * np.arange(1, parts + 1))
    for top, up in zip(table, speed, strict=True):
        y, v = y + h * v - 4.9 * h * h, v - 9.8 * h
        if y <= top:
            y, v = top, max(v, up)
        heights.append(y)
    return np.array(heights)


@pytest.mark.parametrize("name", ["symplectic", "RK4", "implicit"])
def test_a_shaken_table_throws_and_catches(name):
    """It falls away faster than gravity pulls; errors fall with the step."""
    amplitude, rate, duration = 0.01, 40.0, 0.36
    table = Plane(lambda t: amplitude * jnp.sin(rate * t) * jnp.array([0.0, 1.0]), [0.0, 1.0])
    scene = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (Collisions((table,)),))
    state = jeuler.ParticleState([[0.0, 0.0]], [[0.0, amplitude * rate]])
    exact, errors = on_a_shaken_table(amplitude, rate, duration), []
    for num_steps in (90, 360):
        run = jeuler.simulate(scene, state, dt=duration / num_steps, num_steps=num_steps, step=STEPS[name])
        errors.append(np.abs(run.y.position[:, 0, 1] - exact[:: len(exact) // num_steps]).max())
        assert run.unresolved_contacts == 0
    gap = run.y.position[:, 0, 1] - amplitude * np.sin(rate * run.t)
    assert gap.max() > 3e-3
    assert errors[0] < 2e-3
    assert errors[1] < 0.4 * errors[0]


def test_which_colliders_move():
    path = SampledPath([0.0, 1.0], [[0.0, 0.0], [1.0, 0.0]])
    still = Plane([0.0, 0.0], UP), Sphere([0.0, 0.0], 1.0), Box([0.0, 0.0], 1.0), lambda t, p: p[1]
    moving = Plane(path, UP), Sphere(path, 1.0), Box(path, 1.0), lambda t, p: p[1] - jnp.sin(t)
    assert [moves(collider, 2) for collider in (*still, *moving)] == [False] * 4 + [True] * 4
