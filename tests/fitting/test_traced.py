"""A fit as part of a program: {fit, fit_springs} by {Levenberg-Marquardt, optax, a robust loss, bounds}, compiled,
batched and differentiated in one program, against loops of fits with values and their finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jeuler

T = np.linspace(0.0, 2.0, 21)
NOISE = 0.05 * np.random.default_rng(0).normal(size=(2, 21))
FALL = 2 * np.exp(-1.3 * T)
SWING = 2 * np.exp(-0.65 * T) * (np.cos(3 * T) + 0.65 / 3 * np.sin(3 * T))  # ks = 9.42, kd = 1.3, mass 1
STATE = jeuler.ParticleState([[0.0], [2.0]], [[0.0], [0.0]], mass=[jnp.inf, 1.0])
SCENE = jeuler.Scene((jeuler.Springs([[0, 1]], 8.0, 0.9, 0.0),))
BOUNDED = {"bounds": {"kd": (0.0, 1.0)}}
DESCENT = {"optimizer": optax.adam(optax.cosine_decay_schedule(0.05, 500)), "max_iterations": 500, "tolerance": 1e-15}
WAYS = {
    "Levenberg-Marquardt": {},
    "optax between bounds": DESCENT | BOUNDED,
    "a robust loss between bounds": {"loss": "soft_l1", "loss_scale": 0.05} | BOUNDED,
}


def of_a_curve(noise, **options):
    def residual(p, y):
        return p["ks"] * jnp.exp(-p["kd"] * T) - y

    return jeuler.fit(residual, {"ks": 1.0, "kd": 0.5}, data=FALL + noise, **{"tolerance": 1e-9} | options)


def of_a_spring(noise, **options):
    seen = jnp.stack([0 * noise, SWING + noise], 1)[:, :, None]
    how = {"dt": 0.1, "step": jeuler.symplectic_euler_step, "grow": False, "tolerance": 1e-9, "step_bias": False}
    return jeuler.fit_springs(SCENE, STATE, T, seen, start="given", **how | options)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("door", [of_a_curve, of_a_spring])
def test_compiled_batched_and_differentiated_it_is_the_optimum(door, way):
    def best(noise, options=WAYS[way]):
        found = door(noise, **options)
        names = (
            ("params", "converged") if door is of_a_spring else ("params", "converged", "loss", "stderr", "nonfinite")
        )
        return found.params["ks"] + 3 * found.params["kd"], {name: getattr(found, name) for name in names}

    slopes, together = jax.jit(jax.vmap(jax.grad(best, has_aux=True)))(jnp.asarray(NOISE))
    exact = {name: option for name, option in WAYS[way].items() if name not in DESCENT}
    for k, noise in enumerate(NOISE):
        _, alone = best(noise)
        jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-4), together, alone)
        step = 1e-4 * np.eye(21)[7]
        moved = [float(best(noise + side * step, exact)[0]) for side in (-1, 1)]
        np.testing.assert_allclose(slopes[k][7], (moved[1] - moved[0]) / 2e-4, rtol=2e-3)
    assert ("between bounds" in way) == bool(np.all(together["params"]["kd"] == 1.0))
