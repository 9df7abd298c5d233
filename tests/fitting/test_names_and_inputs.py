"""What a fit may vary, by name; the bias of the step; bad input: one clear message each, with the remedy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler

G = 0.2
T = np.linspace(0, 5, 101)
W = np.sqrt(100 - G**2)
NOISE = 1e-3 * np.random.default_rng(0).normal(size=101)
SWING = 1 + 0.3 * np.exp(-G * T) * (np.cos(W * T) + G / W * np.sin(W * T)) + NOISE  # ks = 100, kd = 0.4, mass 1


def seen(x=SWING):
    return np.stack([np.full_like(x, np.nan), x], 1)[:, :, None]


STATE = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
FLOOR = jeuler.PenaltyContact(jeuler.Plane([-9.0], [1.0]), ks=50.0, kd=1.0, radius=0.1)


def scene(*others, ks=80.0, kd=0.2):
    return jeuler.Scene((*others, jeuler.Springs([[0, 1]], ks=ks, kd=kd, rest_length=1.0)))


def test_names_speak_of_springs_first():
    found = jeuler.fit_springs(scene(FLOOR), STATE, T, seen(), dt=0.02)
    assert found.ks.shape == ()
    assert found.scene.forces[0].ks == 50.0
    assert found.scene.forces[0].kd == 1.0
    np.testing.assert_allclose(found.ks, 100, rtol=1e-3)


def test_one_force_by_its_number_and_anything_by_a_function():
    two = jeuler.Scene((jeuler.LinearDrag(0.1), *scene(FLOOR, kd=0.0).forces))
    found = jeuler.fit_springs(two, STATE, T, seen(), dt=0.02, parameters=("forces[2].ks", "forces[0].coefficient"))
    assert set(found.params) == {"forces[2].ks", "forces[0].coefficient"}
    np.testing.assert_allclose(found.params["forces[0].coefficient"], 0.4, rtol=0.02)
    picked = jeuler.fit_springs(
        two, STATE, T, seen(), dt=0.02, parameters=("ks",), where=lambda s: s.forces[0].coefficient
    )
    np.testing.assert_allclose(picked.params["where"], 0.4, rtol=0.02)


def test_ks_of_several_springs_is_one_array():
    several = jeuler.Scene(
        (jeuler.Springs([[0, 1]], 60.0, 0.2, 1.0), jeuler.Springs([[0, 1], [0, 1]], [20.0, 20.0], 0.1, 1.0))
    )
    found = jeuler.fit_springs(several, STATE, T, seen(), dt=0.02, parameters=("forces[0].ks", "forces[0].kd"))
    assert found.ks.shape == found.kd.shape == (3,)
    np.testing.assert_allclose(found.ks.sum(), 100, rtol=1e-3)


class Pull(eqx.Module):
    """A force of a person's own: a network of the stretch."""

    net: eqx.nn.MLP

    def __call__(self, t, position, velocity, mass):
        pull = jax.vmap(self.net)(position - 1.0)
        return pull.at[0].set(0.0)


def test_a_network_as_a_force_is_fitted_through_where():
    net = eqx.nn.MLP(1, 1, 4, 1, activation=jnp.tanh, key=jax.random.key(0))
    hybrid = jeuler.Scene((jeuler.Springs([[0, 1]], 60.0, 0.4, 1.0), Pull(net)))
    found = jeuler.fit_springs(
        hybrid, STATE, T[:30], seen()[:30], dt=0.02, parameters=(), where=lambda s: s.forces[1], start="given"
    )
    assert found.explained > 0.99


@pytest.mark.parametrize(
    ("step", "dt", "biased"),
    [
        (jeuler.rk4_step, 0.01, False),
        (jeuler.rk4_step, 0.1, True),
        (jeuler.euler_step, 0.002, True),
        (jeuler.implicit_euler_step, 0.002, True),
    ],
    ids=["rk4", "rk4 coarse", "euler", "implicit"],
)
def test_the_bias_of_the_step_is_reported(step, dt, biased):
    found = jeuler.fit_springs(scene(), STATE, T, seen(), dt=dt, step=step)
    assert ("use dt" in found.message) == biased
    better = jeuler.fit_springs(scene(), STATE, T, seen(), dt=0.005)
    for name in ("ks", "kd"):
        moved = float(found.params[name] - better.params[name])
        np.testing.assert_allclose(found.step_bias[name], moved, rtol=0.35, atol=0.1 * float(better.stderr[name]))


