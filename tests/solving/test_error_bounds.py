"""What the theory of Euler's method promises, held against runs: the cumulative bound, and classical examples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

import jeuler

# f, y0, b, exact y on [0, b], Lipschitz constant L of f in y, bound M of |y''|
PROBLEMS = {
    "decay": (lambda t, y, args: -3 * y, 1.0, 2.0, lambda t: np.exp(-3 * t), 3.0, 9.0),
    "growth": (lambda t, y, args: y, 1.0, 1.0, lambda t: np.exp(t), 1.0, np.e),
    "linear in x and y": (
        lambda t, y, args: t + y / 5,
        -3.0,
        5.0,
        lambda t: 22 * np.exp(t / 5) - 5 * t - 25,
        0.2,
        22 / 25 * np.e,
    ),
    "gaussian": (
        lambda t, y, args: jnp.exp(-(t**2)),
        0.0,
        2.0,
        lambda t: np.sqrt(np.pi) / 2 * erf(t),
        0.0,
        np.sqrt(2 / np.e),
    ),
    "forced": (
        lambda t, y, args: jnp.cos(t) - 2 * (y - jnp.sin(t)),
        0.5,
        3.0,
        lambda t: np.sin(t) + 0.5 * np.exp(-2 * t),
        2.0,
        3.0,
    ),
    "hyperbola": (lambda t, y, args: -(y**2), 1.0, 3.0, lambda t: 1 / (1 + t), 2.0, 2.0),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_cumulative_error_is_below_its_bound_at_every_step_over_four_decades(name):
    """|y_i - y(t_i)| <= C h for all i, with C = M / (2 L) (exp(L (b - a)) - 1), or M (b - a) / 2 where L = 0."""
    f, y0, b, exact, lipschitz, second = PROBLEMS[name]
    constant = second / 2 * (np.expm1(lipschitz * b) / lipschitz if lipschitz else b)
    for num_steps in (10, 100, 1000, 10_000, 100_000):
        h = b / num_steps
        run = jeuler.solve(f, y0, dt=h, num_steps=num_steps)
        error = np.abs(np.asarray(run.y) - exact(np.asarray(run.t)))
        assert np.all(error <= constant * h)
        assert error.max() > 5e-4 * constant * h  # the bound says something


def test_integral_without_elementary_antiderivative_is_the_error_function():
    field = lambda t, y, args: jnp.exp(-(t**2))  # noqa: E731
    exact = np.sqrt(np.pi) / 2 * erf(np.linspace(0, 2, 5))
    for step, tolerance in ((jeuler.euler_step, 3e-4), (jeuler.heun_step, 1e-7), (jeuler.rk4_step, 1e-12)):
        run = jeuler.solve(field, 0.0, dt=2 / 4000, num_steps=4000, step=step, save_every=1000)
        np.testing.assert_allclose(run.y, exact, atol=tolerance)
        assert np.abs(run.y[2] - exact[2]) > 0 or step is jeuler.rk4_step


def test_source_example_at_three_step_sizes_beside_the_exact_curve():
    """y' = x + y / 5, y(0) = -3, to x = 5: the end values are those of the recursion done by hand."""
    field, exact = PROBLEMS["linear in x and y"][0], PROBLEMS["linear in x and y"][3]
    errors = []
    for h in (1.0, 0.2, 0.02):
        num_steps = round(5 / h)
        run = jeuler.solve(field, -3.0, dt=h, num_steps=num_steps)
        y = -3.0
        for n in range(num_steps):
            y = y + h * (n * h + y / 5)
        assert float(run.y[-1]) == pytest.approx(y, rel=1e-12)
        errors.append(exact(5.0) - y)
    np.testing.assert_allclose(
        jeuler.solve(field, -3.0, dt=1.0, num_steps=5).y, [-3, -3.6, -3.32, -1.984, 0.6192, 4.74304]
    )
    assert errors[0] > errors[1] > errors[2] > 0
    assert errors[1] / errors[2] == pytest.approx(10, rel=0.15)


def test_neighbours_of_a_solution_run_away_from_it_as_exp():
    """y' = y + (11/8) exp(-t/3): y = c exp(t) - (33/32) exp(-t/3); the error of a run at c = 0 grows as exp(t)."""
    field = lambda t, y, args: y + 11 / 8 * jnp.exp(-t / 3)  # noqa: E731
    exact = lambda c, t: c * np.exp(t) - 33 / 32 * np.exp(-t / 3)  # noqa: E731
    t = np.linspace(0.0, 8.0, 9)
    for c in (0.1, -0.1, 0.0):
        slope = c * np.exp(t) + 11 / 32 * np.exp(-t / 3)
        np.testing.assert_allclose(jax.vmap(lambda t, y: field(t, y, None))(t, exact(c, t)), slope, rtol=1e-12)
        run = jeuler.solve(field, exact(c, 0.0), dt=1 / 256, num_steps=8 * 256, step=jeuler.rk4_step, save_every=256)
        np.testing.assert_allclose(run.y, exact(c, t), rtol=1e-5, atol=1e-6)
    run = jeuler.solve(field, exact(0.0, 0.0), dt=1 / 256, num_steps=8 * 256, save_every=256)
    error = np.abs(np.asarray(run.y) - exact(0.0, t))
    assert error[-1] / error[-2] == pytest.approx(np.e, rel=0.02)
