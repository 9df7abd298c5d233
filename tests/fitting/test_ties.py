"""Parameters that are tied, neighbours that are alike, and the part of a record that is held out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.fitting.smoothness import shared_particles
from jeuler.fitting.ties import Tie

EDGES = [[0, 1], [1, 2], [2, 3]]
STATE = jeuler.ParticleState([[0.0], [1.2], [2.0], [3.0]], jnp.zeros((4, 1)), mass=[jnp.inf, 1.0, 1.0, jnp.inf])
TIMES = np.linspace(0.0, 4.0, 101)


def scene(ks):
    return jeuler.Scene((jeuler.Springs(EDGES, ks, 0.2, 1.0),))


@pytest.fixture(scope="module")
def positions():
    run = jeuler.simulate(scene([30.0, 15.0, 30.0]), STATE, dt=0.005, num_steps=800, step=jeuler.rk4_step, save_every=8)
    return np.asarray(run.y.position) + 1e-3 * np.random.default_rng(1).normal(size=run.y.position.shape)


def test_springs_with_one_label_are_one_unknown_and_the_rest_of_the_record_is_predicted(positions):
    """Fitted to the first 70 % of the time: the residual of the rest is the noise, as that of the first part."""
    options = {"dt": 0.04, "parameters": ("ks",), "sigma": 1e-3}
    tied = jeuler.fit_springs(
        scene([20.0, 25.0, 20.0]),
        STATE,
        TIMES,
        positions,
        ties={"ks": ["wall", "middle", "wall"]},
        held_out=0.3,
        **options,
    )
    assert tied.params["ks"].shape == tied.stderr["ks"].shape == (2,)
    np.testing.assert_array_equal(tied.ks, tied.params["ks"][np.array([0, 1, 0])])
    np.testing.assert_allclose(tied.params["ks"], [30.0, 15.0], atol=0.05)
    assert tied.training_rms == pytest.approx(1e-3, rel=0.2)
    assert tied.held_out_rms == pytest.approx(1e-3, rel=0.2)
    free = jeuler.fit_springs(scene([20.0, 25.0, 20.0]), STATE, TIMES, positions, **options)
    assert tied.stderr["ks"][0] < 0.8 * free.stderr["ks"][0]
    # the log-density of the free fit is that of a normal distribution with its covariance
    away = np.array([0.3, -0.5, 0.2]) * free.stderr["ks"]
    change = free.log_density({"ks": free.ks + away}) - free.log_density(free.params)
    np.testing.assert_allclose(change, -0.5 * away @ np.linalg.solve(free.covariance, away), rtol=0.2)
    slope = jax.grad(free.log_density)(free.params)["ks"]
    assert np.all(np.abs(slope) * free.stderr["ks"] < 0.05)
    assert free.log_density({"ks": jnp.array([-1.0, 15.0, 30.0])}) == -np.inf
    with pytest.raises(ValueError, match="params must have the structure and shapes"):
        free.log_density({"ks": jnp.zeros(2)})
    # neighbours that are alike: from those of the data to one value, as sigma shrinks
    spread = [np.ptp(jeuler.fit_springs(
        scene([20.0, 25.0, 20.0]), STATE, TIMES, positions, smoothness={"ks": sigma}, **options
    ).ks) for sigma in (1e3, 1e-4)]  # fmt: skip
    assert spread[0] == pytest.approx(15.0, rel=0.01)
    assert spread[1] < 0.1


def test_a_model_that_does_not_predict_what_it_was_not_shown_says_so(positions):
    slow = positions[:, :, :] + 0.02 * np.maximum(TIMES - 2.8, 0)[:, None, None]  # what begins after the fitted part
    found = jeuler.fit_springs(scene([30.0, 15.0, 30.0]), STATE, TIMES, slow, dt=0.04, parameters=("ks",), held_out=0.3)
    assert found.held_out_rms > 3 * found.training_rms
    assert "the model does not predict what it was not shown" in found.message
    mask = TIMES > 2.8
    again = jeuler.fit_springs(
        scene([30.0, 15.0, 30.0]), STATE, TIMES, slow, dt=0.04, parameters=("ks",), held_out=mask
    )
    np.testing.assert_allclose(again.ks, found.ks)


def test_the_pairs_of_springs_that_share_a_particle_are_each_there_once():
    """A triangle with a tail: every two of its sides share a corner, the tail one corner with two of them."""
    edges = np.array([[0, 1], [1, 2], [2, 0], [2, 3], [4, 5]])
    expected = [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    assert shared_particles(edges, np.arange(5)).tolist() == expected
    assert shared_particles(edges, np.array([0, 0, 1, 1, 2])).tolist() == [[0, 1]]  # of tied ones


@pytest.mark.parametrize("labels", [[3, "a", 3, "a", 5], np.array([3, 1, 3, 1, 5])])
def test_a_tie_is_its_own_inverse(labels):
    tie = Tie.of("ks", labels, (np.zeros(3), np.zeros((2,))))
    first, second = tie.expanded(np.array([1.0, 2.0, 3.0]))
    assert (first.tolist(), second.tolist()) == ([1.0, 2.0, 1.0], [2.0, 3.0])
    np.testing.assert_allclose(tie.reduced((first, second)), [1.0, 2.0, 3.0])
