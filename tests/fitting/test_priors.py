"""Priors are rows of the residual: estimate and covariance are those of the normal posterior."""

import jax.numpy as jnp
import numpy as np
import pytest

import jeuler

X = np.linspace(0.0, 1.0, 30)
Y = 2 * X + 0.5 + 0.1 * np.random.default_rng(0).normal(size=30)


def line(p, y):
    return p["a"] * X + p["b"] - y


def test_estimate_and_covariance_are_those_of_the_posterior():
    priors = {"a": (1.5, 0.05), "b": (0.0, np.inf)}
    found = jeuler.fit(line, {"a": 1.0, "b": 1.0}, data=Y, sigma=0.1, priors=priors, progress=False)
    design = np.stack([X, np.ones(30)], 1) / 0.1
    precision = design.T @ design + np.diag([1 / 0.05**2, 0.0])
    mean = np.linalg.solve(precision, design.T @ Y / 0.1 + np.array([1.5 / 0.05**2, 0.0]))
    np.testing.assert_allclose([found.params["a"], found.params["b"]], mean, rtol=1e-6)
    np.testing.assert_allclose(
        [found.stderr_white["a"], found.stderr_white["b"]], np.sqrt(np.diag(np.linalg.inv(precision))), rtol=1e-6
    )
    assert found.residual.shape == (30,)


def test_a_prior_on_an_array_and_what_the_data_do_not_see():
    given = {"a": jnp.ones(2), "idle": 4.0}
    priors = {"idle": (3.0, 0.2), "a": (np.array([2.0, 0.4]), np.array([np.inf, 0.01]))}
    found = jeuler.fit(
        lambda p, y: p["a"][0] * X + p["a"][1] + 0 * p["idle"] - y, given, data=Y, sigma=0.1, priors=priors,
        progress=False,
    )  # fmt: skip
    assert not found.undetermined
    np.testing.assert_allclose([found.params["idle"], found.stderr["idle"]], [3.0, 0.2], rtol=1e-6)
    assert found.stderr_white["a"][1] < 0.01


def test_mass_with_a_prior_makes_ks_known():
    t = np.linspace(0, 3, 61)
    w = np.sqrt(9.0 - 0.25**2)
    x = 1 + 0.5 * np.exp(-0.25 * t) * (np.cos(w * t) + 0.25 / w * np.sin(w * t))
    x = x + 1e-3 * np.random.default_rng(1).normal(size=61)
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=4.0, kd=0.2, rest_length=1.0),))
    state = jeuler.ParticleState([[0.0], [1.5]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    found = jeuler.fit_springs(
        scene, state, t, np.stack([np.full(61, np.nan), x], 1)[..., None], dt=0.025, sigma=1e-3,
        parameters=("ks", "kd", "mass"), priors={"mass": (2.0, 0.1)}, progress=False,
    )  # fmt: skip
    assert not found.blind
    np.testing.assert_allclose(found.params["mass"], [2.0], rtol=1e-3)
    np.testing.assert_allclose(found.params["ks"], 18.0, rtol=0.01)
    np.testing.assert_allclose(found.stderr["ks"] / 18, 0.05, rtol=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": None}, "priors need sigma"),
        ({"priors": {"c": (0.0, 1.0)}}, "priors must name parameters, .* got 'c'"),
        ({"priors": 3.0}, "priors must be a dict"),
        ({"priors": {"a": 1.0}}, r"priors\['a'\] must be a pair \(mean, sigma\)"),
        ({"priors": {"a": (1.0, 0.0)}}, "sigma greater than 0"),
        ({"priors": {"a": (np.nan, 1.0)}}, "must be a finite mean"),
        ({"priors": {"a": (np.ones(3), 1.0)}}, "priors must be one value or a tree"),
        ({"loss": "huber"}, 'priors need loss="linear"'),
    ],
)
def test_bad_priors(change, message):
    arguments = {"sigma": 0.1, "priors": {"a": (1.0, 0.1)}, "data": Y} | change
    with pytest.raises(ValueError, match=message):
        jeuler.fit(line, {"a": 1.0, "b": 1.0}, progress=False, **arguments)
