"""Prescribed motion: exact at every step, felt at every stage, differentiable."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import METHODS
from scipy.interpolate import CubicHermiteSpline

import jeuler


def hand(t):
    return jnp.stack([jnp.sin(2 * t), jnp.zeros_like(t)])[None]


STATE = jeuler.ParticleState([[0.0, 0.0], [0.0, -1.0]], [[0.0, 0.0], [0.0, 0.0]], mass=[jnp.inf, 1.0])
SPRING = jeuler.Springs([[0, 1]], ks=20.0, kd=0.5, rest_length=1.0)


def rope(path=hand):
    return jeuler.Scene(forces=(SPRING, jeuler.Gravity([0.0, -9.81])), effects=(jeuler.PrescribedMotion([0], path),))


@pytest.mark.parametrize("name", METHODS)
def test_particle_is_on_its_path_at_every_step(name):
    run = jeuler.simulate(rope(), STATE, dt=0.02, num_steps=50, step=METHODS[name].step)
    np.testing.assert_allclose(run.y.position[:, 0, 0], np.sin(2 * run.t), rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(run.y.velocity[:, 0, 0], 2 * np.cos(2 * run.t), rtol=1e-14)


def driven(t, y, args):
    """The same swing with the hand's motion written into the equation."""
    p, v = y
    d, w = p - hand(t)[0], v - jnp.stack([2 * jnp.cos(2 * t), jnp.zeros_like(t)])
    r = jnp.sqrt(d @ d)
    return v, 20.0 * (1 - r) * d / r - 0.5 * (w @ d / r) * d / r + jnp.array([0.0, -9.81])


def test_the_others_feel_it_with_the_order_of_the_method():
    exact = diffrax.diffeqsolve(
        diffrax.ODETerm(driven),
        diffrax.Tsit5(),
        0.0,
        1.0,
        1e-3,
        (STATE.position[1], STATE.velocity[1]),
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    ).ys[0][-1]
    for method in (METHODS["euler"], METHODS["heun"], METHODS["rk4"]):
        errors = [
            float(jnp.linalg.norm(
                jeuler.simulate(rope(), STATE, dt=1 / n, num_steps=n, step=method.step).y.position[-1, 1] - exact
            ))
            for n in (200, 400)
        ]  # fmt: skip
        assert abs(np.log2(errors[0] / errors[1]) - method.order) < 0.1


def test_samples_are_read_by_scipys_cubic(random):
    times = np.sort(random.uniform(0, 2, 9))
    values = random.normal(size=(9, 1, 2))
    path = jeuler.SampledPath(times, values)
    t = np.linspace(times[0], times[-1], 101)
    # np.gradient has the same second-order slopes inside and, with edge_order=2, at the ends
    reference = CubicHermiteSpline(times, values, np.gradient(values, times, axis=0, edge_order=2))(t)
    np.testing.assert_allclose(jax.vmap(path)(t), reference, atol=1e-10)
    np.testing.assert_allclose(path(times[-1] + 1), values[-1], atol=1e-12)


def test_gradient_through_the_samples():
    times = np.linspace(0, 1, 6)
    samples = np.asarray(jax.vmap(hand)(jnp.asarray(times)))

    @jax.jit
    @jax.value_and_grad
    def loss(samples):
        run = jeuler.simulate(rope(jeuler.SampledPath(times, samples)), STATE, dt=0.02, num_steps=50)
        return jnp.sum(run.y.position[-1, 1] ** 2)

    _, slope = loss(samples)
    h = 1e-6
    for k in (0, 2, 5):
        bump = np.zeros_like(samples)
        bump[k, 0, 0] = h
        (above, _), (below, _) = loss(samples + bump), loss(samples - bump)
        np.testing.assert_allclose(slope[k, 0, 0], (above - below) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (lambda: jeuler.PrescribedMotion([2], hand), r"different indices from 0 to 1, got \[2\]"),
        (lambda: jeuler.PrescribedMotion([0, 0], hand), r"different indices from 0 to 1, got \[0, 0\]"),
        (lambda: jeuler.PrescribedMotion([0, 1], hand), r"path\(t\) must have shape \(2, 2\).*got \(1, 2\)"),
    ],
)
def test_bad_motion(motion, message):
    with pytest.raises(ValueError, match=message):
        jeuler.simulate(jeuler.Scene(effects=(motion(),)), STATE, dt=0.1, num_steps=1)


@pytest.mark.parametrize(
    ("times", "positions", "message"),
    [
        ([0.0, 0.0], [0.0, 1.0], "times must increase"),
        ([0.0], [0.0], "two samples at least"),
        ([0.0, 1.0], [0.0, 1.0, 2.0], r"got \(2,\) and \(3,\)"),
    ],
)
def test_bad_samples(times, positions, message):
    with pytest.raises(ValueError, match=message):
        jeuler.SampledPath(times, positions)
