"""Multiple shooting: long and chaotic records, made by SciPy's method of eighth order."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jeuler

LORENZ = np.array([10.0, 28.0, 2.66])
TIMES = np.linspace(0, 8, 321)


def lorenz(t, y, p):
    return jnp.stack([p[0] * (y[1] - y[0]), y[0] * (p[1] - y[2]) - y[1], y[0] * y[1] - p[2] * y[2]])


@pytest.fixture(scope="module")
def record():
    def slope(t, y):
        s, r, b = LORENZ
        return [s * (y[1] - y[0]), y[0] * (r - y[2]) - y[1], y[0] * y[1] - b * y[2]]

    return solve_ivp(slope, (0, 8), (1, 1, 1), t_eval=TIMES, rtol=1e-11, atol=1e-11, method="DOP853").y.T


def fitted(values, **how):
    return jeuler.multiple_shooting(
        lorenz, jnp.asarray([5.0, 20.0, 1.0]), TIMES, values, **({"dt": 0.0125, "segments": 16} | how)
    )


@pytest.mark.parametrize("noise", [0, 0.01])
def test_lorenz_from_far_away(record, noise):
    found = fitted(record + noise * record.std(0) * np.random.default_rng(0).normal(size=record.shape))
    np.testing.assert_allclose(found.params, LORENZ, rtol=1e-3)
    assert found.converged
    assert (found.gaps < 1e-4).all()
    assert len(found.starts) == len(found.start_times) == 16
    assert np.sqrt(np.mean((found.predicted - record) ** 2)) < (0.05 if noise else 1e-3)
    if noise:
        assert (np.abs(found.params - LORENZ) < 4 * np.asarray(found.stderr)).all()


def test_a_known_start_gaps_and_a_number_that_is_never_seen(record):
    values, guess = record.copy(), record.copy()
    values[100:120, 1] = np.nan
    values[:, 2] = np.nan
    guess[:, 2] = 0.9 * record[:, 2]
    found = fitted(values, y0=record[0], guess=guess)
    np.testing.assert_allclose(found.params, LORENZ, rtol=1e-3)
    np.testing.assert_array_equal(found.starts[0], record[0])


def test_a_model_that_is_wrong_leaves_gaps_or_misfit_and_says_so():
    """A frequency that changes on the way: no one oscillator follows it."""
    t = np.linspace(0, 20, 101)
    phase = np.where(t < 10, t, 10 + 3 * (t - 10))
    values = np.stack([np.cos(phase), -np.sin(phase) * np.where(t < 10, 1, 3)], axis=1)
    found = jeuler.multiple_shooting(lambda t, y, p: jnp.stack([y[1], -p * y[0]]), 1.0, t, values, dt=0.2, segments=5)
    assert not found.converged or "times sigma" in found.message


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"values": np.zeros(321)}, r"values must have shape \(time, number\)"),
        ({"y0": [1.0]}, r"y0 must have shape \(3,\)"),
        ({"values": np.where(np.arange(3) == 2, np.nan, np.ones((321, 3)) * TIMES[:, None])}, "only NaN in column 2"),
        ({"guess": np.zeros((3, 3))}, r"guess must have shape \(321, 3\)"),
        ({"segments": 0}, "segments"),
        ({"segments": 321}, "segments must be at most"),
        ({"sigma": -1.0}, "sigma must be above 0"),
        ({"dt": 0.0}, "dt must be greater than 0"),
        ({"values": np.ones((320, 3))}, "values must have a row for each of the 321 times"),
        ({"values": np.full((321, 3), np.nan)}, "values must have at least one finite value"),
        ({"values": np.full((321, 3), np.inf)}, "values must be finite, or NaN"),
    ],
)
def test_wrong_input_is_one_line(record, change, expected):
    change = {"values": record} | change
    with pytest.raises(ValueError, match=expected) as error:
        fitted(change.pop("values"), **change)
    assert "\n" not in str(error.value)


def test_a_field_of_another_shape_is_refused():
    values = np.ones((5, 2)) + np.arange(5)[:, None]
    with pytest.raises(ValueError, match="must keep the shape"):
        jeuler.multiple_shooting(lambda t, y, p: jnp.zeros(3), 1.0, np.arange(5.0), values, dt=0.1)


def test_a_pair_of_bounds_is_of_the_parameters_and_not_of_the_states():
    t = np.linspace(0.0, 4.0, 41)
    found = jeuler.multiple_shooting(
        lambda t, y, p: -p * y, jnp.asarray(2.0), t, -np.exp(-0.5 * t)[:, None], dt=0.1, segments=4, bounds=(0.0, 3.0)
    )
    np.testing.assert_allclose(found.params, 0.5, rtol=1e-4)
    assert (found.starts < 0).all()
    assert found.converged
