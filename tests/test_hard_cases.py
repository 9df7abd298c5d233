"""Springs, masses, long runs and long horizons that break simulators: each must be finite and right."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.steps.explicit import cap_cotangent
from jeuler.steps.implicit import implicit_euler_step

DTYPES = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
EDGES = [[0, 1], [1, 2], [0, 2]]


def springs(rest_length=0.0, ks=7.0, kd=0.5, edges=EDGES):
    return jeuler.Springs(edges, ks=ks, kd=kd, rest_length=rest_length)


def force(part, position, velocity=None):
    return part(0.0, position, jnp.zeros_like(position) if velocity is None else velocity, jnp.asarray(1.0))


@functools.cache
def derivatives_of_linear_springs():
    """The Jacobian of their force, its derivative, and the Jacobian in reverse mode of a batch."""

    def of(x):
        return force(springs(), x)

    return jax.jit(jax.jacfwd(of)), jax.jit(jax.jacfwd(jax.jacrev(of))), jax.jit(jax.vmap(jax.jacrev(of)))


@DTYPES
@pytest.mark.parametrize("pair", [(0, 1), (1, 2), (0, 2)])
def test_coincident_ends_with_rest_length_zero(pair, dtype):
    """Force 0, Jacobian exactly that of linear springs, Hessian 0, for any one pair among many, and vmapped."""
    position = np.array([[0.0, 0.0], [1.0, 0.5], [-2.0, 1.0]], dtype)
    position[pair[1]] = position[pair[0]]
    laplacian = np.array([[2.0, -1.0, -1.0], [-1.0, 2.0, -1.0], [-1.0, -1.0, 2.0]])
    expected = -7.0 * np.einsum("ij,kl->ikjl", laplacian, np.eye(2))
    jacobian, second, of_batch = derivatives_of_linear_springs()
    np.testing.assert_array_equal(jacobian(position), expected)
    batch = np.stack([position, np.zeros_like(position)])
    np.testing.assert_array_equal(of_batch(batch), [expected] * 2)
    np.testing.assert_array_equal(second(position), 0)


@functools.cache
def derivatives_of_a_weighted_force():
    """The sum of the forces with fixed weights, its gradient with respect to everything, its Hessian in position."""

    def total(part, x, v):
        return jnp.sum(force(part, x, v) * np.array([[1.0, 2.0], [-3.0, 4.0], [5.0, 6.0]], x.dtype))

    return jax.jit(total), jax.jit(jax.grad(total, argnums=(0, 1, 2))), jax.jit(jax.hessian(total, argnums=1))


@DTYPES
@pytest.mark.parametrize("gap", [0.0, 1e-30, 1e-12])
def test_coincident_ends_with_rest_length_are_finite(gap, dtype):
    """At r = 0 the direction counts as 0: no force; the gradients with respect to everything are finite."""
    position = np.array([[0.0, 0.0], [gap, 0.0], [1.0, 1.0]], dtype)
    velocity = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]], dtype)
    value, gradient, hessian = derivatives_of_a_weighted_force()
    part = springs(rest_length=1.0)
    assert np.isfinite(value(part, position, velocity))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient(part, position, velocity)))
    assert np.isfinite(hessian(part, position, velocity)).all()


def test_very_stiff_next_to_very_soft():
    """1e8 : 1 in one chain between a wall and gravity: the soft one stretches by m g / ks, the stiff one does not."""
    chain = jeuler.Springs([[0, 1], [1, 2]], ks=jnp.array([1e8, 1.0]), kd=jnp.array([1e4, 2.0]), rest_length=1.0)
    state = jeuler.ParticleState([[0.0], [-1.0], [-2.0]], jnp.zeros((3, 1)), mass=[jnp.inf, 1.0, 1.0])
    scene = jeuler.Scene((jeuler.Gravity([-0.1]), chain))

    @jax.jit
    def end(ks):
        softer = jeuler.Scene((scene.forces[0], dataclasses.replace(chain, ks=ks)))
        run = jeuler.simulate(softer, state, dt=0.1, num_steps=500, step=implicit_euler_step, save_every=500)
        return run.y.position[-1, :, 0]

    np.testing.assert_allclose(end(chain.ks), [0.0, -1 - 0.2 / 1e8, -2 - 0.2 / 1e8 - 0.1], rtol=1e-9)
    jacobian = jax.jacrev(end)(chain.ks)
    np.testing.assert_allclose(jacobian[2], [0.2 / 1e16, 0.1], rtol=1e-5)


@pytest.mark.parametrize("step", [jeuler.symplectic_euler_step, implicit_euler_step])
def test_zero_stiffness_and_zero_damping_move_straight_with_finite_gradients(step):
    state = jeuler.ParticleState([[0.0, 0.0], [1.0, 0.0]], [[1.0, 2.0], [0.0, 0.0]])

    @jax.jit
    def end(parameters):
        scene = jeuler.Scene((jeuler.Springs([[0, 1]], *parameters),))
        return jeuler.simulate(scene, state, dt=0.1, num_steps=10, step=step).y.position[-1]

    parameters = (0.0, 0.0, 0.0)
    np.testing.assert_allclose(end(parameters), [[1.0, 2.0], [1.0, 0.0]], rtol=1e-12)
    h = 1e-6
    gradient = jax.jacrev(end)(parameters)
    difference = (end((h, 0.0, 0.0)) - end((-h, 0.0, 0.0))) / (2 * h)
    np.testing.assert_allclose(gradient[0], difference, rtol=1e-6)
    assert all(jnp.isfinite(g).all() for g in gradient)


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.symplectic_euler_step, implicit_euler_step])
def test_pinned_free_isolated_single_and_no_particles(step):
    """Both ends pinned; a free particle without spring; one particle; none."""
    state = jeuler.ParticleState(
        jnp.array([[0.0], [2.0], [5.0]]), jnp.array([[9.0], [0.0], [1.0]]), mass=[jnp.inf, jnp.inf, 1e-6]
    )
    scene = jeuler.Scene((springs(rest_length=1.0, edges=[[0, 1]]),))
    run = jeuler.simulate(scene, state, dt=0.5, num_steps=4, step=step)
    np.testing.assert_allclose(run.y.position[-1, :, 0], [0, 2, 7], rtol=1e-12)
    one = jeuler.ParticleState([[1.0]], [[2.0]])
    run = jeuler.simulate(jeuler.Scene(), one, dt=0.5, num_steps=4, step=step)
    np.testing.assert_allclose(run.y.position[-1], [[5.0]])
    none = jeuler.ParticleState(jnp.zeros((0, 2)), jnp.zeros((0, 2)))
    run = jeuler.simulate(jeuler.Scene(), none, dt=0.5, num_steps=4, step=step)
    assert run.y.position.shape == (5, 0, 2)
    assert run.first_nonfinite == -1


@pytest.mark.parametrize("step", [jeuler.symplectic_euler_step, implicit_euler_step])
def test_isolated_components_move_as_if_alone(step, random):
    """Two springs in one scene, one of them between pinned ends: values and gradients are those of each by itself."""
    position, velocity = jnp.asarray(random.normal(size=(2, 4, 2)))
    mass = jnp.array([1.0, 2.0, jnp.inf, jnp.inf])

    @jax.jit
    def end(x, v, ks):
        scene = jeuler.Scene((springs(0.3, ks, edges=[[0, 1], [2, 3]]),))
        return jeuler.simulate(scene, jeuler.ParticleState(x, v, mass), dt=0.05, num_steps=10, step=step).y.position[-1]

    alone = jeuler.Scene((springs(0.3, 7.0, edges=[[0, 1]]),))
    run = jeuler.simulate(
        alone, jeuler.ParticleState(position[:2], velocity[:2], mass[:2]), dt=0.05, num_steps=10, step=step
    )
    ks = jnp.array([7.0, 9.0])
    np.testing.assert_allclose(end(position, velocity, ks)[:2], run.y.position[-1], rtol=1e-8)
    np.testing.assert_array_equal(end(position, velocity, ks)[2:], position[2:])
    of_x, of_v, of_ks = jax.jit(jax.jacrev(end, argnums=(0, 1, 2)))(position, velocity, ks)
    np.testing.assert_array_equal(of_x[2:, :, 2:], jnp.eye(4).reshape(2, 2, 2, 2))  # pinned: they are where they were
    np.testing.assert_array_equal(of_v[2:], 0)
    np.testing.assert_array_equal(of_x[:2, :, 2:], 0)
    np.testing.assert_array_equal(of_ks[:2, :, 1], 0)
    assert jnp.max(jnp.abs(of_ks[:2, :, 0])) > 1e-4


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.symplectic_euler_step, implicit_euler_step])
def test_internal_forces_keep_momentum_to_roundoff(step, random):
    edges = [[i, j] for i in range(6) for j in range(i)]
    mass = jnp.asarray(random.uniform(0.5, 2, 6))
    state = jeuler.ParticleState(random.normal(size=(6, 2)), random.normal(size=(6, 2)), mass)
    scene = jeuler.Scene((springs(1.0, edges=edges),))
    run = jeuler.simulate(scene, state, dt=0.01, num_steps=100, step=step).y
    momentum = jnp.sum(mass[:, None] * run.velocity, axis=1)
    tolerance = 1e-13 if step is not implicit_euler_step else 1e-10  # Newton's tolerance
    np.testing.assert_allclose(momentum, jnp.broadcast_to(momentum[0], momentum.shape), atol=tolerance)
    if step is jeuler.symplectic_euler_step:  # the others change the angular momentum by O(dt)
        x, v = run.position, run.velocity
        spin = jnp.sum(mass * (x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0]), axis=1)
        np.testing.assert_allclose(spin, spin[0], rtol=1e-12)


def test_energy_never_rises_in_a_damped_scene_under_implicit_euler(random):
    """Five particles anywhere, every pair joined with rest length 0 (a convex energy); dt is 1000 times kd / ks."""
    edges = [[i, j] for i in range(5) for j in range(i)]
    scene = jeuler.Scene((springs(0.0, ks=1e4, kd=1.0, edges=edges), jeuler.Gravity([0.0, -9.81])))
    start = jnp.asarray(random.normal(size=(20, 2, 5, 2)))

    @jax.vmap
    def energies(motion):
        state = jeuler.ParticleState(motion[0], motion[1])

        def energy(t, state):
            return scene.energy(t, (state.position, state.velocity), state.mass)

        return jeuler.simulate(scene, state, dt=0.1, num_steps=60, step=implicit_euler_step, save=energy)

    run = jax.jit(energies)(start)
    assert jnp.all(run.first_nonfinite == -1)
    rise = jnp.diff(run.y, axis=1) / run.y[:, :1]
    assert jnp.max(rise) <= 1e-9  # Newton's tolerance


OSCILLATOR = jeuler.Scene((jeuler.Springs([[0, 1]], ks=1.0, kd=0.0, rest_length=0.0),))


def oscillator(dtype=jnp.float64, offset=0.0):
    x = jnp.array([[0.0], [1.0]], dtype) + jnp.asarray(offset, dtype)
    return jeuler.ParticleState(x, jnp.zeros((2, 1), dtype), jnp.array([jnp.inf, 1.0], dtype))


def test_symplectic_energy_error_stays_bounded_over_a_million_steps():
    """H' = (v^2 + x^2 - dt x v) / 2 is kept exactly, so the energy stays within dt/2 of it: no drift."""
    dt = 0.1

    def energy(t, state):
        return OSCILLATOR.energy(t, (state.position, state.velocity), state.mass)

    run = jeuler.simulate(
        OSCILLATOR, oscillator(), dt=dt, num_steps=10**6, save_every=100, save=energy, step=jeuler.symplectic_euler_step
    )
    relative = run.y / run.y[0]
    assert jnp.max(jnp.abs(relative - 1)) < dt / 2 / (1 - dt / 2)
    assert abs(jnp.mean(relative[-1000:]) - jnp.mean(relative[:1000])) < 1e-3