def test_two_gliders_reach_the_minimum_with_damping_at_zero():
    """Three springs, one of them without damping: zero is a bound that the fit reaches, not a wall."""
    t = np.linspace(0, 8, 161)
    state = jeuler.ParticleState([[0.0], [1.1], [1.9], [3.0]], jnp.zeros((4, 1)), mass=[jnp.inf, 0.4, 1.0, jnp.inf])
    edges = [(0, 1), (1, 2), (2, 3)]
    right = jeuler.Scene((jeuler.Springs(edges, [3.0, 30.0, 3.0], [0.0, 0.005, 0.02], 1.0),))
    y = np.array(jeuler.simulate(right, state, dt=0.005, num_steps=1600, step=jeuler.rk4_step).y.position[::10])
    y += 1e-3 * np.random.default_rng(1).normal(size=y.shape)
    guess = jeuler.Scene((jeuler.Springs(edges, [5.0, 20.0, 5.0], 0.0 * np.ones(3), 1.0),))
    found = jeuler.fit_springs(guess, state, t, y, dt=0.02)
    assert found.converged
    assert abs(found.noise_ratio - 1) < 0.15
    off = (found.kd - np.array([0.0, 0.005, 0.02])) / found.stderr["kd"]
    assert np.abs(off).max() < 4
    np.testing.assert_allclose(found.ks, [3, 30, 3], rtol=0.01)


def test_the_scene_is_fitted_under_vmap_and_its_gradient_is_that_of_the_optimum():
    many = jnp.asarray(np.stack([seen(SWING[:41] + 1e-3 * np.sin(k * T[:41])) for k in range(3)]))
    many = jnp.nan_to_num(many)

    def stiffness(y):
        sigma = jnp.asarray([[jnp.inf], [1e-3]])
        return jeuler.fit_springs(scene(ks=95.0), STATE, T[:41], y, dt=0.025, sigma=sigma, tolerance=1e-9).ks

    together = jax.jit(jax.vmap(stiffness))(many)
    alone = [stiffness(y) for y in many]
    np.testing.assert_allclose(together, alone, rtol=1e-4)
    slope = jax.jit(jax.grad(stiffness))(many[0])
    step = np.zeros(many[0].shape)
    step[20, 1, 0] = 1e-5
    np.testing.assert_allclose(
        slope[20, 1, 0], (stiffness(many[0] + step) - stiffness(many[0] - step)) / 2e-5, rtol=1e-3
    )


