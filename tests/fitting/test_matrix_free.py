"""Fits without a Jacobian: the same answers as with one, between bounds, with outliers, interrupted and taken up."""

import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.fitting import minimise
from jeuler.fitting import problem as problems
from jeuler.fitting.matrix_free import conjugate_gradients

T = np.linspace(0, 4, 60)
TRUTH = {"a": np.linspace(1, 3, 6), "k": np.linspace(0.2, 1.2, 6)}


def residual(p, y):
    return p["a"] * jnp.exp(-p["k"] * T[:, None]) - y


def data(outliers=0):
    y = np.asarray(residual(TRUTH, 0.0)) + 0.01 * np.random.default_rng(3).normal(size=(60, 6))
    y[: 7 * outliers : 7, 2] += 2.0
    return y


@pytest.fixture
def without_a_jacobian(monkeypatch):
    def switch():
        monkeypatch.setattr(problems, "MOST_COLUMNS", 0)

    return switch


@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
@pytest.mark.parametrize("bounds", [None, {"a": (0.0, 2.0)}])
@pytest.mark.parametrize("start", [1.0, 30.0])
def test_agrees_with_the_fit_that_forms_it(loss, bounds, start, without_a_jacobian):
    y, x = data(outliers=3 * (loss != "linear")), {"a": np.full(6, min(start, 2.0)), "k": np.full(6, start)}
    options = {"data": y, "bounds": bounds, "positive": True, "loss": loss, "sigma": 0.01, "progress": False}
    formed = jeuler.fit(residual, x, **options)
    without_a_jacobian()
    found = jeuler.fit(residual, x, **options)
    assert found.converged
    assert found.stderr is None
    assert "not computed for 12 unknowns" in found.message
    for name in TRUTH:
        np.testing.assert_allclose(found.params[name], formed.params[name], atol=0.1 * np.max(formed.stderr[name]))
    assert found.at_bound == formed.at_bound


def test_far_from_the_minimum_it_does_not_say_converged(without_a_jacobian):
    without_a_jacobian()
    found = jeuler.fit(residual, {"a": np.ones(6), "k": np.full(6, 3.0)}, data=data(), max_iterations=2)
    assert not found.converged
    assert found.message.startswith("stopped before it converged")
    assert len(found.history) == 2


def test_interrupted_it_keeps_the_best_and_goes_on_to_the_same_result(tmp_path, without_a_jacobian, monkeypatch):
    without_a_jacobian()
    x, kept = {"a": np.ones(6), "k": np.full(6, 3.0)}, tmp_path / "state.npz"
    whole = jeuler.fit(residual, x, data=data())
    see = minimise.Watch.see

    def interrupted_at_the_second(self, stage, point, history, counted):
        see(self, stage, point, history, counted)
        if len(history) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(minimise.Watch, "see", interrupted_at_the_second)
        patch.setattr("jeuler.fitting.kept.Record.pause", 0.0)
        begun = jeuler.fit(residual, x, data=data(), resume=kept)
    assert begun.message.startswith("interrupted: the best so far")
    assert not begun.converged
    assert begun.loss == begun.history[-1] < begun.history[0]
    again = jeuler.fit(residual, x, data=data(), resume=kept)
    assert again.converged
    np.testing.assert_array_equal(again.history, whole.history)
    np.testing.assert_array_equal(again.params["k"], whole.params["k"])


def test_springs_are_those_of_the_exact_motion(without_a_jacobian):
    without_a_jacobian()
    times, w, g = np.linspace(0, 2, 41), np.sqrt(100 - 0.04), 0.2
    y = np.full((41, 2, 1), np.nan)
    y[:, 1, 0] = 1 + 0.3 * np.exp(-g * times) * (np.cos(w * times) + g / w * np.sin(w * times))
    state = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    found = jeuler.fit_springs(jeuler.Scene((jeuler.Springs([[0, 1]], 3.0, 9.0, 1.0),)), state, times, y, dt=0.005)
    assert found.start == "data"
    assert found.stderr is None
    assert found.predicted.shape == y.shape
    np.testing.assert_allclose(found.ks, 100, rtol=1e-6)
    np.testing.assert_allclose(found.kd, 0.4, rtol=1e-4)


def test_conjugate_gradients_solve_and_say_what_is_left(random):
    root = random.normal(size=(40, 12))
    matrix, b = root.T @ root, random.normal(size=12)
    s, left = conjugate_gradients(lambda s: matrix @ s, jnp.asarray(b))
    best = np.linalg.solve(matrix, b)
    np.testing.assert_allclose(left, b - matrix @ s, atol=1e-12)
    assert b @ best * 0.95 < 2 * b @ s - s @ matrix @ s <= b @ best + 1e-12
    s, _ = conjugate_gradients(lambda s: 0 * s, jnp.asarray(b))
    np.testing.assert_array_equal(s, 0)  # nothing is seen: nothing moves
