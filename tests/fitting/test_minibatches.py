"""Fits by an optax optimiser that looks at some windows of time in each step."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jeuler


def decay(t, y, p):
    return jnp.stack([y[1], -p["ks"] * y[0] - p["kd"] * y[1]])


def windows():
    """40 windows of 11 samples of one long record, exact, each with the state at its start."""
    t, g = np.linspace(0, 16, 401), 0.05
    w = np.sqrt(9 - g**2)
    x = np.exp(-g * t) * (np.cos(w * t) + g / w * np.sin(w * t))
    v = -np.exp(-g * t) * 9 / w * np.sin(w * t)
    y = np.stack([x, v], axis=1)
    return np.stack([y[10 * k : 10 * k + 11] for k in range(40)])


def residual(p, data):
    def run(start):
        return jeuler.solve(decay, start, dt=0.04, num_steps=10, step=jeuler.rk4_step, args=p).y

    return jax.vmap(run)(data[:, 0]) - data


def test_windows_of_time_lead_to_the_truth():
    found = jeuler.fit(
        residual, {"ks": 4.0, "kd": 0.5}, data=windows(), optimizer=optax.adam(0.05), minibatch=8, max_iterations=800
    )
    np.testing.assert_allclose(found.params["ks"], 9.0, rtol=1e-2)
    np.testing.assert_allclose(found.params["kd"], 0.1, atol=1e-2)
    assert len(found.history) <= 161  # one a pass of five steps, and the start
    np.testing.assert_allclose(found.loss, np.min(found.history))
    assert found.converged == (found.message.split(";")[0] == "converged")


def test_all_rows_at_once_are_the_descent_without_minibatches():
    x = np.linspace(0, 1, 12)
    y = 3 * x + 0.1 * np.cos(9 * x)
    rows = np.stack([x, y], axis=1)

    def line(p, rows):
        return p["a"] * rows[:, 0] - rows[:, 1]

    options = {"data": rows, "optimizer": optax.sgd(0.5), "weights": 1 + x, "bounds": {"a": (0.0, 2.5)}}
    whole = jeuler.fit(line, {"a": 1.0}, **options, max_iterations=30)
    some = jeuler.fit(line, {"a": 1.0}, **options, minibatch=12, max_iterations=30)
    np.testing.assert_allclose(some.params["a"], whole.params["a"], rtol=1e-12)
    np.testing.assert_allclose(some.history[:30], whole.history, rtol=1e-10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"minibatch": 0}, "minibatch must be"),
        ({"minibatch": 13}, "minibatch must be from 1 to the rows"),
        ({"minibatch": 4, "optimizer": None}, "minibatch is for an optax optimiser"),
        ({"minibatch": 4, "stages": [np.ones(12)]}, "minibatch goes without"),
        ({"minibatch": 4, "data": None}, "minibatch must be from 1 to the rows"),
    ],
)
def test_bad_input(change, message):
    x = np.linspace(0, 1, 12)
    options = {"data": x, "optimizer": optax.sgd(0.1)} | change

    def line(p, data=x):
        return p["a"] * data - 2 * data

    with pytest.raises(ValueError, match=message):
        jeuler.fit(line, {"a": 1.0}, **options)


def test_a_residual_of_fixed_rows_is_refused():
    x = np.linspace(0, 1, 12)
    with pytest.raises(ValueError, match="residual must take 4 rows"):
        jeuler.fit(lambda p, y: p["a"] * x - y, {"a": 1.0}, data=x, optimizer=optax.sgd(0.1), minibatch=4)