def test_explicit_euler_grows_as_the_formula_says():
    """|y_n|^2 = (1 + omega^2 dt^2)^n |y_0|^2."""
    dt, n = 0.1, 2000
    end = jeuler.simulate(OSCILLATOR, oscillator(), dt=dt, num_steps=n, save_every=n).y
    square = end.position[-1, 1, 0] ** 2 + end.velocity[-1, 1, 0] ** 2
    np.testing.assert_allclose(square, (1 + dt**2) ** n, rtol=1e-10)


def test_large_offset_in_float32():
    """An oscillator of 1 m at 1e6 m in float32: the grid there is 6 cm; it swings, and its gradient is finite."""

    @jax.jit
    def end(ks):
        scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=ks, kd=0.1, rest_length=0.0),))
        state = oscillator(jnp.float32, 1e6)
        step = jeuler.symplectic_euler_step
        run = jeuler.simulate(scene, state, dt=jnp.float32(0.2), num_steps=500, step=step, compensated=True)
        return run.y.position[:, 1, 0] - run.y.position[:, 0, 0], run.first_nonfinite

    swing, lost = end(jnp.float32(1.0))
    assert lost == -1
    exact, _ = jax.jit(lambda: (jeuler.simulate(
        jeuler.Scene((jeuler.Springs([[0, 1]], ks=1.0, kd=0.1, rest_length=0.0),)),
        oscillator(), dt=0.2, num_steps=500, step=jeuler.symplectic_euler_step,
    ).y.position[:, 1, 0], 0))()  # fmt: skip
    np.testing.assert_allclose(swing, exact, atol=0.3)
    assert np.isfinite(jax.jit(jax.jacrev(lambda ks: end(ks)[0][-1]))(jnp.float32(1.0)))


