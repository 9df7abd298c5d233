"""Networks, and other pytrees with leaves that are not arrays, wherever a pytree is taken."""

import copy
import pickle

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler._core.component import Partitioned
from jeuler._core.partition import Rest, arrays_only, partition


class Net(eqx.Module):
    """A network that knows its name, how often to repeat itself, which inputs to take, and what to ignore."""

    mlp: eqx.nn.MLP
    repeats: int
    name: str
    nothing: None
    order: jax.Array

    def __call__(self, x):
        assert self.name == "net"
        for _ in range(self.repeats):  # needs a Python integer
            x = self.mlp(x[self.order])
        return x


def net(key=0):
    mlp = eqx.nn.MLP(2, 2, 4, 1, activation=jnp.tanh, key=jax.random.key(key))
    return Net(mlp, 2, "net", None, jnp.array([1, 0]))


def field(t, y, model):
    return model["net"](y) * model["scale"] - y


ARGS, Y0 = {"net": net(), "scale": 0.5, "label": "any"}, np.array([1.0, 0.5])
END = {"dt": 0.1, "num_steps": 8}


def by_closure(t, y, args):
    return field(t, y, ARGS)


def final(args):
    return jeuler.solve(field, Y0, args=args, **END).y[-1]


def test_solve_is_diffrax_with_the_same_args():
    term, saved = diffrax.ODETerm(field), diffrax.SaveAt(t1=True)
    theirs = diffrax.diffeqsolve(term, diffrax.Euler(), 0.0, 0.8, 0.1, jnp.asarray(Y0), args=ARGS, saveat=saved).ys[0]
    np.testing.assert_allclose(final(ARGS), theirs, rtol=1e-12)
    np.testing.assert_allclose(eqx.filter_jit(final)(ARGS), theirs, rtol=1e-12)


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype")  # 64-bit indices of a closure, in a float32 pilot
@pytest.mark.parametrize(
    "run",
    [
        lambda f, args: jeuler.solve(f, Y0, args=args, step=jeuler.implicit_euler_step, **END).y,
        lambda f, args: jeuler.solve(f, Y0, args=args, step=jeuler.rk4_step, compensated=True, checkpoint=3, **END).y,
        lambda f, args: jeuler.solve_adaptive(f, Y0, t1=1.0, args=args, rtol=1e-3).y,
        lambda f, args: jeuler.stability_limit(f, 0.0, Y0, args),
        lambda f, args: jeuler.advise_step(f, Y0, t1=1.0, error=1e-2, args=args).dt,
    ],
    ids=["implicit", "rk4", "adaptive", "stability_limit", "advise_step"],
)
def test_every_entry_point_takes_a_network_as_args(run):
    np.testing.assert_allclose(run(field, ARGS), run(by_closure, None), rtol=1e-9)


def test_reversible_runs_take_a_network():
    def swing(t, y, model):
        return y[1], model["net"](y[0]) - y[0]

    def end(scale, **how):
        start = Y0, 0 * Y0
        args = ARGS | {"scale": scale}
        f = lambda t, y, m: (y[1], m["scale"] * swing(t, y, m)[1])  # noqa: E731
        y = jeuler.solve(f, start, args=args, step=jeuler.symplectic_euler_step, **END, **how).y
        return jnp.sum(y[0][-1])

    np.testing.assert_allclose(jax.grad(lambda s: end(s, checkpoint="reversible"))(0.7), jax.grad(end)(0.7), rtol=1e-9)


def test_gradient_with_respect_to_the_arrays_of_a_network():
    def loss(args):
        return jnp.sum(final(args) ** 2)

    slope = eqx.filter_grad(loss)(ARGS)
    nudge, h = jnp.zeros_like(ARGS["net"].mlp.layers[0].weight).at[1, 0].set(1.0), 1e-6

    def nudged(sign):
        where = lambda args: args["net"].mlp.layers[0].weight  # noqa: E731
        return loss(eqx.tree_at(where, ARGS, where(ARGS) + sign * h * nudge))

    np.testing.assert_allclose(slope["net"].mlp.layers[0].weight[1, 0], (nudged(1) - nudged(-1)) / (2 * h), rtol=1e-6)
    many = eqx.filter_vmap(net)(jnp.arange(3))
    runs = eqx.filter_vmap(lambda one: final(ARGS | {"net": one}))(many)
    np.testing.assert_allclose(runs, [final(ARGS | {"net": net(k)}) for k in range(3)], rtol=1e-12)


def test_work_precision_and_its_gradient_with_a_network_as_args():
    table = jeuler.work_precision(
        field, Y0, t1=1.0, dts=[0.01], steps=[jeuler.rk4_step], args=ARGS, repeats=1, gradient=jnp.sum
    )
    assert table.rows[0]["error_final_relative"] < 1e-8
    assert table.rows[0]["gradient_error_relative"] < 1e-6


# In scenes

STATE = jeuler.ParticleState([[0.0, 0.3], [1.0, 0.0]], [[0.0, 0.1], [0.2, 0.0]])


def halves(x):
    return x / 2


class Push(Net):
    reads = ("charge",)  # attributes are found as those of components are

    def __call__(self, t, position, velocity, mass, charge):
        return charge * jax.vmap(super().__call__)(position)


class Steer(Net):
    def __call__(self, t, dt, state, key):
        return state.replace(velocity=state.velocity + dt * jax.vmap(super().__call__)(state.position))


class Breeze(Net):
    def __call__(self, t, position):
        return jax.vmap(super().__call__)(position)


class Ground(Net):
    def __call__(self, t, point):
        return point[1] + 0.1 + 0.1 * jnp.sum(super().__call__(point))


class Path(Net):
    def __call__(self, t):
        return super().__call__(jnp.stack([t, t]))


