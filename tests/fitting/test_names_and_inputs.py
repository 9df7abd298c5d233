"""What a fit may vary, by name; the bias of the step; bad input: one clear message each, with the remedy."""

import re

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


def scene(*others, ks=80.0, kd=0.2, edges=((0, 1),)):
    return jeuler.Scene((*others, jeuler.Springs(edges, ks=ks, kd=kd, rest_length=1.0)))


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
    advised = re.search(r"use dt = ([0-9.e-]+)", found.message)
    if step is jeuler.rk4_step and biased:  # a step of first order would need millions of steps
        there = jeuler.fit_springs(scene(), STATE, T, seen(), dt=float(advised[1]), step=step)
        assert "use dt" not in there.message


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
    "zeros": ({"positions": np.zeros((101, 2, 1))}, "positions must move"),
    "seen once": ({"positions": np.where(np.arange(101)[:, None, None] == 7, seen(), np.nan)}, "positions must move"),
    "never seen": ({"positions": np.full((101, 2, 1), np.nan)}, "at least one finite value"),
    "infinite": ({"positions": seen(np.where(T == 1.0, np.inf, SWING))}, "positions must be finite, or NaN"),
    "one sigma zero": ({"sigma": np.where(np.arange(101)[:, None, None] == 7, 0.0, 1e-3)}, "sigma must be greater"),
    "sigma leaves none": ({"sigma": np.inf}, "at least one residual"),
    "all held": ({"bounds": {"ks": (80.0, 80.0), "kd": (0.2, 0.2)}}, "bounds must leave something to fit"),
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
        (
            {"parameters": ("ks",)},
            "the residual is .* times the noise in the data: a wrong minimum, or the model lacks",
        ),
        ({"parameters": ("ks",), "sigma": 1e-3}, "the residual is .* times sigma: a wrong minimum"),
        ({"sigma": 1e-2}, "the residual is only 0.097 times sigma: sigma is too large"),
        ({"times": T[:3], "positions": seen()[:3]}, "do not determine|not told apart|there are only"),
        ({"times": T[[7, 20]], "positions": seen()[[7, 20]]}, "only 2 data for 2 parameters: no errors without sigma"),
        ({"scene": scene(edges=[[0, 1], [1, 0]], ks=[40.0, 40.0])}, r"ks\[0\] and ks\[1\] only as their sum"),
    ],
)
def test_doubtful_input_gets_its_word(change, words):
    arguments = {"times": T, "positions": seen(), "dt": 0.02, **change}
    given, times = arguments.pop("scene", scene()), arguments.pop("times")
    found = jeuler.fit_springs(given, STATE, times, arguments.pop("positions"), **arguments)
    assert re.search(words, found.message), found.message


@pytest.mark.parametrize(
    ("params", "names"),
    [
        ({"ks": np.ones(2), "forces[1].ks": 1.0}, ("forces[1].ks", "ks[0]", "ks[1]")),
        (
            {"ks": (1.0, np.ones(1)), "velocity": np.ones((1, 2))},
            ("ks[0]", "ks[1][0]", "velocity[0, 0]", "velocity[0, 1]"),
        ),
        ({"net": {"weight": np.ones(1), "two words": 0.5}}, ("net['two words']", "net.weight[0]")),
        (
            {"net": jax.tree.map(jnp.abs, eqx.nn.Linear(1, 1, key=jax.random.key(0)))},
            ("net.weight[0, 0]", "net.bias[0]"),
        ),
        ([1.0, np.ones(1)], ("params[0]", "params[1][0]")),
        (1.0, ("params",)),
    ],
)
def test_numbers_are_named_as_they_are_written_wherever_they_show(params, names):
    """One number is on its bound, the rest is not seen: names in attributes, message and table, and asked for."""
    from jax.flatten_util import ravel_pytree

    found = jeuler.fit(lambda p: ravel_pytree(p)[0][:1] - np.array([3.0, 3.0]), params, bounds=(0.0, 2.0))
    assert found.at_bound == names[:1]
    assert found.undetermined == found.blind == names[1:]
    assert f"{names[0]} ended on a bound" in found.message
    assert all(name in found.message for name in names)
    for text in (found.message, repr(found), found._repr_html_()):
        assert "['" not in text.replace("['two words']", "")
        assert '["' not in text
    assert np.isinf(found.standard_error(names[-1])) == (len(names) > 1)
    assert found.profile(names[0]).upper == 2.0
    with pytest.raises(ValueError, match=f"of must be one of {re.escape(names[0])}"):
        found.standard_error("['ks'][0]")
