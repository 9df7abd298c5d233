"""A start from the data alone: meshes, drags, gravity, shared and tied parameters, and fits that need no guess."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from fitting.test_springs import solve_tight
from scipy.spatial import Delaunay

import jeuler
from jeuler.fitting.nonnegative import nonnegative_least_squares
from jeuler.fitting.parameters import Places
from jeuler.fitting.weak_form import weak_form


def mesh(random, particles=12):
    """A 3-D Delaunay mesh, thrown: edges, rest lengths, stiffness and damping over a decade."""
    x = random.uniform(0, 1.3, size=(particles, 3))
    pairs = {tuple(sorted((int(a), int(b)))) for s in Delaunay(x).simplices for a in s for b in s if a != b}
    edges = np.array(sorted(pairs))
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    ks, kd = 50 * 10 ** random.uniform(size=len(edges)), 0.3 * 10 ** random.uniform(size=len(edges))
    return x, random.normal(size=x.shape), edges, length, ks, kd


def recorded(scene, x, v, mass, times, random, noise=1e-3):
    clean = solve_tight(scene, x, v, mass, times)
    return clean + noise * np.std(clean - clean.mean(axis=0)) * random.normal(size=clean.shape)


def test_every_spring_of_a_mesh_from_its_tracks_alone(random):
    x, v, edges, length, ks, kd = mesh(random)
    times = np.linspace(0, 1, 51)
    y = recorded(jeuler.Scene((jeuler.Springs(edges, ks, kd, length),)), x, v, np.ones(len(x)), times, random)
    state = jeuler.ParticleState(x, v, np.ones(len(x)))
    start = jeuler.Scene((jeuler.Springs(edges, 0 * ks, 0 * kd, length),))
    places = Places.of(state, ("ks", "kd"), None)
    found = weak_form(start, state, times, y, places, places.read(start, state))
    assert np.median(np.abs(found.params["ks"] / ks - 1)) < 0.005
    assert np.median(np.abs(found.params["kd"] / kd - 1)) < 0.04
    assert found.singular_values.min() > 0
    fitted = jeuler.fit_springs(start, state, times, y, dt=0.01)
    assert fitted.start == "data"
    assert fitted.converged
    assert 0.7 < fitted.noise_ratio < 1.3
    far = jeuler.Scene((jeuler.Springs(edges, 1.5 * ks, 1.5 * kd, length),))
    given = jeuler.fit_springs(far, state, times, y, dt=0.01, start="given")
    for found in (fitted, given):
        z = np.concatenate([(found.params[n] - truth) / found.stderr[n] for n, truth in (("ks", ks), ("kd", kd))])
        assert np.sqrt(np.mean(z**2)) < 1.5


def test_what_enters_linearly_beside_springs(random):
    """Gravity, a drag, and one ks for all springs; rest lengths from ks and ks L."""
    edges = [(0, 1), (1, 2), (2, 3)]
    x = np.array([[0.0, 0.0], [1.1, 0.0], [2.0, -0.2], [3.1, 0.1]])
    v, mass = random.normal(size=x.shape), np.array([np.inf, 1.0, 2.0, 0.5])
    v[0] = 0
    right = jeuler.Scene(
        (jeuler.Gravity([0.3, -9.81]), jeuler.LinearDrag(0.2), jeuler.Springs(edges, 80.0, 0.6, [1.0, 0.8, 1.2]))
    )
    times = np.linspace(0, 3, 151)
    y = recorded(right, x, v, mass, times, random, noise=3e-4)
    state = jeuler.ParticleState(x, v, mass)
    guess = jeuler.Scene(
        (jeuler.Gravity([0.0, -1.0]), jeuler.LinearDrag(1.0), jeuler.Springs(edges, 1.0, 1.0, [1.0, 1.0, 1.0]))
    )
    names = ("ks", "kd", "rest_length", "acceleration", "coefficient")
    places = Places.of(state, names, None)
    found = weak_form(guess, state, times, y, places, places.read(guess, state)).params
    np.testing.assert_allclose(found["ks"], 80.0, rtol=0.02)
    np.testing.assert_allclose(found["rest_length"], [1.0, 0.8, 1.2], rtol=0.02)
    np.testing.assert_allclose(found["acceleration"], [0.3, -9.81], atol=0.15)
    np.testing.assert_allclose(found["coefficient"], 0.2, atol=0.05)
    np.testing.assert_allclose(found["kd"], 0.6, rtol=0.2)


def test_what_does_not_enter_linearly_or_was_not_seen_stays(random):
    edges = [(0, 1), (1, 2), (2, 3)]
    x = np.array([[0.0], [1.1], [2.0], [3.1]])
    v = random.normal(size=x.shape)
    scene = jeuler.Scene((jeuler.Springs(edges, [30.0, 20.0, 10.0], 0.1, 1.0),))
    times = np.linspace(0, 3, 61)
    y = recorded(scene, x, v, np.ones(4), times, random)
    y[:, 3] = np.nan
    state = jeuler.ParticleState(x, v, np.ones(4))
    guess = jeuler.Scene((jeuler.Springs(edges, [1.0, 2.0, 3.0], 0.1, 1.0),))
    places = Places.of(state, ("ks", "mass"), None)
    found = weak_form(guess, state, times, y, places, places.read(guess, state)).params
    assert abs(found["ks"][0] - 30.0) < 1
    assert found["ks"][2] == 3.0
    assert found["mass"].tolist() == [1.0] * 4
    twice = jeuler.Scene((jeuler.Springs([*edges[:2], edges[0]], [1.0, 2.0, 3.0], 0.1, 1.0),))
    places_twice = Places.of(state, ("ks",), None)
    values = weak_form(twice, state, times, y, places_twice, places_twice.read(twice, state)).singular_values
    assert values[-1] < 1e-7 * values[-2]  # only the sum of the two is seen
    few = weak_form(guess, state, times[:6], y[:6], places, places.read(guess, state))
    assert few is None


class Own(eqx.Module):
    """-cubic s^3 - share drag tanh(v / width): affine in cubic and drag, in share by itself alone, not in width."""

    cubic: float
    drag: float
    share: float
    width: float

    def __call__(self, t, position, velocity, mass):
        pull = -self.cubic * (position - 1.0) ** 3 - self.share * self.drag * jnp.tanh(velocity / self.width)
        return pull.at[0].set(0.0)


def test_a_force_of_ones_own_gives_what_enters_it_linearly(random):
    x, v, mass = np.array([[0.0], [1.8]]), np.zeros((2, 1)), np.array([np.inf, 1.0])
    spring, times = jeuler.Springs([[0, 1]], 20.0, 0.0, 1.0), np.linspace(0, 4, 161)
    y = recorded(jeuler.Scene((spring, Own(15.0, 0.5, 1.0, 0.8))), x, v, mass, times, random)
    guess = jeuler.Scene((jeuler.Springs([[0, 1]], 1.0, 0.0, 1.0), Own(0.0, 0.1, 1.0, 0.8)))
    state, names = jeuler.ParticleState(x, v, mass), ("ks", "cubic", "drag", "share", "width")
    places = Places.of(state, names, None)
    found = weak_form(guess, state, times, y, places, places.read(guess, state)).params
    np.testing.assert_allclose([found["ks"], found["cubic"]], [20.0, 15.0], rtol=0.03)
    np.testing.assert_allclose(found["drag"], 0.5, rtol=0.1)
    assert (found["share"], found["width"]) == (1.0, 0.8)


@pytest.mark.parametrize("factor", [0.01, 0.1, 1.0, 10.0, 100.0])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_start_a_hundred_times_off_ends_at_the_truth(factor, gaps, random):
    times = np.sort(random.uniform(0, 4, 90)) if gaps else np.linspace(0, 4, 90)
    w, g = np.sqrt(100 - 0.04), 0.2
    x = 1 + 0.3 * np.exp(-g * times) * (np.cos(w * times) + g / w * np.sin(w * times))
    y = np.full((90, 2, 1), np.nan)
    y[:, 1, 0] = x + 1e-3 * random.normal(size=90)
    if gaps:
        y[30:36] = np.nan
    state = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], 100 * factor, 0.4 * factor, 1.0),))
    found = jeuler.fit_springs(scene, state, times, y, dt=0.0125)
    assert abs(found.ks - 100) < 4 * found.stderr["ks"] + 0.01
    assert abs(found.kd - 0.4) < 4 * found.stderr["kd"]
    assert found.converged


def test_samples_that_cannot_tell_a_frequency_are_named():
    times = np.arange(24) * 0.8 * 2 * np.pi / 10  # 1.25 samples a period of 10 rad/s
    y = np.full((24, 2, 1), np.nan)
    y[:, 1, 0] = 1 + 0.3 * np.cos(10 * times)
    state = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], 99.0, 0.0, 1.0),))
    found = jeuler.fit_springs(scene, state, times, y, dt=0.01, parameters=("ks",))
    assert abs(found.ks - 100) < 0.1 or "aliasing" in found.message


def test_nonnegative_least_squares_agrees_with_scipy(random):
    from scipy.optimize import nnls
    from scipy.sparse import csc_matrix

    for _ in range(20):
        a, b = random.normal(size=(40, 15)), random.normal(size=40)
        found, _, values = nonnegative_least_squares(csc_matrix(a), b, np.ones(15, bool))
        np.testing.assert_allclose(found, nnls(a, b)[0], atol=1e-8)
        assert len(values) == 15
