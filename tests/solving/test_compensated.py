"""Compensated sums: how far roundoff lets a float32 run get, and that jit, vmap and grad keep it so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler._core.precision import precision
from jeuler.steps.extrapolated import extrapolated_euler

pytestmark = pytest.mark.optimised  # it is about rounding

EPS = float(np.finfo(np.float32).eps)


def decay(t, y, rate):
    return -rate * y


def error(num_steps, compensated, step=jeuler.euler_step, transform=lambda run: run):
    """Relative error of y' = -y at t = 1 in float32, made by ``transform`` of the run (num_steps is static)."""
    with precision(np.float32):

        def run(y0):
            solution = jeuler.solve(
                decay,
                y0,
                dt=1 / num_steps,
                num_steps=num_steps,
                args=jnp.float32(1.0),
                step=step,
                save_every=num_steps,
                compensated=compensated,
            )
            return solution.y[-1]

        final = transform(run)(jnp.float32(1.0))
        assert final.dtype == jnp.float32
    return float(np.max(np.abs(np.asarray(final, float) * np.e - 1)))


def test_error_floor_in_float32_falls_from_above_eps_to_eps():
    steps = [2**k for k in range(6, 24)]
    plain, compensated = ([error(n, sums) for n in steps] for sums in (False, True))
    assert min(plain) > 10 * EPS  # the plain curve turns up: fewer steps are better than 2^23
    assert plain[-1] > 100 * min(plain)
    assert 6 < np.argmin(plain) < len(steps) - 3
    assert compensated[-1] < 1.5 * EPS  # the compensated one goes on down to eps, truncation 2^-24 included
    ratios = np.array(compensated[:-4]) / np.array(compensated[1:-3])
    np.testing.assert_allclose(ratios, 2, rtol=0.06)


def test_it_survives_jit_and_vmap():
    n = 2**21
    eager = error(n, True)
    assert eager < 5 * EPS
    assert error(n, True, transform=jax.jit) == eager
    assert error(n, True, transform=lambda run: lambda y: jax.jit(jax.vmap(run))(jnp.full(3, y))) == pytest.approx(
        eager, abs=EPS
    )
    assert error(n, False) > 20 * eager


@pytest.mark.parametrize(
    "step",
    [jeuler.euler_step, jeuler.heun_step, jeuler.rk4_step, extrapolated_euler(3)],
    ids=lambda s: s.__name__,
)
def test_every_explicit_step_keeps_its_error_near_eps_over_a_long_run(step):
    n = 2**20 if step is not jeuler.euler_step else 2**23
    assert error(n, True, step) < 3 * EPS
    assert error(n, False, step) > 10 * EPS


def test_derivatives_are_those_of_plain_sums():
    def final(inputs, compensated):
        y0, rate = inputs
        return jeuler.solve(decay, y0, dt=0.04, num_steps=50, args=rate, compensated=compensated).y[-1]

    inputs = jnp.array(1.3), jnp.array(0.7)
    for derivative in (jax.grad, jax.hessian):
        plain, compensated = (derivative(final)(inputs, sums) for sums in (False, True))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), plain, compensated)


def test_of_the_symplectic_pair_in_float32_against_float64():
    def final(dtype, compensated):
        with precision(dtype):
            start = jnp.asarray(1.0, dtype), jnp.asarray(0.0, dtype)
            field = lambda t, y, args: (y[1], -4 * y[0])  # noqa: E731
            run = jeuler.solve(
                field,
                start,
                dt=2.0**-16,
                num_steps=2**19,
                step=jeuler.symplectic_euler_step,
                save_every=2**19,
                compensated=compensated,
            )
            return np.array([float(leaf[-1]) for leaf in run.y])

    exact = final(np.float64, False)
    plain, compensated = (np.linalg.norm(final(np.float32, sums) - exact) for sums in (False, True))
    assert compensated < 4 * EPS
    assert plain > 20 * compensated


def test_simulate_has_it_and_only_asks_of_steps_that_can():
    def final(dtype, compensated, step=jeuler.euler_step):
        with precision(dtype):
            scene = jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks=9.0, kd=0.1, rest_length=1.0),))
            state = jeuler.ParticleState(jnp.array([[0.0], [1.5]], dtype), jnp.zeros((2, 1), dtype), [jnp.inf, 1.0])
            run = jeuler.simulate(
                scene,
                state,
                dt=2.0**-17,
                num_steps=2**18,
                step=step,
                save_every=2**18,
                compensated=compensated,
            )
            return np.asarray(run.y.position[-1, 1], float)

    exact = final(np.float64, False)
    plain, compensated = (float(np.abs(final(np.float32, sums) - exact)[0]) for sums in (False, True))
    assert compensated < 4 * EPS
    assert plain > 10 * compensated

    def step_without_increment(f, t, y, dt, args):
        return jeuler.euler_step(f, t, y, dt, args)

    with pytest.raises(ValueError, match="compensated=True needs an explicit step"):
        final(np.float64, True, step_without_increment)
