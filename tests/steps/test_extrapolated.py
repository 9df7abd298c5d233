"""Extrapolated Euler: order, error estimate, stiff base steps, and the adaptive run with its derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jeuler
from jeuler.solving._adaptive import solve_adaptive
from jeuler.steps.extrapolated import Lanes, extrapolated_euler
from jeuler.steps.implicit import linearly_implicit_euler_step


def van_der_pol(t, y, mu):
    return y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]


START = jnp.array(2.0), jnp.array(0.0)


def published(mu, t1):
    run = solve_ivp(lambda t, y: van_der_pol(t, y, mu), (0, t1), [2.0, 0.0], method="LSODA", rtol=1e-12, atol=1e-13)
    return run.y[:, -1]


@pytest.mark.parametrize("order", [1, 2, 3, 4, 6])
def test_cumulative_error_has_the_order_asked_for(order):
    field = lambda t, y, args: -t * y**2  # noqa: E731

    def error(n):
        run = jeuler.solve(field, 1.0, dt=3.0 / n, num_steps=n, step=extrapolated_euler(order), save_every=n)
        return abs(float(run.y[-1]) - 1 / 5.5)

    coarse = {1: 1024, 2: 512, 3: 128, 4: 128, 6: 32}[order]
    assert np.log2(error(coarse) / error(2 * coarse)) == pytest.approx(order, abs=0.1)


def test_rows_are_the_base_step_in_j_substeps():
    order, dt = 5, 0.3
    rows, _ = extrapolated_euler(order).rows(van_der_pol, 0.5, START, dt, 3.0)
    for j in range(1, order + 1):
        y = START
        for i in range(j):
            y = jeuler.euler_step(van_der_pol, 0.5 + i * dt / j, y, dt / j, 3.0)
        np.testing.assert_allclose(
            [row[j - 1] for row in rows], [a - b for a, b in zip(y, START, strict=True)], rtol=1e-12
        )


@pytest.mark.parametrize("order", range(1, 13))
def test_lanes_do_each_row_once(order):
    lanes = Lanes.of(order)
    assert lanes.fresh.sum() == order
    ends = set(zip(lanes.end.tolist(), lanes.lane.tolist(), strict=True))
    assert len(ends) == order
    for row in range(1, order + 1):
        end, lane = lanes.end[row - 1], lanes.lane[row - 1]
        np.testing.assert_allclose(lanes.length[end - row + 1 : end + 1, lane], 1 / row)
        np.testing.assert_allclose(lanes.start[end - row + 1 : end + 1, lane], np.arange(row) / row)


def test_of_euler_it_is_the_explicit_method_of_its_order():
    """k stages and order k on a linear problem: the exponential series up to dt^k."""
    y = extrapolated_euler(5)(lambda t, y, args: y, 0.0, jnp.array(1.0), 0.7, None)
    assert float(y) == pytest.approx(sum(0.7**k / np.prod(range(1, k + 1)) for k in range(6)), rel=1e-13)


def test_error_estimate_bounds_the_error_of_a_step():
    step, dt = extrapolated_euler(4), 0.2
    increment, estimate = step.increment_with_error(van_der_pol, 0.0, START, dt, 1.0)
    exact = published(1.0, dt)
    error = np.hypot(*(float(y + d) - e for y, d, e in zip(START, increment, exact, strict=True)))
    size = np.hypot(*map(float, estimate))
    assert error < size < 300 * error


def test_linearly_implicit_rows_solve_a_stiff_problem_that_explicit_ones_cannot():
    mu, t1, n = 1000.0, 0.5, 40
    exact = published(mu, t1)

    def final(step):
        run = jeuler.solve(van_der_pol, START, dt=t1 / n, num_steps=n, args=mu, step=step, save_every=n)
        return np.array([float(leaf[-1]) for leaf in run.y])

    implicit = final(extrapolated_euler(4, step=linearly_implicit_euler_step))
    assert np.linalg.norm(implicit - exact) / np.linalg.norm(exact) < 1e-7
    explicit = final(extrapolated_euler(4))
    assert not np.linalg.norm(explicit - exact) < 1


def test_adaptive_run_meets_its_tolerance_and_agrees_with_lsoda():
    times = [2.0, 5.0, 10.0]
    run = jax.jit(
        lambda tolerance: solve_adaptive(van_der_pol, START, t1=times, args=3.0, rtol=tolerance, atol=tolerance)
    )
    errors = []
    for tolerance in (1e-4, 1e-7, 1e-10):
        found = run(tolerance)
        assert bool(found.finished)
        np.testing.assert_array_equal(found.t, [0.0, *times])
        errors.append(max(abs(float(found.y[0][i]) - published(3.0, t)[0]) for i, t in enumerate(times, start=1)))
    assert errors[0] < 1e-2
    assert errors[1] < 1e-5
    assert errors[2] < 1e-8


@pytest.mark.optimised
def test_derivatives_of_an_adaptive_run_agree_with_diffrax_in_both_modes():
    def final(mu):
        return solve_adaptive(van_der_pol, START, t1=4.0, args=mu, rtol=1e-10, atol=1e-10, max_steps=2048).y[0][-1]

    def final_diffrax(mu):
        control = diffrax.PIDController(rtol=1e-11, atol=1e-11)
        term, solver = diffrax.ODETerm(van_der_pol), diffrax.Tsit5()
        adjoint = diffrax.ForwardMode()
        run = diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            4.0,
            None,
            START,
            mu,
            stepsize_controller=control,
            adjoint=adjoint,
            max_steps=100_000,
        )
        return run.ys[0][-1]

    reverse = jax.jit(jax.grad(final))(2.0)
    expected = jax.jit(lambda mu: jax.jvp(final_diffrax, (mu,), (1.0,))[1])(2.0)
    assert float(reverse) == pytest.approx(float(expected), rel=1e-6)
    forward = jax.jit(lambda mu: jax.jvp(final, (mu,), (1.0,))[1])(2.0)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-8)  # two programs, whose steps differ by rounding


def test_adaptive_run_says_when_it_did_not_finish_and_vmaps():
    short = solve_adaptive(van_der_pol, START, t1=10.0, args=1.0, max_steps=3)
    assert not bool(short.finished)
    assert np.isnan(short.y[0][-1])
    batch = jax.vmap(lambda mu: solve_adaptive(van_der_pol, START, t1=1.0, args=mu).y[0][-1])(jnp.array([0.5, 5.0]))
    np.testing.assert_allclose(batch, [published(0.5, 1.0)[0], published(5.0, 1.0)[0]], rtol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: extrapolated_euler(0), "order must be at least 1"),
        (lambda: extrapolated_euler(40), "at most 12"),
        (
            lambda: extrapolated_euler(3, step=jeuler.rk4_step),
            "must be of order 1, such as euler_step, got rk4_step",
        ),
        (lambda: solve_adaptive(van_der_pol, START, t1=-1.0, args=1.0), "t1 must"),
        (
            lambda: solve_adaptive(van_der_pol, START, t1=1.0, args=1.0, step=jeuler.euler_step),
            "extrapolated_euler step",
        ),
        (lambda: solve_adaptive(van_der_pol, START, t1=1.0, args=1.0, rtol=-1.0), "rtol must be at least 0"),
    ],
)
def test_bad_input_is_told(call, message):
    with pytest.raises(ValueError, match=message):
        call()