BAD_SPRINGS = {
    "springs": ({"scene": 3.0}, "scene must be a Scene"),
    "state": ({"state": 3.0}, "state must be a ParticleState"),
    "power": ({"parameters": ("power",)}, "parameters must be among"),
    "static": ({"parameters": ("edges",)}, "parameters must be among.*'kd', 'ks', 'rest_length'"),
    "no such force": ({"parameters": ("forces[7].ks",)}, "parameters must be among.*forces"),
    "twice": ({"parameters": ("ks", "ks")}, "name each parameter once"),
    "two names": ({"parameters": ("ks", "forces[0].ks")}, "names forces.0..ks twice"),
    "not a name": ({"parameters": (3,)}, "must be a tuple of names"),
    "where fails": ({"where": lambda s: s.forces[5].ks}, "where must be a function of the scene"),
    "where empty": ({"where": lambda s: ()}, "where must pick arrays"),
    "start": ({"start": "best"}, 'start must be "data"'),
    "loss": ({"loss": "absolute"}, "loss must be one of 'linear', 'soft_l1', 'huber'"),
    "loss_scale": ({"loss": "huber", "loss_scale": 0.0}, "loss_scale must be greater than 0"),
    "bounds name": ({"bounds": {"k": (0, 1)}}, "bounds must name parameters, .*'ks'.* got 'k'"),
    "bounds pair": ({"bounds": {"ks": 3.0}}, r"bounds\['ks'\] must be a pair"),
    "bounds crossed": ({"bounds": {"ks": (90.0, 70.0)}}, "not below it"),
    "start outside": ({"bounds": {"ks": (90.0, 95.0)}}, "not below its lower bound, got 80"),
    "sigma zero": ({"sigma": 0.0}, "sigma must be greater than 0"),
    "sigma negative": ({"sigma": -1.0}, "sigma must be greater than 0"),
    "sigma shape": ({"sigma": np.ones(7)}, r"sigma must broadcast to positions, .* = \(101, 2, 1\)"),
    "sigma and weights": ({"sigma": 1.0, "weights": 1.0}, "must not both be given"),
    "weights negative": ({"weights": -1.0}, "weights must be 0 or more"),
    "weights none": ({"weights": 0.0}, "at least one residual"),
    "dt": ({"dt": -0.1}, "dt must be greater than 0"),
    "dt nan": ({"dt": np.nan}, "dt must be one finite real number"),
    "tolerance": ({"tolerance": 0.0}, "tolerance must be greater than 0"),
    "iterations": ({"max_iterations": 0}, "max_iterations must be at least 1"),
    "optimizer": ({"optimizer": "adam"}, "optimizer must be an optax optimiser"),
    "starts": ({"starts": 0}, "starts must be at least 1"),
    "starts word": ({"starts": "many"}, "starts must be a number of starts, or a tree like params.*write starts=64"),
    "starts of one": ({"starts": {"ks": np.ones(3)}}, "starts must be a number of starts, or a tree like params"),
    "starts uneven": ({"starts": {"ks": np.ones(3), "kd": np.ones(2)}}, "one row a start"),
    "num_steps": ({"num_steps": 3}, "num_steps=250 reaches it"),
    "over span": ({"dt": 30.0}, "dt must be at most the span of the times"),
    "t0": ({"t0": 1.0}, "pass t0, the time of the state, or drop the rows before it"),
    "falling": ({"times": T[::-1]}, "times must not decrease.*sort the rows"),
    "flat": ({"positions": SWING}, r"positions must have shape \(time, particle, dim\)"),
    "resume folder": ({"resume": "/nowhere/at/all"}, "there is no folder"),
    "times repeat": ({"times": np.zeros(101)}, "times must .* two different times"),
    "too few": ({"times": T[:1], "positions": seen()[:1]}, "times must .* two different times"),
    "constant": ({"positions": np.ones((101, 2, 1))}, "positions must move"),
    "blows up": (
        {"scene": scene(ks=1e12), "start": "given", "dt": 0.05},
        "not finite at the start.*smaller dt or a stabler step",
    ),
    "nothing pinned": ({"parameters": ("anchors",), "state": STATE.replace(mass=1.0)}, "no pinned"),
}


@pytest.mark.parametrize("name", BAD_SPRINGS)
def test_bad_input_of_fit_springs(name):
    change, message = BAD_SPRINGS[name]
    arguments = {"scene": scene(), "state": STATE, "times": T, "positions": seen(), "dt": 0.02, **change}
    with pytest.raises(ValueError, match=message) as caught:
        jeuler.fit_springs(
            arguments.pop("scene"),
            arguments.pop("state"),
            arguments.pop("times"),
            arguments.pop("positions"),
            **arguments,
        )
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parameters": ("ks", "kd", "mass")}, "kd, ks and mass only as their ratios; hold some of it, or record"),
        (
            {"positions": seen(1000 * SWING)},
            "explains only.*begin 1.3e\\+03 m from where the state is: give both in one",
        ),
        ({"positions": seen(SWING - 1)}, "begin 1 m from where the state is.*from one origin"),
        ({"scene": jeuler.Scene((jeuler.Springs([[0, 1]], 80.0, 0.2, 1000.0),))}, "rest_length is 1e\\+03 m where the"),
        ({"bounds": {"ks": (0.0, 90.0)}}, "ks ended on a bound"),
        ({"times": T[:3], "positions": seen()[:3]}, "do not determine|not told apart|there are only"),
    ],
)
def test_doubtful_input_gets_its_word(change, words):
    import re

    arguments = {"times": T, "positions": seen(), "dt": 0.02, **change}
    given, times = arguments.pop("scene", scene()), arguments.pop("times")
    found = jeuler.fit_springs(given, STATE, times, arguments.pop("positions"), **arguments)
    assert re.search(words, found.message), found.message
