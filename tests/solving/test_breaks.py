"""Fields that jump: what adaptive steps see of them, and times of jumps that are told."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from advice_problems import GRAVITY, HEIGHT, STIFFNESS, on_the_floor

import jeuler
from jeuler._jax.haste import jit_in_haste
from jeuler.steps.embedded import interpolant, tsit5

RATE = 0.7


def switched(t, y, time):
    return -jnp.where(t <= time, RATE, 0.0) * y


def interrupted(t, y, args):
    """Decay at RATE but for a moment from a time on, of that length, at another rate there."""
    time, length, there = args
    return -jnp.where((t > time) & (t <= time + length), there, RATE) * y


@functools.cache
def interrupted_at(step):
    """Runs to t = 2 that are interrupted at 57 times; what differs between tests is an input of one program."""

    def run(time, length, there, rtol, max_dt):
        return jeuler.solve_adaptive(
            interrupted, 1.0, t1=2.0, args=(time, length, there), rtol=rtol, atol=1e-3 * rtol, step=step, max_dt=max_dt
        )

    return jit_in_haste(jax.vmap(run, in_axes=(0, None, None, None, None)), "some")


TIMES, NO_MAX_DT = np.linspace(0.3, 1.7, 57), 10.0


@pytest.mark.parametrize("step", [None, jeuler.extrapolated_euler(6), jeuler.extrapolated_euler(3)])
def test_no_switch_is_passed_over(step):
    for rtol in (1e-4, 1e-6, 1e-8):
        got, right = interrupted_at(step)(TIMES, jnp.inf, 0.0, rtol, NO_MAX_DT), np.exp(-RATE * TIMES)
        assert np.all(got.finished)
        assert np.max(np.abs(got.y[:, -1] / right - 1)) < 100 * rtol


def test_a_moment_of_a_tenth_of_a_second_is_not_passed_over():
    """Two switches, 0.1 s apart, at 57 times: off for that moment, or more."""
    for there, rtol in ((0.0, 1e-6), (0.0, 1e-8), (3.0, 1e-8)):
        got, right = (
            interrupted_at(None)(TIMES, 0.1, there, rtol, NO_MAX_DT).y[:, -1],
            np.exp(-1.9 * RATE - 0.1 * there),
        )
        assert np.max(np.abs(got / right - 1)) < 100 * rtol


def test_the_stage_between_the_stages_lies_on_an_interpolant_of_order_4():
    """Conditions of order on y(t + theta dt), and of its slope as the derivative in theta, at theta = 0.6 and others."""
    matrix, weights = np.zeros((7, 7)), interpolant()
    for stage, row in enumerate(tsit5().matrix[:6], start=1):
        matrix[stage, : len(row)] = row
    c, one = matrix.sum(1), np.ones(7)
    trees = [(one, 1, 1), (c, 2, 2), (c**2, 3, 3), (matrix @ c, 3, 6), (c**3, 4, 4), (c * (matrix @ c), 4, 8)]
    trees += [(matrix @ c**2, 4, 12), (matrix @ matrix @ c, 4, 24)]
    for theta in (0.3, 0.6, 1.0):
        value, slope = (np.array([p(theta) for p in part]) for part in (weights, [p.deriv() for p in weights]))
        for tree, order, density in trees:
            assert value @ tree == pytest.approx(theta**order / density, abs=1e-13)
            assert slope @ tree == pytest.approx(order * theta ** (order - 1) / density, abs=1e-13)
    np.testing.assert_allclose([p(1.0) for p in weights], tsit5().weights, atol=1e-14)


def test_a_square_wave_drives_an_oscillator():
    def field(t, y, args):
        return y[1], jnp.where(jnp.floor(t) % 2 == 0, 1.0, -1.0) - 4.0 * y[0]

    x, v = 0.0, 0.0  # exact, a second at a time: x - u / 4 turns with omega = 2
    for second in range(10):
        middle = (1.0 if second % 2 == 0 else -1.0) / 4
        x, v = middle + (x - middle) * np.cos(2) + v / 2 * np.sin(2), -2 * (x - middle) * np.sin(2) + v * np.cos(2)
    y0, t1 = (jnp.asarray(0.0), jnp.asarray(0.0)), 10.0
    for rtol, run, theirs in both_at_tolerances(field, y0, t1, None):
        error, other = (np.hypot(y[0][-1] - x, y[1][-1] - v) / np.hypot(x, v) for y in (run, theirs))
        assert error < 100 * rtol
        assert error < max(10 * other, rtol)


def both_at_tolerances(field, y0, t1, args):
    """(rtol, states of adaptive steps, states of Tsit5 of diffrax) at three tolerances."""
    ours = jit_in_haste(lambda rtol: jeuler.solve_adaptive(
        field, y0, t1=t1, args=args, rtol=rtol, atol=1e-3 * rtol
    ).y, "some")  # fmt: skip
    theirs = jit_in_haste(lambda rtol: diffrax.diffeqsolve(
        diffrax.ODETerm(field), diffrax.Tsit5(), 0.0, t1, None, y0, args,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol), max_steps=100_000,
    ).ys, "some")  # fmt: skip
    return [(rtol, ours(rtol), theirs(rtol)) for rtol in (1e-4, 1e-6, 1e-8)]


def test_a_ball_bounces_on_a_penalty_floor():
    """Against the exact motion, free falls and half swings; and against Tsit5 of diffrax at the same tolerances."""
    contact = jeuler.PenaltyContact(jeuler.Plane([0.0, 0.0], [0.0, 1.0]), ks=STIFFNESS)
    scene = jeuler.Scene((jeuler.Gravity([0.0, -GRAVITY]), contact))
    state = jeuler.ParticleState(jnp.array([[0.0, HEIGHT]]), jnp.zeros((1, 2)), mass=1.0)
    (y0, args), t1 = scene.as_equation(state), 3.0
    exact = on_the_floor(t1)
    for rtol, *runs in both_at_tolerances(scene.vector_field, y0, t1, args):
        ends = (np.array([y[0][-1, 0, 1], y[1][-1, 0, 1]]) for y in runs)
        error, other = (np.linalg.norm(end - exact) / np.linalg.norm(exact) for end in ends)
        assert error <= 100 * rtol
        assert error <= max(10 * other, rtol)


def slower_from(t, y, time):
    return -jnp.where(t < time, 2.0, RATE) * y


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.heun_step, jeuler.rk4_step, jeuler.implicit_euler_step])
@pytest.mark.parametrize("time", [0.0, 0.31, 0.5, 2.0, 5.0])
def test_a_break_gives_fixed_steps_their_order_back(step, time):
    """On the grid, off it, at both ends and beyond; f is not evaluated on the wrong side of it."""

    def error(num_steps):
        run = jeuler.solve(
            slower_from, 1.0, dt=2.0 / num_steps, num_steps=num_steps, args=time,
            step=step, breaks=[time], save_every=num_steps,
        )  # fmt: skip
        before = min(time, 2.0)
        return abs(float(run.y[-1]) / np.exp(-2.0 * before - RATE * (2.0 - before)) - 1)

    order = getattr(step, "order", 1)
    assert np.log2(error(40) / error(160)) / 2 == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.rk4_step, jeuler.implicit_euler_step])
def test_breaks_hold_backwards_in_time_beside_far_ones_and_in_a_batch_of_both_directions(step):
    """y' = 1 before the break b and -1 after it: from y = 0, 2 b - 1 after one second of both."""

    def end(dt, t0, b):
        field = lambda t, y, b: jnp.where(t < b, 1.0, -1.0) * jnp.ones_like(y)  # noqa: E731
        breaks = jnp.stack([b, 1e300, 1e300, -7.0, 0.2])
        return jeuler.solve(field, 0.0, dt=dt, num_steps=10, t0=t0, step=step, args=b, breaks=breaks).y[-1]

    dts, t0s = jnp.array([0.1, -0.1] * 5), jnp.array([0.0, 1.0] * 5)
    breaks = jnp.repeat(jnp.array([0.53, 0.5, 0.0, 1.0, jnp.nan]), 2)
    ends, slopes = jit_in_haste(jax.vmap(jax.value_and_grad(end, argnums=2)), "great")(dts, t0s, breaks)
    np.testing.assert_allclose(ends, jnp.sign(dts) * (2 * breaks - 1), atol=1e-14)
    np.testing.assert_allclose(slopes[:4], 2 * jnp.sign(dts)[:4], atol=1e-14)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
