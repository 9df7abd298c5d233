"""The fit of an emitter's speed and spread and of the wind to a target cloud, by gradients through the samplers."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from jeuler import Cone, Emitter, Gravity, Lifetime, LinearDrag, Normal, OverLife, Scene, simulate
from jeuler.particles.state import empty_pool


def cloud(parameters, key):
    """The cloud half a second and a second after the start."""
    jet = Emitter(
        300.0,
        position=Normal([0.0, 0.0], 0.02),
        velocity=Cone([0.3, 1.0], speed=Normal(parameters["speed"], 0.2), angle=parameters["angle"]),
        max_births=8,
    )
    scene = Scene((Gravity([0.0, -9.81]), LinearDrag(1.0, air=parameters["wind"])), (jet, Lifetime(5.0)))
    end = simulate(scene, empty_pool(300, 2), dt=0.04, num_steps=24, key=key, save_every=12)
    return jnp.concatenate([features(end.y.position[n], end.y.alive[n]) for n in (1, 2)])


def features(position, alive):
    """What the cloud looks like, whichever particle is which: the mean and the roots of the moments of its cells."""
    weight = alive / jnp.sum(alive)
    mean = weight @ position
    apart = (position - mean) * alive[:, None]
    second = jnp.einsum("n,ni,nj->ij", weight, apart, apart)
    third = jnp.einsum("n,ni,ni,nj->j", weight, apart, apart, apart)
    return jnp.concatenate([mean, second.ravel(), third])


def test_speed_spread_and_wind_are_found_from_a_cloud_of_other_drops():
    truth = {"speed": jnp.array(6.0), "angle": jnp.array(0.35), "wind": jnp.array([2.0, 0.5])}
    seen = jax.jit(jax.vmap(lambda key: cloud(truth, key)))(jax.random.split(jax.random.key(100), 16))
    target, noise = seen.mean(axis=0), seen.std(axis=0)
    keys = jax.random.split(jax.random.key(0), 4)  # other drops than those of the target

    @jax.jit
    def residual(x):
        parameters = {"speed": x[0], "angle": x[1], "wind": x[2:]}
        return (jnp.mean(jax.vmap(lambda key: cloud(parameters, key))(keys), axis=0) - target) / noise

    start = jnp.array([3.5, 0.6, 0.0, 0.0])
    fit = scipy.optimize.least_squares(residual, start, jac=jax.jit(jax.jacfwd(residual)), x_scale=[1.0, 0.1, 1.0, 1.0])
    assert fit.cost < 1e-3 * np.sum(residual(start) ** 2) / 2
    assert abs(fit.x[0] - 6.0) < 0.3
    assert abs(fit.x[1] - 0.35) < 0.035
    assert np.abs(fit.x[2:] - truth["wind"]).max() < 0.3


def test_the_gradient_reaches_emitter_wind_drag_and_colours_and_equals_finite_differences():
    def look(values):
        speed, wind, drag, bright = values
        jet = Emitter(40.0, [0.0, 0.0], Cone([0.0, 1.0], speed, 0.3), lifetime=0.6, max_births=3)
        effects = (jet, Lifetime(), OverLife("color", jnp.stack([bright * jnp.ones(3), jnp.zeros(3)])))
        scene = Scene((Gravity([0.0, -9.81]), LinearDrag(drag, air=jnp.stack([wind, 0.0 * wind]))), effects)
        end = simulate(scene, empty_pool(30, 2), dt=0.02, num_steps=40, key=jax.random.key(1), save_every=40).y
        return jnp.sum(jnp.sin(3 * end.position[-1])) + jnp.sum(end.color[-1] ** 2)

    values, step = jnp.array([4.0, 1.5, 0.8, 0.9]), 1e-6
    value = jax.jit(look)
    slope = jax.jit(jax.grad(look))(values)
    difference = [(value(values + step * e) - value(values - step * e)) / (2 * step) for e in jnp.eye(4)]
    assert np.all(np.abs(slope) > 1e-3)
    assert np.allclose(slope, difference, rtol=1e-6)
