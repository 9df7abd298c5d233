"""Runs without jit: they compile once for a structure, and never answer with what a function was before."""

import gc
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled_programs

import jeuler
from jeuler._jax import programs

GRID = {"dt": 0.25, "num_steps": 4, "save_every": 4}


def compilations(run, *calls):
    """How many programs are compiled at each call of run with these arguments."""
    counts = []
    for arguments in calls:
        with compiled_programs() as compiled:
            jax.block_until_ready(run(*arguments))
        counts.append(len(compiled))
    return counts


def end(f, y0=1.0, **how):
    return jeuler.solve(f, y0, **(GRID | how)).y[-1]


def power(k):
    """What four steps of y' = k y make of 1."""
    return (1 + k / 4) ** 4


def test_a_scene_and_a_state_of_numbers_lists_and_arrays_of_numpy_compile_nothing():
    def built(rows):
        at = np.arange(2.0 * rows).reshape(rows, 2)  # of a shape that nothing before had
        state = jeuler.ParticleState(at, 0 * at, mass=2.5)
        scene = jeuler.Scene((jeuler.Gravity([0.0] * rows), jeuler.Springs([[0, 1]], ks=1, kd=0.5, rest_length=at[0])))
        return state.position, scene

    assert compilations(lambda rows: built(rows)[0], (61,), (67,)) == [0, 0]


# What must compile once


def scene(ks):
    return jeuler.Scene((jeuler.Springs([[0, 1]], ks=ks, kd=0.1, rest_length=1.0), jeuler.Gravity([0.0, -9.8])))


STATE = jeuler.ParticleState([[0.0, 0.0], [1.2, 0.0]], np.zeros((2, 2)), mass=[np.inf, 1.0])


def with_function(c):
    def push(t, position, velocity, mass):
        return c * position

    return jeuler.simulate(jeuler.Scene((push,)), STATE, **GRID).y.position


def closure(k):
    return end(lambda t, y, args: k * y)


RUNS = {
    "simulate": (lambda ks: jeuler.simulate(scene(ks), STATE, **GRID).y.position, 1.0, 2.0),
    "step size": (lambda dt: jeuler.simulate(scene(3.0), STATE, **(GRID | {"dt": dt})).y.position, 0.1, 0.2),
    "force over an array": (with_function, jnp.array(1.0), jnp.array(2.0)),
    "solve": (lambda k: end(lambda t, y, k: k * y, args=k), 1.0, 2.0),
    "start": (lambda y: end(lambda t, y, k: -y, y), 1.0, 2.0),
    "closure over an array": (closure, jnp.array(1.0), jnp.array(2.0)),
    "same closure": (closure, 1.0, 1.0),
    "partial": (lambda k: end(jax.tree_util.Partial(lambda k, t, y, args: k * y, k)), jnp.array(1.0), jnp.array(2.0)),
    "scene in a field": (
        lambda ks: end(scene(ks).vector_field, (STATE.position, STATE.velocity), args=STATE.mass)[0], 1.0, 2.0,
    ),
    "saved": (lambda c: end(lambda t, y, a: y, save=lambda t, y: c * y), jnp.array(1.0), jnp.array(2.0)),
    "network": (
        lambda k: end(lambda t, y, net: net(y), jnp.ones(2), args=eqx.nn.MLP(2, 2, 3, 1, key=jax.random.key(k))), 1, 2,
    ),
    "network as a field": (
        lambda k: end(NetField(eqx.nn.Linear(2, 2, key=jax.random.key(k)), 3), jnp.ones(2)), 1, 2,
    ),
    "adaptive": (lambda k: jeuler.solve_adaptive(lambda t, y, k: k * y, 1.0, t1=1.0, args=k).y, 1.0, 2.0),
    "gradient": (jax.grad(lambda ks: jeuler.simulate(scene(ks), STATE, **GRID).y.position.sum()), 1.0, 2.0),
    "tangent": (jax.jacfwd(lambda ks: jeuler.simulate(scene(ks), STATE, **GRID).y.position), 1.0, 2.0),
    "batch": (
        jax.vmap(lambda ks: jeuler.simulate(scene(ks), STATE, **GRID).y.position), jnp.ones(3), jnp.arange(1.0, 4.0),
    ),
    "gradient by closure": (jax.grad(closure), 1.0, 2.0),
    "array used as a number": (lambda k: end(lambda t, y, a: float(k) * y), jnp.array(1.0), jnp.array(1.0)),
    "object that cannot be compared": (lambda k: end(lambda t, y, a: getattr(k, "real") * y), 1.0, 1.0),  # noqa: B009
}  # fmt: skip


