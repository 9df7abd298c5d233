"""The engine of a fit: linear problems from anywhere, units, bounds, outliers, weights, tracing, resuming."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import curve_fit, least_squares

import jeuler

X = np.linspace(0, 1, 30)
Y = 2 + 3 * X + 0.05 * np.random.default_rng(1).normal(size=30)
RIGHT = np.linalg.lstsq(np.stack([np.ones(30), X], 1), Y, rcond=None)[0]


def line(p, data):
    return p["a"] + p["b"] * data["x"] - data["y"]


DATA = {"x": X, "y": Y}


@pytest.mark.parametrize("start", [(1, 1), (1, 1e-8), (1e-6, 1e-6), (1, 1e6), (0, 0), (-1e12, 1e12)])
def test_a_linear_problem_takes_two_iterations_from_anywhere(start):
    found = jeuler.fit(line, {"a": float(start[0]), "b": float(start[1])}, data=DATA)
    np.testing.assert_allclose([found.params["a"], found.params["b"]], RIGHT, rtol=1e-9)
    assert found.converged
    assert len(found.history) <= 3


def test_converged_means_that_the_gradient_is_small_against_the_columns_of_the_jacobian():
    """The relative offset of Bates and Watts, worked out here, after each number of iterations from a far start."""
    y = jnp.asarray(noisy(0))
    slope = jax.jacfwd(lambda x: decay({"a": x[0], "k": x[1]}, y))
    ends = []
    for most in range(1, 9):
        found = jeuler.fit(decay, {"a": 1.0, "k": 9.0}, data=y, max_iterations=most)
        x = jnp.stack([found.params["a"], found.params["k"]])
        q, r = np.linalg.qr(slope(x))[0], np.asarray(decay(found.params, y))
        along = np.sum((q.T @ r) ** 2)
        offset = np.sqrt(along / 2 / ((r @ r - along) / (len(r) - 2)))
        assert found.converged == (offset <= 1e-4), (most, offset)
        ends.append(found.converged)
    assert ends[:5] == [False] * 5  # the first steps gain little or much: neither counts
    assert ends[-1]


def test_stages_are_weights():
    """Each stage of a linear problem ends at the weighted least squares of its weights, fractions of 1 and more."""
    columns, weights = np.stack([np.ones(30), X], 1), np.linspace(0.1, 3, 30) ** 2
    found = jeuler.fit(line, {"a": 0.0, "b": 0.0}, data=DATA, stages=[weights, weights[::-1]])
    for loss, each in zip(found.history, (weights, weights[::-1], np.ones(30)), strict=True):
        root = np.sqrt(each)
        best = np.linalg.lstsq(columns * root[:, None], Y * root, rcond=None)[0]
        np.testing.assert_allclose(loss, np.mean((columns @ best - Y) ** 2), rtol=1e-9)
    for wrong in (-weights, np.where(X > 0.5, np.nan, 1.0)):
        with pytest.raises(ValueError, match="each of stages must be weights of 0 or more"):
            jeuler.fit(line, {"a": 0.0, "b": 0.0}, data=DATA, stages=[wrong])


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("of_data", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_units_change_nothing(unit, of_data, dtype):
    """Parameters in another unit, data in another unit: the same answer in the same number of iterations."""
    t = np.linspace(0, 2, 40)
    y = 1.5 * np.exp(-0.7 * t) + 0.01 * np.random.default_rng(2).normal(size=40)

    def residual(p, data):
        t, y = data
        return of_data * (p["a"] * jnp.exp(-p["k"] / unit * t) - y)

    def answer(unit_here):
        start = {"a": jnp.asarray(1.0, dtype), "k": jnp.asarray(0.2 * unit_here, dtype)}
        return jeuler.fit(residual, start, data=(jnp.asarray(t, dtype), jnp.asarray(y, dtype)))

    found = answer(unit)
    (a, k), covariance = curve_fit(lambda t, a, k: a * np.exp(-k * t), t, y, (1, 0.2))
    np.testing.assert_allclose(
        [found.params["a"], found.params["k"] / unit], [a, k], rtol=1e-6 if dtype == jnp.float64 else 1e-3
    )
    np.testing.assert_allclose(found.stderr_white["k"] / unit, np.sqrt(covariance[1, 1]), rtol=2e-3)
    assert found.converged


@pytest.mark.parametrize(
    ("bounds", "right"),
    [
        (None, RIGHT),
        ({"b": (None, 2.0)}, [np.mean(Y - 2 * X), 2.0]),
        ({"a": (2.5, None)}, [2.5, np.sum(X * (Y - 2.5)) / np.sum(X**2)]),
        ({"a": (0.0, 1.0), "b": (0.0, 1.0)}, [1.0, 1.0]),
        ((0.0, {"a": np.inf, "b": 2.0}), [np.mean(Y - 2 * X), 2.0]),
    ],
)
@pytest.mark.parametrize("start", [0.5, 0.9])
def test_bounds_hold_and_are_reached(bounds, right, start):
    begin = {
        "a": 2.5 + start if bounds and isinstance(bounds, dict) and bounds.get("a", (0,))[0] == 2.5 else start,
        "b": start,
    }
    found = jeuler.fit(line, begin, data=DATA, bounds=bounds)
    np.testing.assert_allclose([found.params["a"], found.params["b"]], right, rtol=1e-8)
    assert found.converged
    assert bool(found.at_bound) == (bounds is not None)
    assert ("ended on a bound" in found.message) == (bounds is not None)


def test_what_its_bounds_hold_has_no_error_and_the_others_are_those_without_it():
    held = jeuler.fit(line, {"a": 1.5, "b": 0.0}, data=DATA, bounds={"a": (1.5, 1.5)})
    alone = jeuler.fit(lambda p, data: line({"a": 1.5, **p}, data), {"b": 0.0}, data=DATA)
    assert (held.params["a"], held.stderr["a"], held.undetermined, held.at_bound) == (1.5, 0.0, (), ())
    np.testing.assert_allclose(held.stderr["b"], alone.stderr["b"], rtol=1e-9)
    np.testing.assert_allclose(held.profile("b").upper, alone.profile("b").upper, rtol=1e-6)
    assert held.profile("a").lower == held.profile("a").upper == 1.5


def test_many_bounded_parameters_agree_with_scipy(random):
    matrix, right = random.normal(size=(60, 12)), random.normal(size=60)
    scipys = least_squares(
        lambda x: matrix @ x - right, np.full(12, 0.05), bounds=(0, 0.2), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    found = jeuler.fit(lambda p: matrix @ p - right, jnp.full(12, 0.05), bounds=(0.0, 0.2))
    np.testing.assert_allclose(found.params, scipys.x, atol=1e-6)
    assert found.converged


def test_zero_is_reached_and_a_start():
    found = jeuler.fit(lambda p: p["k"] * X + p["b"] + X, {"k": 0.0, "b": 0.0}, positive={"k": True, "b": False})
    assert found.params["k"] == 0
    np.testing.assert_allclose(found.params["b"], -0.5, atol=1e-9)


def test_sigma_is_absolute_and_weights_are_relative():
    sigma = np.linspace(0.02, 0.1, 30)
    columns = np.stack([np.ones(30), X], 1)
    by_sigma = jeuler.fit(line, {"a": 1.0, "b": 1.0}, data=DATA, sigma=sigma)
    for absolute, found in (
        (True, by_sigma),
        (False, jeuler.fit(line, {"a": 1.0, "b": 1.0}, data=DATA, weights=1 / sigma**2)),
    ):
        best, covariance = curve_fit(lambda x, a, b: a + b * x, X, Y, sigma=sigma, absolute_sigma=absolute)
        np.testing.assert_allclose([found.params["a"], found.params["b"]], best, rtol=1e-6)
        np.testing.assert_allclose(
            [found.stderr_white["a"], found.stderr_white["b"]], np.sqrt(np.diag(covariance)), rtol=1e-6
        )
    assert np.isclose(by_sigma.noise_ratio, np.sqrt(30 * by_sigma.loss / 28))
    assert columns.shape == (30, 2)


def test_infinite_sigma_and_zero_weight_leave_out():
    spoilt = {**DATA, "y": np.where(np.arange(30) == 7, np.nan, Y)}
    right = np.linalg.lstsq(np.delete(np.stack([np.ones(30), X], 1), 7, 0), np.delete(Y, 7), rcond=None)[0]
    for option in (
        {"sigma": np.where(np.arange(30) == 7, np.inf, 0.05)},
        {"weights": np.where(np.arange(30) == 7, 0.0, 1.0)},
    ):
        found = jeuler.fit(line, {"a": 1.0, "b": 1.0}, data=spoilt, **option)
        np.testing.assert_allclose([found.params["a"], found.params["b"]], right, rtol=1e-9)


@pytest.mark.parametrize("loss", ["soft_l1", "huber"])
def test_robust_losses_agree_with_scipy_and_find_the_line_under_outliers(loss):
    y = np.where(np.arange(30) % 6 == 0, Y + 5, Y)
    scipys = least_squares(lambda p: p[0] + p[1] * X - y, [1.0, 1.0], loss=loss, f_scale=0.1, xtol=1e-14, ftol=1e-14)
    found = jeuler.fit(line, {"a": 1.0, "b": 1.0}, data={"x": X, "y": y}, loss=loss, loss_scale=0.1)
    np.testing.assert_allclose([found.params["a"], found.params["b"]], scipys.x, rtol=1e-4)
    by_itself = jeuler.fit(line, {"a": 1.0, "b": 1.0}, data={"x": X, "y": y}, loss=loss)
    squares = jeuler.fit(line, {"a": 1.0, "b": 1.0}, data={"x": X, "y": y})
    assert abs(by_itself.params["a"] - 2) < 0.15 < abs(squares.params["a"] - 2)


def test_a_second_fit_of_the_same_shape_compiles_nothing(compiled):
    jeuler.fit(line, {"a": 1.0, "b": 1.0}, data=DATA)
    before = len(compiled)
    for seed in range(5):
        y = Y + np.random.default_rng(seed).normal(size=30)
        jeuler.fit(line, {"a": 1.0 + seed, "b": 1.0}, data={"x": X, "y": y}, progress=False)
    assert len(compiled) == before


def decay(p, y):
    return p["a"] * jnp.exp(-p["k"] * jnp.linspace(0, 2, 25)) - y


def noisy(seed):
    return 2 * np.exp(-1.3 * np.linspace(0, 2, 25)) + 0.02 * np.random.default_rng(seed).normal(size=25)


def test_a_hyper_gradient_through_a_closure():
    y = jnp.asarray(noisy(4))

    def chosen(h):
        found = jeuler.fit(
            lambda p: jnp.concatenate([decay(p, y), h * jnp.stack([p["k"] - 1.0])]),
            {"a": 1.0, "k": 0.5},
            tolerance=1e-9,
        )
        return found.params["k"]

    slope = jax.jit(jax.grad(chosen))(0.3)
    np.testing.assert_allclose(slope, (chosen(0.3 + 1e-5) - chosen(0.3 - 1e-5)) / 2e-5, rtol=1e-4)


def test_many_starts_find_the_best_of_many_minima():
    t = np.linspace(0, 10, 200)
    y = np.sin(4.0 * t)
    alone = jeuler.fit(lambda p, y: jnp.sin(p["w"] * t) - y, {"w": 2.0}, data=y)
    assert alone.loss > 0.1
    found = jeuler.fit(lambda p, y: jnp.sin(p["w"] * t) - y, {"w": 2.0}, data=y, positive=True, starts=64)
    np.testing.assert_allclose(found.params["w"], 4.0, rtol=1e-6)
    assert found.starts["loss"].shape == found.starts["params"]["w"].shape == (64,)
    assert np.nanmin(found.starts["loss"]) <= found.starts["loss"][0]


RESUMED = """
import sys, time
import jax, jax.numpy as jnp, numpy as np, jeuler
jax.config.update("jax_enable_x64", True)
t = np.linspace(0, 3, 50)
def residual(p, y):
    jax.debug.callback(lambda: time.sleep(float(sys.argv[2])))
    return p["a"] * jnp.exp(-p["k"] * t) * jnp.cos(p["w"] * t) - y
