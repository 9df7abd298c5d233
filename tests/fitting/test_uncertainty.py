"""Errors that cover what they say, for white and for correlated noise; blind directions in words."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import jeuler
from jeuler.fitting.uncertainty import autocovariances, uncertainty

T = np.linspace(0, 10, 300)


def swing(w, g, a, b):
    return np.exp(-g * T) * (a * np.cos(w * T) + b * np.sin(w * T))


def derivatives():
    p = np.array([3.0, 0.2, 1.0, 0.2])
    return np.stack([(swing(*(p + 1e-6 * e)) - swing(*(p - 1e-6 * e))) / 2e-6 for e in np.eye(4)], 1)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_nominal_95_percent_cover_93_to_97(rho):
    """200 records of a decaying swing with noise e_k = rho e_(k-1) + white; the linear model, which a fit ends in."""
    random = np.random.default_rng(5)
    jacobian, hits, white = derivatives(), 0, 0
    inverse = np.linalg.pinv(jacobian)
    for _ in range(200):
        noise = lfilter([1], [1, -rho], random.normal(size=len(T) + 500))[500:]
        error = inverse @ noise
        left = jacobian @ error - noise
        ones = np.ones(len(T))
        found = uncertainty(jacobian, left, ones, ones > 0, ((len(T), 1),), 2e-16, False)
        hits += (np.abs(error) < 1.96 * np.sqrt(np.diag(found.covariance))).sum()
        white += (np.abs(error) < 1.96 * np.sqrt(np.diag(found.white))).sum()
    assert 0.93 <= hits / 800 <= 0.97
    assert (white / 800 > 0.93) == (rho == 0)


def test_autocovariances_are_corrected_for_the_fit(random):
    """A quadratic through 40 samples follows much of their slow noise; the mean of many estimates is right."""
    t = np.linspace(-1, 1, 40)
    q, _ = np.linalg.qr(np.stack([np.ones(40), t, t**2], 1))
    found, plain = [], []
    for _ in range(2000):
        e = lfilter([1], [1, -0.7], random.normal(size=240))[200:]
        left = e - q @ (q.T @ e)
        found.append(autocovariances(left, np.ones(40, bool), q, ((40, 1),), 8, np))
        plain.append([left @ left / 40, left[1:] @ left[:-1] / 40])
    right = 0.7 ** np.arange(2) / (1 - 0.49)
    assert np.abs(np.mean(found, axis=0)[:2] / right - 1).max() < 0.1
    assert np.mean(plain, axis=0)[1] < 0.75 * right[1]


def test_the_lag_one_correlation_and_the_words_for_it(random):
    noise = 0.05 * lfilter([1], [1, -0.8], random.normal(size=len(T)))
    y = swing(3.0, 0.2, 1.0, 0.0) + noise

    def residual(p, y):
        return p["a"] * jnp.exp(-p["g"] * T) * jnp.cos(p["w"] * T) - y

    found = jeuler.fit(residual, {"a": 1.0, "g": 0.1, "w": 3.1}, data=y)
    assert 0.6 < found.autocorrelation < 0.95
    assert "correlated" in found.message
    assert float(found.stderr["w"]) > 1.2 * float(found.stderr_white["w"])
    clean = jeuler.fit(residual, {"a": 1.0, "g": 0.1, "w": 3.1}, data=y - noise + 0.05 * random.normal(size=len(T)))
    assert "widened" not in clean.message


X = np.linspace(0.1, 1, 20)
WHITE = 0.01 * np.random.default_rng(1).normal(size=20)


@pytest.mark.parametrize(
    ("residual", "start", "positive", "words"),
    [
        (lambda p: p["a"] * p["b"] * X - 3 * X - WHITE, {"a": 1.0, "b": 2.0}, True, "a and b only as their product"),
        (lambda p: p["a"] / p["b"] * X - 3 * X - WHITE, {"a": 1.0, "b": 2.0}, True, "a and b only as their ratio"),
        (lambda p: (p["a"] + p["b"]) * X - 3 * X - WHITE, {"a": 1.0, "b": 2.5}, False, "a and b only as their sum"),
        (lambda p: (p["a"] - p["b"]) * X - X - WHITE, {"a": 1.0, "b": 2.5}, False, "a and b only as their difference"),
        (
            lambda p: p["k"][0] / p["m"] * X + p["k"][1] / p["m"] - 3 * X - 2 - WHITE,
            {"k": jnp.array([1.0, 2.0]), "m": 1.5},
            True,
            "k and m only as their ratios",
        ),
        (lambda p: p["a"] * X - X - WHITE + 0 * p["idle"], {"a": 1.0, "idle": 4.0}, False, "do not determine idle"),
    ],
)
def test_blind_combinations_are_named(residual, start, positive, words):
    found = jeuler.fit(residual, start, positive=positive)
    assert words in found.message
    assert len(found.blind) == 1
    assert found.converged


def test_what_is_determined_keeps_its_error_beside_what_is_not():
    def residual(p):
        return p["ks"] / p["mass"] * X + p["c"] - 3 * X - 1 - WHITE

    found = jeuler.fit(residual, {"c": 0.0, "ks": 5.0, "mass": 2.0}, positive={"c": False, "ks": True, "mass": True})
    alone = jeuler.fit(lambda p: p["ratio"] * X + p["c"] - 3 * X - 1 - WHITE, {"c": 0.0, "ratio": 2.0})
    np.testing.assert_allclose(found.stderr["c"], alone.stderr["c"], rtol=1e-6)
    assert np.isinf(found.stderr["ks"])
    assert set(found.undetermined) == {"ks", "mass"}
    ks, mass = float(found.params["ks"]), float(found.params["mass"])
    slope = np.array([0, 1 / mass, -ks / mass**2])
    np.testing.assert_allclose(np.sqrt(slope @ found.covariance @ slope), alone.stderr["ratio"], rtol=1e-6)
    np.testing.assert_allclose(np.diag(found.correlation), 1)
