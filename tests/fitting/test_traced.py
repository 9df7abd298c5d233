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


def test_fits_are_members_of_an_ensemble_and_go_on_from_its_folder(tmp_path):
    """Recordings, resampled, from starts of their own, over a mesh; stopped on the way and gone on with."""

    def residual(p, data):
        return (p["ks"] * jnp.exp(-p["kd"] * T) - data["y"]) * data["weight"]

    def run(member):
        drawn = jax.random.randint(member["key"], (21,), 0, 21)
        weight = jnp.sqrt(jnp.bincount(drawn, length=21))
        found = jeuler.fit(residual, member["start"], data={"y": member["y"], "weight": weight}, tolerance=1e-9)
        return found.params | {"converged": found.converged}

    members = {
        "key": jax.random.split(jax.random.key(0), 3)[jnp.array([0, 0, 0, 1, 1, 2])],
        "start": {"ks": jnp.array([0.1, 1.0, 30.0, 1.0, 1.0, 1.0]), "kd": jnp.ones(6)},
        "y": FALL + jnp.asarray(NOISE)[jnp.array([0, 0, 0, 0, 1, 1])],
    }
    alone = [run(jax.tree.map(lambda x, k=k: x[k], members)) for k in range(6)]
    how = {"batch": 2, "mesh": jax.make_mesh((1,), ("member",)), "resume": tmp_path / "fits", "checkpoint_every": 2}

    def stop(member, of):
        if member == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        jeuler.ensemble(run, members, reduce=jeuler.Moments(), progress=stop, **how)
    together = jeuler.ensemble(run, members, reduce=jeuler.Moments(), **how).reduced
    for name in ("ks", "kd"):
        values = np.array([float(one[name]) for one in alone])
        np.testing.assert_allclose(values[:3], values[0], rtol=1e-6, err_msg="from other starts")
        assert np.abs(np.diff(values[2:])).min() > 1e-3, "of other recordings and draws"
        np.testing.assert_allclose(together.mean[name], values.mean(), rtol=1e-6)
        np.testing.assert_allclose(together.variance[name], values.var(ddof=1), rtol=1e-4)
    assert together.mean["converged"] == 1.0


def test_a_bootstrap_of_a_thousand_records_is_one_call_and_spreads_as_the_errors_of_one_fit():
    records = 0.05 * jax.random.normal(jax.random.key(1), (1000, 21))

    def best(noise):
        found = of_a_curve(noise)
        return found.params, found.stderr_white, found.converged

    params, errors, converged = jax.jit(jax.vmap(best))(records)
    assert converged.all()
    for name, truth in (("ks", 2.0), ("kd", 1.3)):
        spread = np.std(params[name])
        np.testing.assert_allclose(spread, np.mean(errors[name]), rtol=0.1)
        assert abs(np.mean(params[name]) - truth) < 0.15 * spread