class NetField(eqx.Module):
    linear: eqx.nn.Linear
    power: int

    def __call__(self, t, y, args):
        return self.linear(y) ** self.power


@pytest.mark.parametrize("name", RUNS)
def test_the_second_call_compiles_nothing(name):
    run, first, second = RUNS[name]
    jax.block_until_ready(run(first))
    with compiled_programs() as further:
        got = run(second)
        jax.block_until_ready(got)
        jax.block_until_ready(run(first))
    assert not further
    if name != "network":
        expected = jax.jit(lambda: run(second))()
        for a, b in zip(*map(jax.tree.leaves, (got, expected)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12)


def test_a_second_advice_or_diagnosis_of_the_same_equations_compiles_nothing():
    def advised(k):
        return jnp.asarray(jeuler.advise_step(lambda t, y, args: -k * y, 1.0, t1=1.0, error=1e-2).dt)

    def chosen(k):
        best = jeuler.advise_method(
            lambda t, y, args: -k * y, 1.0, t1=1.0, error=1e-2, methods={"RK4": jeuler.rk4_step}
        ).best
        return jnp.asarray(best.dt)

    def diagnosed(ks):
        found = jeuler.diagnose(scene(ks), STATE, dt=0.01, num_steps=3, loss=lambda s: jnp.sum(s.position**2))
        return jnp.asarray(found.finite)

    for run in (advised, chosen, diagnosed):
        first, second = compilations(run, (1.0,), (1.0,))
        assert first > 0
        assert second == 0


def test_programs_are_of_each_precision_shape_and_count():
    f = lambda t, y, args: -y  # noqa: E731
    assert end(f, np.float32(1)).dtype == np.float32
    assert end(f, np.float64(1)).dtype == np.float64
    assert end(f, np.ones(3)).shape == (3,)
    assert end(lambda t, y, args: (-y[0],), (1.0,), save=lambda t, y: y[0]).shape == ()
    np.testing.assert_allclose(end(f, num_steps=8), 0.75**8)
    np.testing.assert_allclose(end(f, step=jeuler.implicit_euler_step), 1.25**-4)
    with jax.enable_x64(False):
        assert end(f, 1.0).dtype == np.float32
    assert end(f, 1.0).dtype == np.float64


# What must not be answered from before


def test_numbers_in_a_closure():
    np.testing.assert_allclose([closure(k) for k in (1.0, 2.0, 1, True, -0.0)], [power(k) for k in (1, 2, 1, 1, 0)])
    assert np.isinf(end(lambda t, y, a: np.float64(np.inf) * y))


SCALE, TABLE, WEIGHTS = 1.0, {"k": [1.0]}, jnp.array(1.0)
MODULE = types.ModuleType("of_the_person")
MODULE.K = 1.0


def by_global(t, y, args):
    return SCALE * y


def by_function(t, y, args):
    return by_global(t, y, args)


def by_table(t, y, args):
    return TABLE["k"][0] * y


def by_array(t, y, args):
    return WEIGHTS * y


def by_module(t, y, args):
    return MODULE.K * y


class Settings:
    k = 1.0


def by_class(t, y, args):
    return Settings.k * y


class Field:
    def __init__(self, k):
        self.k = k

    def __call__(self, t, y, args):
        return self.k * SCALE * y

    def method(self, t, y, args):
        return self(t, y, args)


def test_globals_that_change(monkeypatch):
    for k in (1.0, 3.0):
        monkeypatch.setitem(globals(), "SCALE", k)
        monkeypatch.setitem(globals(), "WEIGHTS", jnp.array(k))
        TABLE["k"][0] = k
        monkeypatch.setattr(MODULE, "K", k)
        monkeypatch.setattr(Settings, "k", k)
        for f in (by_global, by_function, by_table, by_array, by_module, by_class, Field(1.0), Field(1.0).method):
            np.testing.assert_allclose(end(f), power(k), err_msg=str(f))
        particles = jeuler.simulate(jeuler.Scene((by_scale,)), STATE, **GRID).y
        np.testing.assert_allclose(particles.velocity[-1, 1, 0], k)
    TABLE["k"][0] = 1.0


def by_scale(t, position, velocity, mass):
    return jnp.full_like(position, SCALE)


def test_objects_that_change():
    field, values, table, array = Field(1.0), [1.0], {"k": 1.0}, np.ones(1)
    for k in (1.0, 2.0):
        field.k = values[0] = table["k"] = array[0] = k
        for f in (
            field,
            field.method,
            lambda t, y, a: values[0] * y,
            lambda t, y, a: table["k"] * y,
            lambda t, y, a: array[0] * y,
            lambda t, y, a, k=k: k * y,
        ):
            np.testing.assert_allclose(end(f), power(k))


def test_functions_redefined_in_the_same_place():
    for source in ("lambda t, y, args: y", "lambda t, y, args: 2 * y"):
        np.testing.assert_allclose(end(eval(source)), power(2.0 if "2" in source else 1.0))


def test_values_drawn_while_tracing_are_drawn_again():
    rng, count = np.random.default_rng(0), 0

    def drawn(t, y, args):
        return rng.uniform(1, 2) * y

    def drawn_globally(t, y, args):
        return np.random.uniform(1, 2) * y

    def counted(t, y, args):
        nonlocal count
        count += 1
        return y

    assert end(drawn) != end(drawn)
    assert end(drawn_globally) != end(drawn_globally)
    end(counted)
    before = count
    end(counted)
    assert count > before


def test_arrays_in_functions_that_call_each_other():
    def run(a):
        def even(n):
            return a if n == 0 else odd(n - 1)

        def odd(n):
            return 0 * a if n == 0 else even(n - 1)

        return end(lambda t, y, args: even(4) * y)

    for k in (1.0, 2.0):
        np.testing.assert_allclose(run(jnp.array(k)), power(k))


def test_one_array_in_two_places_and_two_in_one():
    def run(a, b):
        share = lambda: a  # noqa: E731
        return end(lambda t, y, args: (share() + 2 * a - b) * y)

    one, two = jnp.array(1.0), jnp.array(2.0)
    for a, b in ((one, one), (one, two), (two, one), (two, two)):
        np.testing.assert_allclose(run(a, b), power(3 * a - b))


def test_an_array_whose_value_steers_the_program():
    for k in (1.0, -1.0):
        a = jnp.array(k)
        np.testing.assert_allclose(
            end(lambda t, y, args, a=a: y if float(a) > 0 else -2 * y), power(1 if k > 0 else -2)
        )


def test_large_constants_are_compared_whole():
    for k in (1.0, 2.0):
        table = np.zeros(200_000)
        table[123_457] = k
        np.testing.assert_allclose(end(lambda t, y, args, table=table: jnp.sum(jnp.asarray(table)) * y), power(k))


def test_the_state_of_a_field_under_transformations():
    def final(k, wrap):
        return end(wrap(lambda t, y, args: k * y * y))

    for wrap in (lambda f: f, jax.jit, jax.checkpoint):
        for k in (0.5, 1.0):
            numeric = (final(k + 1e-6, wrap) - final(k - 1e-6, wrap)) / 2e-6
            np.testing.assert_allclose(jax.grad(final)(k, wrap), numeric, rtol=1e-6)
        np.testing.assert_allclose(
            jax.vmap(final, (0, None))(jnp.array([0.5, 1.0]), wrap), [final(0.5, wrap), final(1.0, wrap)], rtol=1e-12
        )


def test_under_jit_a_run_is_a_part_of_the_program_around_it():
    jaxpr = jax.make_jaxpr(lambda k: end(lambda t, y, args: k * y))(1.0)
    names = [eqn.params.get("name") for eqn in jaxpr.eqns if eqn.primitive.name in ("jit", "pjit")]
    assert "run" not in names
    assert "scan" in [eqn.primitive.name for eqn in jaxpr.eqns]
    with jax.disable_jit():
        np.testing.assert_allclose(closure(1.0), power(1))


def test_errors_are_the_same_at_every_call():
    for _ in range(2):
        with pytest.raises(ValueError, match="must not be negative, got -1"):
            jeuler.simulate(scene(-1.0), STATE, **GRID)
        with pytest.raises(ValueError, match="keep the shape of y"):
            end(lambda t, y, args: y[:1], jnp.ones(2))
        with pytest.raises(ValueError, match="dt must"):
            end(lambda t, y, args: y, dt=0.0)


# Memory


def test_a_long_sweep_keeps_memory_flat():
    def resident():
        gc.collect()
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 2**20

    def sweep(values):
        for k in values:
            jeuler.simulate(scene(k), STATE, **GRID)
            closure(jnp.array(k))

    sweep(np.linspace(1, 2, 100))
    before = resident()
    with compiled_programs() as further:
        sweep(np.linspace(2, 3, 1000))
    assert not further
    assert resident() - before < 4.0


def test_no_more_programs_are_kept_than_said():
    kept = programs.Kept(3)
    for k in range(5):
        kept.put(k, str(k))
    assert kept.get(0) is None
    assert kept.get(2) == "2"
    kept.put(5, "5")
    assert kept.get(2) == "2"
    assert kept.get(3) is None
