"""What the data would determine, and how far a parameter can go."""

import jax.numpy as jnp
import numpy as np
import pytest

import jeuler

STATE = jeuler.ParticleState([[0.0], [1.5]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
SCENE = jeuler.Scene((jeuler.Springs([[0, 1]], ks=9.0, kd=0.5, rest_length=1.0),))
TIMES = np.linspace(0, 3, 61)


def test_errors_foretold_are_those_of_the_fit(random):
    foretold = jeuler.identifiability(SCENE, STATE, TIMES, sigma=1e-3)
    decay, w = 0.25, np.sqrt(9 - 0.0625)
    y = np.full((61, 2, 1), np.nan)
    y[:, 1, 0] = 1 + 0.5 * np.exp(-decay * TIMES) * (np.cos(w * TIMES) + decay / w * np.sin(w * TIMES))
    y[:, 1, 0] += 1e-3 * random.normal(size=61)
    found = jeuler.fit_springs(SCENE, STATE, TIMES, y, dt=0.025, sigma=1e-3)
    for name in ("ks", "kd"):
        np.testing.assert_allclose(foretold.stderr[name], found.stderr_white[name], rtol=0.02)
    assert foretold.undetermined == ()
    assert "all parameters would be determined" in foretold.message


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("ks", "kd", "mass"), ("kd, ks and mass only as their ratios",)),
        (("ks", "mass"), ("ks and mass only as their ratio",)),
        (("anchors", "rest_length"), ("a combination",)),
    ],
)
def test_blind_combinations_are_named_before_there_are_data(names, words):
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=9.0, kd=0.0 if "kd" not in names else 0.5, rest_length=1.0),))
    found = jeuler.identifiability(scene, STATE, TIMES, names)
    if names == ("anchors", "rest_length"):
        assert len(found.blind) == 1
        assert "sum" in found.blind[0]
    else:
        assert found.blind == words
    assert len(found.undetermined) >= 2


def test_a_spring_that_never_moves_is_named():
    state = jeuler.ParticleState([[0.0], [1.0], [2.5]], jnp.zeros((3, 1)), mass=[jnp.inf, jnp.inf, 1.0])
    scene = jeuler.Scene((jeuler.Springs([[0, 1], [1, 2]], ks=[9.0, 9.0], kd=0.5, rest_length=1.0),))
    found = jeuler.identifiability(scene, state, TIMES, ("ks",))
    assert found.blind == ("ks[0]",)
    assert np.isfinite(found.stderr["ks"][1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": 0.0}, "sigma must be greater than 0"),
        ({"observed": [1, 0]}, "observed must be booleans of shape"),
        ({"parameters": ("stiffness",)}, "parameters must be among"),
        ({"times": TIMES[::-1]}, "times must not decrease"),
        ({"times": [0.0, 5000.0], "dt": 10.0}, "the motion is not finite.*smaller dt"),
    ],
)
def test_bad_input(change, message):
    with pytest.raises(ValueError, match=message):
        jeuler.identifiability(SCENE, STATE, **{"times": TIMES, **change})


def test_a_profile_of_a_linear_problem_is_its_standard_error(random):
    x = np.linspace(0, 1, 30)
    y = 2 + 3 * x + 0.05 * random.normal(size=30)
    found = jeuler.fit(lambda p: p["a"] + p["b"] * x - y, {"a": 1.0, "b": 1.0})
    interval = found.profile("b")
    half = 1.96 * float(found.stderr["b"])
    np.testing.assert_allclose(
        [interval.lower, interval.upper], [found.params["b"] - half, found.params["b"] + half], rtol=1e-2
    )
    assert interval.values[0] <= interval.lower
    np.testing.assert_allclose(interval.distances[-1], 1.96, atol=0.01)


def test_a_profile_knows_bounds_and_what_nothing_stops(random):
    x = np.linspace(0, 1, 30)
    y = 0.001 * x + 0.05 * random.normal(size=30)
    found = jeuler.fit(lambda p: p["k"] * x + p["b"] - y, {"k": 0.005, "b": 0.0}, bounds={"k": (0.0, 0.01)})
    assert found.profile("k").lower == 0.0
    assert found.profile("k").upper == 0.01
    free = jeuler.fit(lambda p: p["a"] * p["b"] * x - 3 * x - 0.01 * np.sin(40 * x), {"a": 1.0, "b": 1.0})
    assert np.isinf(free.profile("a").upper)
    with pytest.raises(ValueError, match="name must be one of a, b, got 'c'"):
        free.profile("c")
    with pytest.raises(ValueError, match="level must lie between 0 and 1"):
        free.profile("a", level=95)


def test_a_profile_is_lopsided_where_the_problem_is_not_linear():
    x = np.linspace(0, 1, 12)
    y = np.exp(-1.0 * x) + 0.1 * np.cos(9 * x)
    found = jeuler.fit(lambda p: p["a"] * jnp.exp(-p["k"] * x) - y, {"a": 1.0, "k": 1.0})
    interval = found.profile("k")
    below, above = found.params["k"] - interval.lower, interval.upper - found.params["k"]
    assert 0 < below < above
