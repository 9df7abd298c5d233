"""Implicit steps: the values of exact solutions, derivatives in every mode, stiff problems, the stiff cloth."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_scenes import cloth, cloth_scene
from published import published

import jeuler
from jeuler._jax.haste import jit_in_haste
from jeuler.steps.implicit import implicit_euler, implicit_euler_step, linearly_implicit_euler_step

STEPS = [implicit_euler_step, linearly_implicit_euler_step]
BY_NAME = pytest.mark.parametrize("step", STEPS, ids=lambda step: step.__name__)


def stiff_field(t, y, a):
    return -a * (y**3 - jnp.cos(t))


def stiff_end(step, num_steps=10):
    def end(a):
        y0 = jnp.array([1.0, 2.0])
        solution = jeuler.solve(stiff_field, y0, dt=0.1, num_steps=num_steps, args=a, step=step)
        return jnp.sum(solution.y[-1] ** 2)

    return end


@BY_NAME
def test_linear_system_equals_matrix_solve(step):
    matrix = jnp.array([[-3.0, 2.0, 0.0], [1.0, -1000.0, 5.0], [0.0, 7.0, -2.0]])
    y = jnp.array([1.0, -2.0, 3.0])
    end = step(lambda t, y, args: matrix @ y + t, 0.5, y, 0.25, None)
    np.testing.assert_allclose(end, np.linalg.solve(np.eye(3) - 0.25 * matrix, y + 0.25 * 0.75), rtol=1e-12)


@BY_NAME
def test_pair_is_reduced_to_velocity_with_the_same_result(step):
    """(position, velocity) as a pair and as one vector: two ways to solve one equation."""

    def pair(t, y, k):
        return y[1], -k * y[0] ** 3 - 0.1 * y[1] * jnp.abs(y[0])

    def vector(t, y, k):
        return jnp.stack(pair(t, (y[0], y[1]), k))

    x, v = step(pair, 0.0, (1.0, 0.3), 0.1, 400.0)
    np.testing.assert_allclose(jnp.stack([x, v]), step(vector, 0.0, jnp.array([1.0, 0.3]), 0.1, 400.0), rtol=1e-9)


def test_a_pair_whose_slope_of_position_uses_position_is_not_reduced():
    def field(t, y, k):
        return y[1] - y[0] ** 2, -k * y[0]

    x, v = implicit_euler_step(field, 0.0, (1.0, 0.3), 0.1, 400.0)
    slope = field(0.1, (x, v), 400.0)
    np.testing.assert_allclose([x, v], [1.0 + 0.1 * slope[0], 0.3 + 0.1 * slope[1]], rtol=1e-9)


@BY_NAME
def test_complex_state(step):
    y0 = {"z": jnp.array(1.0 + 2.0j)}
    y = step(lambda t, y, args: {"z": (1j - 2) * y["z"]}, 0.0, y0, 0.5, None)
    np.testing.assert_allclose(y["z"], (1 + 2j) / (1 - 0.5 * (1j - 2)), rtol=1e-10)


@BY_NAME
def test_derivatives_in_every_mode_equal_finite_differences(step):
    end = stiff_end(step)
    value = jit_in_haste(end, "great")
    gradient = jit_in_haste(jax.grad(end), "great")
    a, h = 50.0, 1e-3
    difference = (value(a + h) - value(a - h)) / (2 * h)
    np.testing.assert_allclose(gradient(a), difference, rtol=1e-5)
    np.testing.assert_allclose(jit_in_haste(jax.jacfwd(end), "great")(a), difference, rtol=1e-5)
    second = (gradient(a + h) - gradient(a - h)) / (2 * h)
    for twice in (jax.hessian(end), jax.grad(jax.grad(end)), jax.jacfwd(jax.jacfwd(end))):
        np.testing.assert_allclose(jit_in_haste(twice, "great")(a), second, rtol=1e-5)
    batch = np.array([1.0, 50.0, 100.0])
    np.testing.assert_allclose(
        jit_in_haste(jax.vmap(jax.grad(end)), "great")(batch), [gradient(a) for a in batch], rtol=1e-9
    )


def test_gradient_equals_that_of_the_unrolled_newton_iteration():
    def unrolled_step(f, t, y, dt, args):
        def residual(z):
            return z - y - dt * f(t + dt, z, args)

        z = y
        for _ in range(12):
            z = z - jnp.linalg.solve(jax.jacfwd(residual)(z), residual(z))
        return z

    gradient, expected = (
        jit_in_haste(jax.grad(stiff_end(step)), "great")(50.0) for step in (implicit_euler_step, unrolled_step)
    )
    np.testing.assert_allclose(gradient, expected, rtol=1e-8)


def test_reverse_mode_costs_one_linear_solve_a_step():
    def loss(y):
        return jnp.sum(implicit_euler_step(stiff_field, 0.0, y, 0.1, 50.0))

    forward = str(jax.make_jaxpr(implicit_euler_step, static_argnums=0)(stiff_field, 0.0, jnp.ones(2), 0.1, 50.0))
    _, pullback = jax.vjp(loss, jnp.ones(2))
    backward = str(jax.make_jaxpr(pullback)(1.0))
    assert forward.count("root[") == 1
    assert backward.count("custom_linear_solve[") == 1
    assert "while" not in backward.split("custom_linear_solve[")[0]


def test_step_that_does_not_converge_is_named():
    """y = 1 + 100 dt exp(y) has no solution."""
    step = implicit_euler_step
    growth = jeuler.solve(lambda t, y, k: k * jnp.exp(y), 1.0, dt=1e-3, num_steps=500, args=1.0, step=step)
    step = int(growth.first_nonfinite)
    assert 300 < step < 400  # y' = exp(y) from 1 ends at t = exp(-1) = 0.368
    assert jnp.isfinite(growth.y[step - 1])
    assert jnp.isnan(growth.y[step])
    _, info = implicit_euler_step.with_info(lambda t, y, k: k * jnp.exp(y), 0.0, 1.0, 1.0, 100.0)
    assert not info.converged


def test_gradient_through_a_step_that_does_not_converge_is_not_finite():
    def loss(k):
        return implicit_euler_step(lambda t, y, k: k * jnp.exp(y), 0.0, 1.0, 1.0, k)

    assert not jnp.isfinite(jax.grad(loss)(100.0))


def crushed_nets(count):
    """Ten particles in space, every pair joined by a spring of 1 m, crushed into centimetres."""
    scene = jeuler.Scene((jeuler.Springs([(i, j) for i in range(10) for j in range(i)], 1e4, 100.0, 1.0),))
    position = 0.02 * jnp.stack([np.random.default_rng(seed).normal(size=(10, 3)) for seed in range(count)])
    return scene, position, jnp.zeros_like(position)


def test_crushed_nets_that_newtons_method_alone_does_not_solve():
    """dt = 0.05 s, five times the explicit limit: what comes out solves the equation, and the energy has fallen."""
    scene, position, velocity = crushed_nets(10)
    solved = {}
    for damped_steps in (0, 500):
        step = implicit_euler(damped_steps=damped_steps)
        one = jax.vmap(lambda x, v, step=step: step.with_info(scene.vector_field, 0.0, (x, v), 0.05, 1.0))
        (x, v), info = jit_in_haste(one, "some")(position, velocity)
        solved[damped_steps] = int(jnp.sum(info.converged))
        np.testing.assert_array_equal(jnp.isfinite(x).all(axis=(1, 2)), info.converged)
    assert solved[0] <= 2
    assert solved[500] >= 9
    energy = jax.jit(jax.vmap(lambda x, v: scene.energy(0.0, (x, v), 1.0)))
    slope_of = jax.jit(jax.vmap(lambda x, v: scene.vector_field(0.0, (x, v), 1.0)[1]))
    done = np.asarray(info.converged)
    np.testing.assert_allclose(np.asarray(v)[done], 0.05 * np.asarray(slope_of(x, v))[done], atol=1e-6)
    assert np.all((energy(x, v) < 0.5 * energy(position, velocity))[done])


def test_damped_iterations_leave_alone_what_newtons_method_solves():
    alone, helped = (
        implicit_euler(damped_steps=n).with_info(stiff_field, 0.0, jnp.ones(2), 0.1, 50.0) for n in (0, 500)
    )
    np.testing.assert_array_equal(alone[0], helped[0])
    assert alone[1].iterations == helped[1].iterations


def test_iterations_are_few_and_limited():
    _, info = implicit_euler_step.with_info(stiff_field, 0.0, jnp.ones(2), 0.1, 50.0)
    assert info.converged
    assert int(info.iterations) <= 6
    _, info = implicit_euler(max_steps=1, damped_steps=0).with_info(stiff_field, 0.0, jnp.ones(2), 0.1, 50.0)
    assert not info.converged
    assert int(info.iterations) == 1


@pytest.mark.parametrize("bad", [{"rtol": 0.0}, {"atol": -1.0}, {"max_steps": 0}, {"damped_steps": -1}])
def test_bad_options(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        implicit_euler(**bad)


STIFF = {  # steps; where explicit Euler overflows at the same number of steps
    "DETEST_stiff_A2": (500, True),
    "DETEST_stiff_B5": (500, False),
    "DETEST_stiff_C1": (500, True),
    "DETEST_stiff_D2": (1000, True),
    "DETEST_stiff_E2": (4000, False),
    "MAZZIA_HIRES": (8000, True),
    "MAZZIA_ROBER": (2000, True),
}


@pytest.mark.parametrize("name", STIFF)
def test_stiff_problems_run_to_the_end_with_first_order_error(name):
    f, y0, _, t1, reference = published(name)

    def end(step, num_steps):
        return jeuler.solve(f, y0, dt=t1 / num_steps, num_steps=num_steps, save_every=num_steps, step=step)

    steps, explicit_overflows = STIFF[name]
    errors = []
    for num_steps in (steps, 2 * steps):
        solution = end(implicit_euler_step, num_steps)
        assert solution.first_nonfinite == -1
        errors.append(np.linalg.norm(solution.y[-1] - reference) / np.linalg.norm(reference))
    assert 1.6 < errors[0] / errors[1] < 2.6
    explicit = end(jeuler.euler_step, steps)
    assert explicit_overflows == (int(explicit.first_nonfinite) > 0)


@functools.cache
def explicit_limit(n, ks, kd):
    """2 zeta / omega of a cloth's stiffest mode, by power iteration on the stiffness and the damping."""
    scene, state = cloth_scene(n, ks, kd), cloth(n)
    free = np.isfinite(state.mass)[:, None]

    def acceleration(position, velocity):
        return scene.vector_field(0.0, (position, velocity), state.mass)[1]

    @jax.jit
    def stiffness_and_damping(u):
        stiffness = jax.jvp(lambda x: acceleration(x, state.velocity), (state.position,), (u,))[1]
        return stiffness, jax.jvp(lambda v: acceleration(state.position, v), (state.velocity,), (u,))[1]

    u = np.random.default_rng(0).normal(size=state.position.shape) * free
    for _ in range(60):
        stiffness, _ = map(np.asarray, stiffness_and_damping(u))
        omega_squared = np.linalg.norm(stiffness)
        u = stiffness / omega_squared
    return np.linalg.norm(stiffness_and_damping(u)[1]) / omega_squared


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@BY_NAME
def test_cloth_at_a_hundred_times_the_explicit_limit(step, dtype):
    """32 x 32 particles, waving: dt = 1e-3 where explicit Euler needs dt < 1e-5; the energy falls."""
    state = cloth(32, dtype=dtype)
    scene = cloth_scene(32, ks=2000.0, kd=0.01)
    if dtype == jnp.float64:
        assert explicit_limit(32, ks=2000.0, kd=0.01) < 1e-5

    def energy(t, state):
        return scene.energy(t, (state.position, state.velocity), state.mass)

    run = jit_in_haste(
        lambda state: jeuler.simulate(scene, state, dt=1e-3, num_steps=4, step=step, save=energy), "great"
    )
    solution = run(state)
    assert solution.first_nonfinite == -1
    assert solution.y.dtype == dtype
    assert np.all(np.diff(solution.y) < 0)


@BY_NAME
def test_cloth_gradients_with_respect_to_ks_and_kd(step):
    """At a hundred times the explicit limit, on 10 x 10 particles: more unknowns than the dense solver takes."""
    state = cloth(10)

    def end_of(parameters):
        scene = cloth_scene(10, *parameters)
        end = jeuler.simulate(scene, state, dt=1e-3, num_steps=2, save_every=2, step=step)
        return jnp.sum(end.y.position[-1] ** 2)

    value, value_and_gradient = (jit_in_haste(f, "great") for f in (end_of, jax.value_and_grad(end_of)))
    parameters, h = jnp.array([2000.0, 0.01]), jnp.array([1.0, 1e-4])
    _, gradient = value_and_gradient(parameters)
    for k in range(2):
        change = jnp.zeros(2).at[k].set(h[k])
        above, below = value(parameters + change), value(parameters - change)
        np.testing.assert_allclose(gradient[k], (above - below) / (2 * h[k]), rtol=1e-5)