y = 2 * np.exp(-0.5 * t) * np.cos(6 * t) + 0.1 * np.sin(31 * t)
for resume in (sys.argv[1], None):
    found = jeuler.fit(residual, {"a": 1.0, "k": 0.1, "w": 5.2}, data=y, resume=resume, progress=False)
    print(repr({k: float(v) for k, v in found.params.items()}), len(found.history))
"""


def test_killed_and_taken_up_again_it_ends_at_the_same_result(tmp_path):
    script, state = tmp_path / "fit.py", tmp_path / "state.npz"
    script.write_text(textwrap.dedent(RESUMED))

    def command(*arguments):
        return [sys.executable, str(script), *arguments]

    with subprocess.Popen(command(str(state), "0.7")) as running:
        while not state.exists():
            time.sleep(0.05)
            assert running.poll() is None
        time.sleep(1.0)
        os.kill(running.pid, signal.SIGKILL)
    again = subprocess.run(command(str(state), "0"), capture_output=True, text=True, timeout=120, check=True).stdout
    resumed, whole = again.splitlines()
    assert resumed == whole
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".jeuler")] == []


def test_ctrl_c_returns_the_best_so_far(monkeypatch):
    from jeuler.fitting import minimise

    def interrupted_at_the_third(self, stage, state, history, counted):
        if len(history) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(minimise.Watch, "see", interrupted_at_the_third)
    found = jeuler.fit(decay, {"a": 1.0, "k": 0.01}, data=jnp.asarray(noisy(5)), tolerance=1e-12)
    assert found.message.startswith("interrupted: the best so far")
    assert not found.converged
    assert len(found.history) == 3