def of(kind):
    x = net()
    return kind(x.mlp, x.repeats, x.name, x.nothing, x.order)


SCENES = {
    "force": lambda part: jeuler.Scene((part, jeuler.Gravity([0.0, -9.8]))),
    "effect": lambda part: jeuler.Scene(effects=(part,)),
    "air": lambda part: jeuler.Scene((jeuler.LinearDrag(0.5, air=part),)),
    "collider": lambda part: jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (jeuler.Collisions((part,)),)),
    "penalty": lambda part: jeuler.Scene((jeuler.PenaltyContact(part, ks=50.0, radius=1.5),)),
    "center": lambda part: jeuler.Scene((jeuler.PointAttractor(part, strength=2.0, softening=0.1),)),
}
PARTS = {"force": Push, "effect": Steer, "air": Breeze, "collider": Ground, "penalty": Ground, "center": Path}


@pytest.mark.parametrize("place", SCENES)
def test_networks_in_scenes(place):
    part, state = of(PARTS[place]), STATE.replace(charge=jnp.asarray(1.5))
    scene = SCENES[place](part)
    assert all(jnp.issubdtype(x.dtype, jnp.floating) for x in jax.tree.leaves(scene))

    def as_function(*args, **fields):
        return part(*args, **fields)

    as_function.reads = getattr(part, "reads", ())

    def end(scene):
        return jeuler.simulate(scene, state, dt=0.1, num_steps=3, save_every=3).y.position[-1]

    def loss(scene):
        return jnp.sum(end(scene) ** 2)

    direction = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size, dtype=x.dtype).reshape(x.shape)), scene)
    value, slope = jax.jit(jax.value_and_grad(loss))(scene)
    _, forward = jax.jit(lambda scene: jax.jvp(loss, (scene,), (direction,)))(scene)
    np.testing.assert_allclose(value, loss(SCENES[place](as_function)), rtol=1e-12)
    reverse = sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (slope, direction)), strict=True))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    assert any(jnp.any(x != 0) for x in jax.tree.leaves(slope))


def test_a_network_in_a_scene_keeps_its_attributes_and_travels():
    mlp = eqx.nn.MLP(2, 2, 4, 1, activation=halves, final_activation=halves, key=jax.random.key(0))
    part = jeuler.Scene((Push(mlp, 2, "net", None, jnp.array([1, 0])),)).forces[0]
    assert isinstance(part, Partitioned)
    assert part.name == "net"
    assert part.mlp.layers[0].weight.shape == (4, 2)
    assert not hasattr(part, "no_such_thing")
    x = np.ones(2)
    copies = copy.copy(part), copy.deepcopy(part), pickle.loads(pickle.dumps(part))
    assert all(jax.tree.structure(other) == jax.tree.structure(part) for other in copies)
    for other in copies:
        np.testing.assert_array_equal(Net.__call__(other.whole(), x), Net.__call__(part.whole(), x))


# In fits


def test_fit_of_a_network_leaves_the_rest_of_it_alone():
    x = np.linspace(-1, 1, 12)
    target = 0.3 * np.sin(2 * x)
    start = {"net": eqx.nn.MLP("scalar", "scalar", 3, 1, activation=jnp.tanh, key=jax.random.key(1)), "name": "a"}
    found = jeuler.fit(lambda p: jax.vmap(p["net"])(x) - target, start, max_iterations=200)
    assert found.loss < 1e-6
    assert found.params["name"] == "a"
    assert found.params["net"].activation is jnp.tanh
    assert found.stderr["net"].layers[0].bias.shape == (3,)
    assert len(found.covariance) == 10


def test_fit_says_that_an_integer_stays():
    found = jeuler.fit(lambda p: p["k"] * jnp.ones(3) - p["n"], {"k": 1.0, "n": 2})
    np.testing.assert_allclose(found.params["k"], 2.0)
    assert "n kept as given" in found.message
    for wrong in ({"n": 2}, {"k": 1.0, "n": jnp.array([2])}):
        with pytest.raises(ValueError, match=r"params\['n'\] must be floating, got int"):
            jeuler.fit(lambda p: p["n"] * jnp.ones(3), wrong)


# The helper


def test_what_is_an_array_and_what_is_not():
    tree = {"a": 1.5, "b": 2, "c": None, "d": np.arange(3), "e": "x", "f": jnp.ones(2), "g": len, "h": True, "i": [2j]}
    arrays, rest = partition(tree)
    assert [type(x).__name__ for x in arrays] == ["float", "ndarray", "ArrayImpl", "complex"]
    assert jax.tree.structure(rest.join(arrays)) == jax.tree.structure(tree)
    assert rest.join(arrays)["g"] is len
    assert rest == partition(tree | {"a": 3.5})[1]
    assert hash(rest) == hash(partition(tree | {"a": 3.5})[1])
    assert rest != partition(tree | {"b": 3})[1]
    assert rest != partition(tree | {"e": "y"})[1]


def test_leaves_without_a_hash_are_equal_by_content_or_identity():
    def rest(x):
        return partition(x, lambda leaf: False)[1]

    assert rest(np.arange(3)) == rest(np.arange(3))
    assert hash(rest(np.arange(3))) == hash(rest(np.arange(3)))
    assert rest(np.arange(3)) != rest(np.arange(3.0))
    assert rest(np.arange(3)) != rest(np.array([0, 1, 3]))
    first, second = {1}, {1}
    assert rest(first) == rest(first)
    assert rest(first) != rest(second)


def test_arrays_alone_come_back_as_they_are():
    args = {"k": 1.0, "x": jnp.ones(2)}
    assert arrays_only(field, args) == (field, args)
    assert isinstance(partition(args)[1], Rest)
