"""fit: known answers, textbook errors, positive parameters, non-finite values, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import curve_fit

import jeuler

T = np.linspace(0, 3, 40)


def model(t, a, k, b):
    return a * np.exp(-k * t) + b


@pytest.fixture
def noisy(random):
    return model(T, 2.0, 1.5, 0.3) + 0.02 * random.standard_normal(len(T))


def residual_of(data):
    return lambda p: p["a"] * jnp.exp(-p["k"] * T) + p["b"] - data


START = {"a": 1.0, "k": 0.5, "b": 0.1}


def test_parameters_and_errors_agree_with_scipy(noisy):
    found = jeuler.fit(residual_of(noisy), START)
    best, covariance = curve_fit(model, T, noisy, p0=(1.0, 0.5, 0.1))
    order = ["a", "b", "k"]  # of ravel_pytree
    scipys = dict(zip("akb", best, strict=True))
    for name in order:
        np.testing.assert_allclose(found.params[name], scipys[name], rtol=1e-4)
    shuffle = ["akb".index(name) for name in order]
    np.testing.assert_allclose(found.covariance, covariance[np.ix_(shuffle, shuffle)], rtol=1e-3, atol=1e-9)
    for k, name in enumerate(order):
        np.testing.assert_allclose(found.stderr[name] ** 2, found.covariance[k, k], rtol=1e-12)
    assert found.converged
    assert found.nonfinite == 0
    np.testing.assert_allclose(found.loss, np.mean(residual_of(noisy)(found.params) ** 2), rtol=1e-10)


def test_positive_parameters_agree_with_free_ones(noisy):
    free = jeuler.fit(residual_of(noisy), START)
    log = jeuler.fit(residual_of(noisy), START, positive={"a": True, "k": True, "b": False})
    for name in START:
        np.testing.assert_allclose(log.params[name], free.params[name], rtol=1e-4)
        np.testing.assert_allclose(log.stderr[name], free.stderr[name], rtol=1e-3)


@pytest.mark.parametrize("optimizer", [optax.adam(0.05), optax.lbfgs()], ids=["adam", "lbfgs"])
def test_any_optax_optimiser(noisy, optimizer):
    reference = jeuler.fit(residual_of(noisy), START)
    found = jeuler.fit(residual_of(noisy), START, positive=True, optimizer=optimizer, max_iterations=400)
    for name in START:
        np.testing.assert_allclose(found.params[name], reference.params[name], rtol=2e-3)
    assert len(found.history) <= 800


def test_returns_the_best_seen_not_the_last():
    """A step size so large that descent jumps about the valley."""
    found = jeuler.fit(lambda p: p, jnp.array([3.0]), optimizer=optax.sgd(0.95), max_iterations=30)
    assert found.loss == found.history.min()
    np.testing.assert_allclose(found.params**2, found.loss)
    wild = jeuler.fit(lambda p: p, jnp.array([3.0]), optimizer=optax.sgd(1.2), max_iterations=60)
    assert wild.history[-1] > wild.history[0]
    np.testing.assert_allclose(wild.params, 3.0)
    assert not wild.converged  # the loss stood still, at its start
    assert "this is no minimum" in wild.message


@pytest.mark.parametrize("optimizer", [None, optax.adam(0.5), optax.sgd(50.0)], ids=["lm", "adam", "sgd"])
def test_backs_off_from_non_finite_values(optimizer):
    """The residual is NaN beyond p = 2; the best finite point lies just before."""

    def residual(p):
        return jnp.where(p < 2, p - 5.0, jnp.nan)

    found = jeuler.fit(residual, jnp.array([0.0]), optimizer=optimizer, max_iterations=60)
    assert np.isfinite(found.loss)
    assert np.isfinite(found.params).all()
    assert 0 <= found.params[0] < 2
    assert found.nonfinite > 0
    assert "not finite" in found.message


def test_says_what_the_data_do_not_determine():
    found = jeuler.fit(
        lambda p: p["a"] * p["b"] * T + p["c"] - 3.0 * T - 1.0,
        {"a": 1.0, "b": 1.0, "c": 0.5, "idle": jnp.array([7.0, 8.0])},
        positive=True,
    )
    np.testing.assert_allclose(found.params["a"] * found.params["b"], 3.0, rtol=1e-5)
    np.testing.assert_allclose(found.params["c"], 1.0, rtol=1e-5)
    assert found.params["idle"].tolist() == [7.0, 8.0]
    assert set(found.undetermined) == {"a", "b", "idle[0]", "idle[1]"}
    assert np.isinf(found.stderr["a"])
    assert np.isfinite(found.stderr["c"])
    assert "do not determine" in found.message


def test_float32():
    with jax.enable_x64(False):
        t = jnp.linspace(0.0, 2.0, 20)
        found = jeuler.fit(lambda k: jnp.exp(-k * t) - jnp.exp(-1.5 * t), jnp.float32(0.5), positive=True)
        np.testing.assert_allclose(found.params, 1.5, rtol=1e-4)
        assert found.params.dtype == jnp.float32


def test_no_more_residuals_than_parameters():
    found = jeuler.fit(lambda p: p - jnp.array([1.0, 2.0]), jnp.zeros(2))
    np.testing.assert_allclose(found.params, [1.0, 2.0], atol=1e-6)
    assert not np.isnan(found.covariance).any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: jeuler.fit(lambda p: p, jnp.array([1])), "params must be floating, got int"),
        (
            lambda: jeuler.fit(lambda p: p, {"k": -1.0}, positive=True),
            r"the start of k must be not below its lower bound, got -1",
        ),
        (lambda: jeuler.fit(lambda p: p, jnp.array([1.0, jnp.nan])), r"params\[1\] must be finite, got nan"),
        (lambda: jeuler.fit(lambda p: p, {"k": 1.0}, positive={"c": True}), "positive must be one value or a tree"),
        (lambda: jeuler.fit(lambda p: jnp.log(-p), jnp.array([1.0])), "residual is not finite at the start"),
        (lambda: jeuler.fit(lambda p: p[:0], jnp.array([1.0])), "must not be empty"),
        (lambda: jeuler.fit(lambda p: p, jnp.array([1.0]), max_iterations=0), "max_iterations must be at least 1"),
        (lambda: jeuler.fit(lambda p: p, jnp.array([1.0]), tolerance=0), "tolerance must be greater than 0"),
        (lambda: jeuler.fit(lambda p: p, jnp.array([1.0]), stages=[jnp.ones(2)]), "one weight a residual, 1, got 2"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("unit", "explains"), [(1.0, True), (1e-9, True), (None, False)])
def test_the_share_explained_is_known_where_data_are_what_the_model_is_compared_with(unit, explains):
    """Not where they are what the model is a function of."""
    x = np.linspace(0, 1, 40)
    y = (unit or 1.0) * (3 * x + 0.5 * np.sin(25 * x))
    if unit is None:
        found = jeuler.fit(lambda p, x: p["a"] * x - y, {"a": 1.0}, data=x)
        assert found.explained is None
        return
    found = jeuler.fit(lambda p, y: p["a"] * x - y, {"a": unit}, data=y, priors={"a": (0.0, 1e9)}, sigma=unit)
    np.testing.assert_allclose(
        found.explained, 1 - np.sum((found.params["a"] * x - y) ** 2) / np.sum((y - y.mean()) ** 2)
    )


def lorenz(t, y, p):
    x, v, z = y
    return jnp.stack([p["s"] * (v - x), x * (p["r"] - z) - v, x * v - p["b"] * z])


def test_a_chaotic_record_ends_at_the_truth_or_says_what_is_wrong():
    """30 s of Lorenz's equations: only the growing horizon reaches the truth from (5, 20, 1)."""
    t, truth = np.linspace(0, 30, 301), {"s": 10.0, "r": 28.0, "b": 8 / 3}

    def model(p):
        start = jnp.ones(3)
        return jeuler.solve(lorenz, start, dt=0.01, num_steps=3000, save_every=10, step=jeuler.rk4_step, args=p).y

    def residual(p, y):
        return model(p) - y

    y, start = np.asarray(model(truth)), {"s": 5.0, "r": 20.0, "b": 1.0}
    wrong = jeuler.fit(residual, start, data=y, max_iterations=40)
    assert not wrong.converged
    assert wrong.explained < 0.5
    for words in ("stopped before it converged", "explains only", "fit the first part", "not those of a minimum"):
        assert words in wrong.message
    horizons = [np.repeat(t <= end, 3).astype(float) for end in (1, 2, 4, 8, 15)]
    right = jeuler.fit(residual, start, data=y, stages=horizons)
    assert right.converged
    assert right.explained > 1 - 1e-9
    np.testing.assert_allclose([right.params[name] for name in truth], list(truth.values()), rtol=1e-6)
