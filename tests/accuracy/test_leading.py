"""The leading term of a step's error as an equation, and advice beyond what pilot runs can follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from advice_problems import kepler, more_problems

import jeuler
from jeuler.accuracy.leading import modified_field
from jeuler.accuracy.pilot import Pilot, distance


@pytest.mark.parametrize(
    ("step", "of_square", "of_time"),
    [
        (jeuler.euler_step, -1, -1 / 2),
        (jeuler.implicit_euler_step, 1, 1 / 2),
        (jeuler.linearly_implicit_euler_step, 1, 1 / 2),
        (jeuler.heun_step, -1 / 2, 0),
        (jeuler.implicit_midpoint_step, 1 / 4, 0),
    ],
)
def test_the_leading_terms_are_those_on_paper(step, of_square, of_time):
    """y' = y^2: y^3 dt for order 1, and for order 2 y^4 dt^2 times 4 a + 2 b, a of f'f'f and b of f''(f, f).

    Heun: a = -1/6, b = 1/12; the midpoint rule: a = 1/12, b = -1/24. y' = t: dt / 2 for Euler steps.
    """
    y, dt, order = 1.3, 0.01, getattr(step, "order", 1)
    field = jax.jit(modified_field(lambda t, y, args: y * y, step, order))
    assert float(field(0.0, y, (jnp.float64(dt), None))) == pytest.approx(
        y**2 + of_square * y ** (order + 2) * dt**order, rel=1e-12
    )
    drift = jax.jit(modified_field(lambda t, y, args: t + 0.0 * y, step, order))
    assert float(drift(0.7, y, (jnp.float64(dt), None))) == pytest.approx(0.7 + of_time * dt**order, rel=1e-12)


def test_advice_where_no_pilot_run_follows_the_order():
    """An orbit of eccentricity 0.8: the advised run, 100 times as long as any pilot, has the error that is said."""
    f, y0, t1 = more_problems()["DETEST_nonstiff_D5"].f, jnp.asarray(kepler(0.8, 0.0)), 8.0
    step = jeuler.linearly_implicit_euler_step
    advice = jeuler.advise_step(f, y0, t1=t1, error=1e-2, step=step, max_pilot_steps=2**14)
    assert "leading term" in advice.reason
    run = Pilot(f, y0, 0.0, t1, None, step, np.float64, False)
    error = distance(run(advice.num_steps)[-1], kepler(0.8, t1)) / np.linalg.norm(kepler(0.8, t1))
    assert error == pytest.approx(advice.predicted_error, rel=0.02)
    assert 0.5e-2 < error < 1e-2


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.implicit_euler_step])
def test_what_decays_below_any_number_has_no_scale_of_its_own(step):
    """exp(-1000) is 0 in float64: the target is in the units of the state, and every stable dt meets it."""
    advice = jeuler.advise_step(lambda t, y, args: -50.0 * y, 1.0, t1=20.0, error=1e-3, step=step)
    run = jeuler.solve(lambda t, y, args: -50.0 * y, 1.0, dt=advice.dt, num_steps=advice.num_steps, step=step)
    assert abs(float(run.y[-1])) < 1e-3
    assert advice.dt > (0.038 if step is jeuler.euler_step else 9.0)
