"""``fit_springs`` by minibatches of time windows, of effects' parameters, with random numbers and less memory."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jeuler

T = np.linspace(0, 8, 101)
G = 0.1
W = np.sqrt(9 - G**2)
SWING = 1 + 0.3 * np.exp(-G * T) * (np.cos(W * T) + G / W * np.sin(W * T))  # ks = 9, kd = 0.2, mass 1
STATE = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
SCENE = jeuler.Scene((jeuler.Springs([[0, 1]], 5.0, 0.5, 1.0),))


def seen(missing=()):
    x = SWING + 1e-3 * np.random.default_rng(0).normal(size=len(T))
    x[list(missing)] = np.nan
    return np.stack([np.full_like(x, np.nan), x], 1)[:, :, None]


def test_windows_of_time_lead_near_the_truth_from_far_starts_and_the_whole_record_judges():
    options = {"dt": 0.08, "start": "given", "step_bias": False, "progress": False}
    some = {"optimizer": optax.adam(0.05), "minibatch": 4, "max_iterations": 300}
    found = jeuler.fit_springs(SCENE, STATE, T, seen(missing=range(40, 44)), **options, **some)
    np.testing.assert_allclose(found.ks, 9.0, rtol=0.02)
    np.testing.assert_allclose(found.kd, 0.2, atol=0.03)
    np.testing.assert_allclose(found.loss, np.min(found.history))
    at_the_end = found.predicted[:, 1, 0] - seen()[:, 1, 0]
    assert found.loss == pytest.approx(np.mean(np.delete(at_the_end, range(40, 44)) ** 2), rel=1e-6)
    assert found.converged == (found.message.split(";")[0] == "converged")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"optimizer": None}, "minibatch is for an optax optimiser"),
        ({"minibatch": None, "window": 9}, "window is for minibatch"),
        ({"window": 102}, "window must be from 2 to the 101 samples"),
        ({"window": 1}, "window must be at least 2"),
        ({"minibatch": 60}, "minibatch must be from 1 to the rows"),
        ({"parameters": ("ks", "velocity")}, "minibatch takes the start of each window from the data"),
        ({"sigma": 1e-3, "priors": {"ks": (9.0, 1.0)}}, "minibatch goes without priors"),
        ({"observe": "velocity"}, "minibatch is for positions of one record"),
        ({"positions": seen(missing=range(5, 101))}, "minibatch needs at least 9 samples"),
        ({"checkpoint": "reversible"}, 'checkpoint must be a number of steps, "sqrt" or None'),
        ({"key": 3}, "key must be a jax.random.key"),
    ],
)
def test_bad_input(change, message):
    arguments = {"positions": seen(), "optimizer": optax.adam(0.1), "minibatch": 4, **change}
    with pytest.raises(ValueError, match=message):
        jeuler.fit_springs(SCENE, STATE, T, arguments.pop("positions"), dt=0.08, **arguments)


def bouncing(restitution):
    floor = jeuler.Plane([0.0, 0.0], [0.0, 1.0])
    return jeuler.Scene((jeuler.Gravity([0.0, -9.81]),), (jeuler.Collisions((floor,), restitution=restitution),))


def heights(t, e, h=1.0, g=9.81):
    """Of a ball that is dropped, by hand: flights between bounces that each keep e of the speed."""
    fall, speed = np.sqrt(2 * h / g), e * np.sqrt(2 * h * g)
    y, begun = np.where(t < fall, h - g * t**2 / 2, np.nan), fall
    while begun < t[-1]:
        s = t - begun
        y = np.where((s >= 0) & (s <= 2 * speed / g), speed * s - g * s**2 / 2, y)
        begun, speed = begun + 2 * speed / g, e * speed
    return y


def test_restitution_of_a_bouncing_ball():
    name = "effects[0].restitution"
    t = np.linspace(0, 1.4, 57)
    positions = np.stack([0 * t, heights(t, 0.7)], 1)[:, None]
    ball = jeuler.ParticleState([[0.0, 1.0]], [[0.0, 0.0]])
    found = jeuler.fit_springs(bouncing(0.5), ball, t, positions, dt=0.025, parameters=(name,), step_bias=False)
    np.testing.assert_allclose(found.params[name], 0.7, rtol=2e-3)
    assert found.scene.effects[0].restitution == found.params[name]


def test_restitution_stays_between_nothing_and_all():
    t = np.linspace(0, 1.4, 57)
    positions = np.stack([0 * t, heights(t, 1.2)], 1)[:, None]  # gains speed: no wall does that
    ball = jeuler.ParticleState([[0.0, 1.0]], [[0.0, 0.0]])
    found = jeuler.fit_springs(
        bouncing(0.8), ball, t, positions, dt=0.025, parameters=("restitution",), step_bias=False
    )
    assert found.params["restitution"] == 1.0
    assert "restitution ended on a bound" in found.message
    with pytest.raises(ValueError, match=r"effects\[0\].restitution twice"):
        jeuler.fit_springs(
            bouncing(0.8), ball, t, positions, dt=0.025, parameters=("restitution", "effects[0].restitution")
        )
    with pytest.raises(ValueError, match="parameters must be among .*restitution"):
        jeuler.fit_springs(bouncing(0.8), ball, t, positions, dt=0.025, parameters=("forces[1].restitution",))


def shaken(t, dt, previous, state, key):
    """A push in a direction that is drawn."""
    push = 0.3 * jax.random.normal(key, state.velocity.shape, state.velocity.dtype)
    return state.replace(velocity=jnp.where(jnp.isinf(state.mass)[:, None], 0, state.velocity + push * dt))


@pytest.mark.parametrize("observe", ["position", "velocity"])
def test_a_scene_that_draws_random_numbers_is_fitted_with_its_key(observe, tmp_path):
    scene = jeuler.Scene(SCENE.forces, (shaken,))
    right = jeuler.Scene((jeuler.Springs([[0, 1]], 9.0, 0.2, 1.0),), (shaken,))
    key = jax.random.key(5)
    run = jeuler.simulate(right, STATE, dt=0.08, num_steps=40, step=jeuler.symplectic_euler_step, key=key)
    measured = np.array(getattr(run.y, observe))
    kept = tmp_path / "fit" if observe == "position" else None
    options = {"dt": 0.08, "observe": observe, "resume": kept, "step": jeuler.symplectic_euler_step}
    found = jeuler.fit_springs(scene, STATE, run.t, measured, **options, key=key, checkpoint="sqrt")
    np.testing.assert_allclose([found.ks, found.kd], [9.0, 0.2], rtol=1e-5)
    assert found.message.endswith("the run draws random numbers in each step, so the bias of the step is not known")
