"""compare_fits: models told apart where the record tells them apart, and only there."""

import jax.numpy as jnp
import numpy as np
import pytest

import jeuler

X = np.linspace(0.0, 1.0, 200)
MODELS = {
    "line": (lambda p, d: p["a"] + p["b"] * X - d, {"a": 0.0, "b": 0.0}),
    "bent": (lambda p, d: p["a"] + p["b"] * X + p["c"] * X**2 - d, {"a": 0.0, "b": 0.0, "c": 0.0}),
    "exponential": (lambda p, d: p["a"] * jnp.exp(p["b"] * X) - d, {"a": 1.0, "b": 0.0}),
}


def fitted(model, data, **options):
    residual, start = MODELS[model]
    return jeuler.fit(residual, start, data=jnp.asarray(data), **options)


def noise(random, rho=0.0):
    e = random.normal(size=len(X))
    for k in range(1, len(e)):
        e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * e[k]
    return 0.02 * e


@pytest.mark.parametrize("rho", [0.0, 0.95])
@pytest.mark.parametrize("options", [{}, {"sigma": 0.02}])
def test_a_term_that_is_not_there_is_not_found_in_noise_also_if_it_is_correlated(rho, options):
    """Of 40 records of a line, the bent model is preferred in few: BIC's own rate is about 2 %."""
    random = np.random.default_rng(5)
    found = []
    for _ in range(40):
        data = 1 - X + noise(random, rho)
        found.append(jeuler.compare_fits(*(fitted(model, data, **options) for model in ("line", "bent"))))
    assert sum(each.better == "second" for each in found) <= 4
    assert np.median([each.independent for each in found]) < (25 if rho else 201)


def test_a_term_that_is_there_is_found_and_exchanging_the_models_exchanges_the_answer(random):
    data = np.exp(-2 * X) + noise(random)
    line, bent, exponential = (fitted(model, data, sigma=0.02) for model in MODELS)
    found, turned = jeuler.compare_fits(line, exponential), jeuler.compare_fits(exponential, line)
    assert (found.better, turned.better) == ("second", "first")
    assert found.difference == -turned.difference > 100
    assert "speaks very strongly for the second model" in found.message
    assert found.unknowns == (2, 2)
    # two parabola-like curves: three parameters are not better than the two that made the data
    assert jeuler.compare_fits(bent, exponential).better == "second"
    assert jeuler.compare_fits(line, line).better == "neither"


def test_fits_of_different_records_or_weights_are_refused(random):
    a, b = (fitted("line", 1 - X + noise(random), sigma=0.02) for _ in range(2))
    with pytest.raises(ValueError, match="fits of the same data with the same weights"):
        jeuler.compare_fits(a, fitted("line", 1 - X))
    with pytest.raises(ValueError, match="must be a Fit"):
        jeuler.compare_fits(a, 3.0)
    with pytest.raises(ValueError, match="different measured values"):
        jeuler.compare_fits(a, b)