@pytest.mark.parametrize("adaptive", [False, True])
def test_the_derivative_by_one_of_two_breaks_at_one_time_is_nan(adaptive, derivative):
    """f jumps at b from 1 to -1, and not at c: y(1) = 2 b - 1, from either side of c; at c it cannot be told."""

    def end(b, c):
        field = lambda t, y, b: jnp.where(t < b, 1.0, -1.0) * jnp.ones_like(y)  # noqa: E731
        breaks = jnp.stack([b, c, 7.0, 7.0])
        if adaptive:
            return jeuler.solve_adaptive(field, 0.0, t1=1.0, args=b, breaks=breaks).y[-1]
        return jeuler.solve(field, 0.0, dt=0.1, num_steps=10, args=b, breaks=breaks).y[-1]

    slopes = jit_in_haste(jax.vmap(derivative(end, argnums=(0, 1)), in_axes=(None, 0)), "great")(
        0.5, jnp.array([0.2, 0.5, 0.53, 1.2])
    )
    np.testing.assert_allclose(slopes[0], [2.0, np.nan, 2.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(slopes[1], [0.0, np.nan, 0.0, 0.0], atol=1e-12)
    assert float(end(0.5, 0.5)) == pytest.approx(0.0, abs=1e-14)


def test_adaptive_steps_heed_a_break_beside_a_far_one_and_none_that_is_nan():
    field = lambda t, y, args: jnp.where(t < 0.53, 1.0, -1.0) * jnp.ones_like(y)  # noqa: E731
    run = jax.jit(lambda b: jeuler.solve_adaptive(field, 0.0, t1=1.0, breaks=jnp.stack([b, 0.53])))
    assert float(run(1e300).y[-1]) == pytest.approx(0.06, abs=1e-14)
    assert np.isnan(run(jnp.nan).y[-1])
    assert not run(jnp.nan).finished


def test_a_jump_at_the_end_must_be_named_too():
    field = lambda t, y, args: jnp.where(t < 1.0, 1.0, 5.0)  # noqa: E731
    ends = [
        float(jeuler.solve(field, 0.0, dt=0.5, num_steps=2, step=jeuler.heun_step, breaks=breaks).y[-1])
        for breaks in ((), (1.0,))
    ]
    assert ends == [2.0, 1.0]


def test_breaks_stop_adaptive_steps_without_a_rejection():
    run = jeuler.solve_adaptive(switched, 1.0, t1=[0.5, 1.0, 2.0], args=0.8, rtol=1e-8, breaks=[0.8, 7.0])
    np.testing.assert_allclose(run.y, np.exp(-RATE * np.minimum([0, 0.5, 1.0, 2.0], 0.8)), rtol=1e-7)
    assert int(run.num_rejected) == 0
    assert run.t.tolist() == [0.0, 0.5, 1.0, 2.0]


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_the_derivative_with_respect_to_a_break_is_that_of_the_solution(derivative):
    """At one of the times asked for, and within a step; on the grid in the test of both directions."""
    right = -RATE * np.exp(-RATE * 0.8)

    def adaptive(time):
        return jeuler.solve_adaptive(switched, 1.0, t1=[0.8, 2.0], args=time, rtol=1e-10, atol=1e-12, breaks=[time]).y[
            -1
        ]

    def fixed(time):
        return jeuler.solve(
            switched, 1.0, dt=0.03, num_steps=66, args=time, step=jeuler.rk4_step, breaks=jnp.array([time])
        ).y[-1]

    assert jit_in_haste(derivative(adaptive), "great")(0.8) == pytest.approx(right, rel=1e-7)
    assert derivative(fixed)(0.8) == pytest.approx(right, rel=1e-6)
    assert derivative(jax.jit(fixed))(0.8) == pytest.approx(right, rel=1e-6)


def test_several_breaks_in_one_step_and_in_float32():
    times = [0.11, 0.12, 0.14]
    field = lambda t, y, args: jnp.where((t > 0.11) & (t < 0.12) | (t > 0.14), 1.0, 0.0) * jnp.ones_like(y)  # noqa: E731
    for dtype, near in ((jnp.float32, 1e-6), (jnp.float64, 1e-13)):
        run = jeuler.solve(field, jnp.zeros((), dtype), dt=0.1, num_steps=10, breaks=times)
        assert run.y.dtype == dtype
        assert float(run.y[-1]) == pytest.approx(0.01 + 0.86, rel=near * 10)


@pytest.mark.parametrize(
    ("breaks", "message"),
    [([[0.1]], "shape"), ([np.nan], "finite"), ("soon", "must be times"), (["a"], "must be times")],
)
def test_bad_breaks_are_told(breaks, message):
    for run in (
        lambda: jeuler.solve(switched, 1.0, dt=0.1, num_steps=3, args=1.0, breaks=breaks),
        lambda: jeuler.solve_adaptive(switched, 1.0, t1=1.0, args=1.0, breaks=breaks),
    ):
        with pytest.raises(ValueError, match=message):
            run()


@pytest.mark.parametrize("step", [None, jeuler.extrapolated_euler(6)])
def test_what_is_shorter_than_the_longest_gap_may_be_missed_and_longest_steps_end_that(step):
    """Pulses of 0.03 s at 57 times: a wrong answer has a gap longer than the pulse; with max_dt there is none."""
    pulse, right, run = 0.03, np.exp(-RATE * 1.97), interrupted_at(step)
    missed = 0
    for rtol in (1e-4, 1e-6):
        free = run(TIMES, pulse, 0.0, rtol, NO_MAX_DT)
        wrong = np.abs(free.y[:, -1] / right - 1) > 100 * rtol
        assert np.all(free.longest_gap[wrong] > pulse)
        missed += wrong.sum()
        bound = run(TIMES, pulse, 0.0, rtol, 0.95 * pulse / (0.3 if step is None else 1 / step.order))
        assert np.all(bound.finished)
        assert np.all(bound.longest_gap < pulse)
        assert np.max(np.abs(bound.y[:, -1] / right - 1)) < 100 * rtol
    assert missed > 0


def test_no_look_at_f_is_further_from_the_next_than_the_longest_gap():
    for step in (None, jeuler.extrapolated_euler(3), jeuler.extrapolated_euler(4, step=jeuler.implicit_euler_step),
                 jeuler.extrapolated_euler(5, step=jeuler.linearly_implicit_euler_step)):  # fmt: skip
        seen = []

        def field(t, y, args, seen=seen):
            jax.debug.callback(lambda t: seen.append(float(t)), t)
            return -y

        run = jeuler.solve_adaptive(field, 1.0, t1=3.0, step=step, max_dt=0.7, dt0=0.7, rtol=1e-3)
        jax.effects_barrier()
        assert np.max(np.diff(np.unique([*seen, 0.0, 3.0]))) <= float(run.longest_gap) * (1 + 1e-9)
        assert float(run.longest_gap) <= 0.7 * (0.3 if step is None else 1 / step.order) * (1 + 1e-6)