def test_ten_million_steps_in_float32_keep_the_clock():
    """2e7 > 2^24 steps of 0.05 s to t = 1e6 s: the time is n dt to the last bit, where an accumulated sum stops."""
    num_steps, dt = 2 * 10**7, np.float32(0.05)
    run = jax.jit(
        lambda y: jeuler.solve(lambda t, y, args: jnp.cos(t), y, dt=dt, num_steps=num_steps, save_every=num_steps // 2)
    )(jnp.float32(0.0))
    np.testing.assert_array_equal(run.t, np.float32([0, num_steps // 2, num_steps]) * dt)
    assert run.first_nonfinite == -1
    accumulated = np.cumsum(np.full(2**20, np.float32(1.0)) * np.float32(16.0), dtype=np.float32)[-1] + np.float32(0.05)
    assert accumulated == np.float32(16 * 2**20)  # what a running sum in float32 does at 2^24


def pendulum(num_steps, step, save_every=None):
    """The end of a double pendulum of stiff springs, chaotic, as a function of its first angle."""
    scene = jeuler.Scene((
        jeuler.Gravity([0.0, -9.81]),
        jeuler.Springs([[0, 1], [1, 2]], ks=2000.0, kd=0.0, rest_length=1.0),
    ))  # fmt: skip

    @jax.jit
    def end(angle):
        arm = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        position = jnp.stack([jnp.zeros(2), arm, 2 * arm])
        state = jeuler.ParticleState(position, jnp.zeros((3, 2)), mass=jnp.array([jnp.inf, 1.0, 1.0]))
        run = jeuler.simulate(scene, state, dt=2e-3, num_steps=num_steps, save_every=save_every or num_steps, step=step)
        return run.y.position[1:, 2, 0] if save_every else run.y.position[-1, 2, 0]

    return end


def test_pendulum_gradient_has_the_sign_of_finite_differences_until_the_horizon():
    """Double pendulum from 2.2 rad: in every half second up to 4 s derivative and difference agree to 1 %."""
    ends, h = pendulum(2000, jeuler.symplectic_euler_step, save_every=250), 1e-7
    difference = (ends(2.2 + h) - ends(2.2 - h)) / (2 * h)
    _, pull = jax.vjp(ends, 2.2)
    gradient = jax.vmap(pull)(jnp.eye(8))[0]
    np.testing.assert_array_equal(jnp.sign(gradient), jnp.sign(difference))
    np.testing.assert_allclose(gradient, difference, rtol=1e-2)


@pytest.mark.optimised
def test_capped_cotangent_bounds_the_gradient_of_a_chaotic_run():
    free = pendulum(10000, jeuler.symplectic_euler_step)
    capped = pendulum(10000, cap_cotangent(jeuler.symplectic_euler_step, 2.0))
    assert capped(2.2) == free(2.2)
    assert abs(jax.grad(free)(2.2)) > 1e3
    assert abs(jax.grad(capped)(2.2)) <= 2.0 * 3
    loose = pendulum(200, cap_cotangent(jeuler.symplectic_euler_step, 1e9))
    expected = jax.grad(pendulum(200, jeuler.symplectic_euler_step))(2.2)
    np.testing.assert_allclose(jax.grad(loose)(2.2), expected, rtol=1e-12)  # the two programs round apart


def test_cap_must_be_positive():
    with pytest.raises(ValueError, match="max_norm"):
        cap_cotangent(jeuler.euler_step, 0.0)


def test_nothing_that_was_passed_is_modified(random):
    position, velocity = random.normal(size=(3, 2)), random.normal(size=(3, 2))
    edges, ks, mass = np.array(EDGES), np.full(3, 7.0), np.array([1.0, np.inf, 2.0])
    point, radius, alive = np.zeros(2), np.full(3, 0.1), np.array([True, False, True])
    passed = (position, velocity, edges, ks, mass, point, radius, alive)
    copies = [x.copy() for x in passed]
    floor = jeuler.Collisions((jeuler.Plane(point, [0.0, 1.0]),), radius=radius, restitution=1.0)
    scene = jeuler.Scene((jeuler.Springs(edges, ks=ks, kd=0.0, rest_length=0.0),), (floor,))
    state = jeuler.ParticleState(position, velocity, mass, alive=alive)
    for step in (jeuler.euler_step, implicit_euler_step):
        jeuler.simulate(scene, state, dt=0.1, num_steps=3, step=step)
    jax.jit(lambda s: jeuler.simulate(scene, s, dt=0.1, num_steps=3).y)(state)
    for before, after in zip(copies, passed, strict=True):
        np.testing.assert_array_equal(before, after)
