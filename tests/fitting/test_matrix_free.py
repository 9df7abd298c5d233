"""Fits without a Jacobian: the same answers as with one, between bounds, with outliers, interrupted and taken up."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import jeuler
from jeuler.fitting import matrix_free, minimise
from jeuler.fitting import problem as problems
from jeuler.fitting import report as reports
from jeuler.fitting.matrix_free import conjugate_gradients
from jeuler.fitting.nearby import from_nearby

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
    def switch(most_errors=0):
        monkeypatch.setattr(problems, "MOST_COLUMNS", 0)
        monkeypatch.setattr(reports, "MOST_COLUMNS", 0)
        monkeypatch.setattr(matrix_free, "MOST_ERRORS", most_errors)

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
    np.testing.assert_allclose(found.standard_error("a[1]"), formed.stderr["a"][1], rtol=0.3)
    for name in TRUTH:
        np.testing.assert_allclose(found.params[name], formed.params[name], atol=0.1 * np.max(formed.stderr[name]))
    assert found.at_bound == formed.at_bound


def largest(jaxpr):
    """The most numbers that one array in a program has, programs within it included."""
    inner = [
        p for e in jaxpr.eqns for p in jax.tree.leaves(list(e.params.values()), is_leaf=lambda p: hasattr(p, "eqns"))
    ]
    inner = [getattr(p, "jaxpr", p) for p in inner if hasattr(p, "eqns")]
    own = [np.prod(v.aval.shape) for e in jaxpr.eqns for v in e.outvars if hasattr(v.aval, "shape")]
    return max([*own, *map(largest, inner)], default=0)


def test_a_step_and_its_cost_form_no_jacobian():
    """60 unknowns and 1,800 residuals: a Jacobian has 108,000 numbers, eight probes of its columns 16,200."""
    x = {"a": np.full(30, 1.5), "k": np.ones(30)}
    problem = problems.Problem.of(residual, x, data=np.ones((60, 30)))
    task, own = problem.task(1e-4), matrix_free.products(problem.residual, "soft_l1")
    at, zero = jnp.asarray(problem.x), jnp.asarray(0.1)
    programs = [jax.make_jaxpr(own.cost)(at, task), jax.make_jaxpr(own.step)(at, task, zero, zero, zero)]
    assert 1800 <= max(largest(program.jaxpr) for program in programs) <= 16_200


def test_far_from_the_minimum_it_does_not_say_converged(without_a_jacobian):
    without_a_jacobian()
    found = jeuler.fit(residual, {"a": np.ones(6), "k": np.full(6, 3.0)}, data=data(), max_iterations=2)
    assert not found.converged
    assert found.message.startswith("stopped before it converged")
    assert len(found.history) == 2


@pytest.mark.optimised
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


def test_springs_and_the_bias_of_the_step_are_those_of_the_fit_that_forms_a_jacobian(without_a_jacobian):
    """50 steps of 0.1 s and of 0.01 s, so that both share their programs."""
    w, g, found = np.sqrt(100 - 0.04), 0.2, {}
    state = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], 80.0, 0.2, 1.0),))
    for most_errors in (None, 10, 0):
        if most_errors is not None:
            without_a_jacobian(most_errors)
        for dt in (0.1, 0.01):
            times = np.linspace(0, 50 * dt, 101)
            y = np.full((101, 2, 1), np.nan)
            y[:, 1, 0] = 1 + 0.3 * np.exp(-g * times) * (np.cos(w * times) + g / w * np.sin(w * times))
            y[:, 1, 0] += 1e-3 * np.random.default_rng(0).normal(size=101)
            found[most_errors, dt] = jeuler.fit_springs(scene, state, times, y, dt=dt)
    for dt in (0.1, 0.01):
        formed, many, asked = (found[most_errors, dt] for most_errors in (None, 10, 0))
        assert asked.covariance is None
        assert many.covariance is not None
        assert asked.start == "data"
        assert asked.predicted.shape == (101, 2, 1)
        assert ("moves the unknowns by" in asked.message) == ("the integrator's error" in formed.message) == (dt == 0.1)
        for name, truth in (("ks", 100.0), ("kd", 0.4)):
            error = float(formed.stderr[name])
            for other in (many, asked):
                np.testing.assert_allclose(other.step_bias[name], formed.step_bias[name], rtol=0.1, atol=0.03 * error)
            bias = abs(float(asked.step_bias[name]))
            assert abs(asked.params[name] - asked.step_bias[name] - truth) < 4 * error + 0.25 * bias


def test_conjugate_gradients_solve_and_say_what_is_left(random):
    root = random.normal(size=(40, 12))
    matrix, b = root.T @ root, random.normal(size=12)
    s, left, more = conjugate_gradients(lambda s: matrix @ s, jnp.asarray(b), 0.05, lambda total: 0.0)
    best = np.linalg.solve(matrix, b)
    np.testing.assert_allclose(left, b - matrix @ s, atol=1e-12)
    assert b @ best * 0.95 < 2 * b @ s - s @ matrix @ s <= b @ best + 1e-12
    assert 0 <= more <= 0.05 * b @ best
    s, _, more = conjugate_gradients(lambda s: 0 * s, jnp.asarray(b), 0.05, lambda total: 0.0)
    assert more == 0
    np.testing.assert_array_equal(s, 0)  # nothing is seen: nothing moves


@pytest.mark.parametrize("rho", [0.0, 0.9])
@pytest.mark.parametrize("sigma", [None, 0.01])
def test_errors_of_many_unknowns_are_those_of_few(rho, sigma, without_a_jacobian):
    noise = lfilter([1], [1, -rho], np.random.default_rng(4).normal(size=(260, 6)), axis=0)[-60:]
    y, x = np.asarray(residual(TRUTH, 0.0)) + 0.01 * noise, {"a": np.ones(6), "k": np.ones(6)}
    few = jeuler.fit(residual, x, data=y, sigma=sigma)
    without_a_jacobian(most_errors=12)
    many = jeuler.fit(residual, x, data=y, sigma=sigma)
    without_a_jacobian()
    asked = jeuler.fit(residual, x, data=y, sigma=sigma)
    for name in TRUTH:
        np.testing.assert_allclose(many.stderr_white[name], few.stderr_white[name], rtol=1e-3)
        np.testing.assert_allclose(many.stderr[name], few.stderr[name], rtol=0.15)

    def ratio(p):
        return p["a"][0] / p["k"][0]

    assert many.standard_error(ratio) == pytest.approx(few.standard_error(ratio), rel=0.15)
    assert asked.standard_error(ratio) == pytest.approx(few.standard_error(ratio), rel=0.3)
    np.testing.assert_allclose(many.autocorrelation, few.autocorrelation, atol=0.1)


@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
def test_profiles_of_many_unknowns_are_those_of_few(loss, without_a_jacobian):
    """Between bounds, with the errors of all unknowns and with those that are asked for; noise that makes it bend."""
    noise = 0.1 * np.random.default_rng(5).normal(size=(60, 6))
    x = {"a": np.full(6, 1.5), "k": np.ones(6)}
    options = {"data": np.asarray(residual(TRUTH, 0.0)) + noise, "bounds": {"a": (0.0, 3.0)}, "loss": loss}
    options |= {"loss_scale": 0.2} if loss != "linear" else {}
    names, ends = ("a[0]", "a[5]", "k[1]"), {}
    for most_errors in (None, 12, 0):
        if most_errors is not None:
            without_a_jacobian(most_errors)
        found = jeuler.fit(residual, x, **options)
        ends[most_errors] = [found.profile(name) for name in names]
        assert all(interval.converged for interval in ends[most_errors])
    for few, many, asked in zip(*ends.values(), strict=True):
        for other in (many, asked):
            np.testing.assert_allclose(
                [other.lower, other.upper], [few.lower, few.upper], atol=0.02 * (few.upper - few.lower)
            )
    assert ends[0][1].upper == 3.0


def test_what_many_data_do_not_determine_is_named(without_a_jacobian):
    without_a_jacobian(most_errors=3)
    x = np.linspace(0.0, 1.0, 30)
    noise = 0.01 * np.random.default_rng(0).normal(size=30)
    found = jeuler.fit(
        lambda p, y: p["a"] * p["b"] * x + p["c"] - y,
        {"a": 1.0, "b": 2.0, "c": 0.0},
        data=3 * x + noise,
        bounds={"a": (0.0, None), "b": (0.0, None)},
    )
    assert found.blind == ("a and b only as their product",)
    assert found.standard_error("a") == np.inf
    assert 0 < found.standard_error(lambda p: p["a"] * p["b"]) < 0.02
    assert 0 < float(found.stderr["c"]) < 0.01
    without_a_jacobian()
    asked = jeuler.fit(lambda p, y: p["a"] * x - y + 0 * p["b"], {"a": 1.0, "b": 2.0}, data=3 * x + noise)
    assert asked.standard_error("b") == np.inf
    assert 0 < asked.standard_error("a") < 0.01


def test_the_best_of_several_starts_is_kept(without_a_jacobian):
    without_a_jacobian()
    t = np.linspace(0.0, 10.0, 101)

    def swing(p, y):
        return jnp.cos(p["w"] * t) - y

    far = {"w": 9.0}
    assert not jeuler.fit(swing, far, data=np.cos(2 * t)).explained
    found = jeuler.fit(swing, far, data=np.cos(2 * t), positive=True, starts=24)
    np.testing.assert_allclose(found.params["w"], 2.0, rtol=1e-6)
    assert found.starts["loss"].shape == (24,)


def test_what_is_asked_for_in_vain_is_said(without_a_jacobian):
    found = jeuler.fit(residual, {"a": np.ones(6), "k": np.ones(6)}, data=data())
    for of, words in (("b", "of must be one of"), (lambda p: p["a"], "one number"), (3, "of must be")):
        with pytest.raises(ValueError, match=words):
            found.standard_error(of)
    with pytest.raises(ValueError, match="of must have a finite derivative"):
        found.standard_error(lambda p: jnp.sqrt(p["a"][0] - p["a"][0]))
    without_a_jacobian()
    with pytest.raises(ValueError, match="fit again"):
        copy.copy(jeuler.fit(residual, {"a": np.ones(6), "k": np.ones(6)}, data=data())).standard_error("a[0]")


@pytest.mark.parametrize(("start", "less", "near"), [(1.02, None, True), (1.02, 0.01, True), (2.0, None, False)])
def test_one_jacobian_leads_to_a_minimum_that_is_near(start, less, near):
    """Between bounds too; from further away it says so, and the search that forms none begins."""
    y, bounds, x = data(), None, jax.tree.map(lambda p: start * p, TRUTH)
    if less is not None:
        bounds = {"a": (0.0, TRUTH["a"] - less)}
        x["a"] = 0.98 * TRUTH["a"]
    best = jeuler.fit(residual, x, data=y, bounds=bounds, progress=False)
    problem = problems.Problem.of(residual, x, data=y, bounds=bounds)
    evaluate, history = problems.programs(problem.residual, problem.data), []
    with minimise.progress_bar(False, 1) as bar:
        found = from_nearby(
            evaluate, np.asarray(problem.x, float), problem.task(1e-4), 200, history, minimise.Watch(bar)
        )
    assert (found is not None) == near
    if near:
        off = np.abs(found.x - problem.layout.vector(best.params))
        assert np.max(off - 0.05 * problem.layout.vector(best.stderr)) <= 0
        np.testing.assert_allclose(found.total, len(y.ravel()) * best.loss, rtol=1e-3)
        assert found.total == history[-1]
        assert np.sum(found.x >= problem.upper) == len(best.at_bound)
        assert (len(best.at_bound) > 2) == (less is not None)
