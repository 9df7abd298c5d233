"""The third promise: a scene pays only for what it calls for. Absent means absent, for every force and effect."""

import functools

import cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import (
    Emitter,
    Gravity,
    Lifetime,
    LinearDrag,
    ParticleState,
    Scene,
    SpeedLimit,
    Wind,
    euler_step,
    simulate,
    solve,
)

KEY = jax.random.key(0)
POSITION = cases.STRAND_POSITION
FORCES = [name for name in cases.FORCES if name not in ("gravity", "no_springs", "function")]
BARE = {"position", "velocity", "mass"}


def base_in(dim):
    """A scene of gravity alone."""
    return Scene(forces=(Gravity([0.0] * (dim - 1) + [-9.81]),))


def run(scene, position=POSITION):
    state = ParticleState(jnp.asarray(position), jnp.zeros_like(jnp.asarray(position)))
    return simulate(scene, state, dt=0.01, num_steps=3, key=KEY)


BASE = base_in(3)


def fields(scene, position):
    return set(jax.eval_shape(lambda position: run(scene, position), jnp.asarray(position)).y.fields())


def jaxpr(scene, position=POSITION):
    return str(jax.make_jaxpr(lambda position: run(scene, position))(jnp.asarray(position)))


@functools.cache
def base(dim):
    position = POSITION[:, :dim]
    return base_in(dim), position, jaxpr(base_in(dim), position), run(base_in(dim), position)


def never_had(monkeypatch, kinds):
    """The library as if the classes had never been written: whatever touches them fails."""

    def absent(*args, **kwargs):
        raise AssertionError(f"one of {kinds} was touched by a scene without it")

    for kind in kinds:
        for name, value in list(vars(getattr(jeuler, kind)).items()):
            if callable(value) or isinstance(value, property):
                monkeypatch.setattr(getattr(jeuler, kind), name, absent)


def bits(solution):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(solution)]


@pytest.mark.parametrize("name", FORCES)
def test_a_force_that_is_absent_leaves_no_trace(name, monkeypatch):
    scene, position, before, result = base(3 if name in cases.IN_SPACE else 2)
    force = cases.FORCES[name]()
    assert jaxpr(Scene((*scene.forces, force)), position) != before, "the test would see a force that is there"
    never_had(monkeypatch, cases.kinds_in(force))
    assert jaxpr(scene, position) == before
    assert set(result.y.fields()) == BARE
    assert bits(run(scene, position)) == bits(result)


@pytest.mark.parametrize("name", cases.EFFECTS)
def test_an_effect_that_is_absent_leaves_no_trace(name, monkeypatch):
    row = cases.EFFECTS[name]
    scene, position, before, result = base(2)
    effect, needed = row.make(), {field for part in row.needs for field in (*part.writes, *getattr(part, "sets", ()))}
    full = Scene(scene.forces, (*row.needs, effect))
    assert jaxpr(full, position) != before, "the test would see an effect that is there"
    assert fields(full, position) == BARE | row.fields | needed, "only its own fields, and those that it needs"
    never_had(monkeypatch, cases.kinds_in(effect))
    assert jaxpr(scene, position) == before
    assert bits(run(scene, position)) == bits(result)


def test_a_scene_of_one_force_costs_what_the_bare_equation_costs():
    """FLOPs and bytes of the compiled program, against `solve` on the equation written by hand."""
    position = jnp.asarray(np.random.default_rng(0).normal(size=(1000, 3)))

    def bare(position):
        def fall(t, y, args):
            return y[1], jnp.broadcast_to(jnp.array([0.0, 0.0, -9.81]), position.shape)

        return solve(fall, (position, jnp.zeros_like(position)), dt=0.01, num_steps=100, save_every=100).y[0]

    def scene(position):
        state = ParticleState(position, jnp.zeros_like(position))
        return simulate(BASE, state, dt=0.01, num_steps=100, save_every=100).y.position

    expected, found = (jax.jit(f).lower(position).compile().cost_analysis() for f in (bare, scene))
    for what in ("flops", "bytes accessed"):
        assert found[what] <= 1.001 * expected[what], what
    assert np.allclose(scene(position), bare(position), rtol=1e-14)


def test_removing_an_effect_gives_the_same_program_bits_and_cost():
    def program(scene):
        compiled = jax.jit(lambda position: run(scene, position)).lower(jnp.asarray(POSITION)).compile()
        return compiled.cost_analysis(), compiled(jnp.asarray(POSITION))

    full = Scene(BASE.forces, (Emitter(10.0, POSITION[0], POSITION[1]), Lifetime(0.5), SpeedLimit(1.0)))
    removed = Scene(forces=full.forces, effects=full.effects[:0])
    (cost, result), (cost_removed, result_removed), (cost_full, _) = program(BASE), program(removed), program(full)
    assert cost_full["flops"] > cost["flops"], "the test would see effects that are there"
    assert (cost["flops"], cost["bytes accessed"]) == (cost_removed["flops"], cost_removed["bytes accessed"])
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(result_removed), strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_changed_parameter_never_retraces_and_an_added_effect_traces_once():
    traces = []

    def watched(t, dt, state, key):
        traces.append(1)
        return state

    @jax.jit
    def end(scene, state, key):
        return simulate(scene, state, dt=0.01, num_steps=2, key=key).y.position[-1]

    state = ParticleState(POSITION, 0 * POSITION)

    def scene(wind, rate, *more):
        drag = LinearDrag(0.1, air=Wind(wind))
        return Scene((drag,), (Emitter(rate, POSITION[0], POSITION[1]), Lifetime(0.5), watched, *more))

    end(scene([1.0, 0.0, 0.0], 10.0), state, KEY)
    first = len(traces)
    for wind, rate in (([2.0, 0.0, 0.0], 10.0), ([2.0, 1.0, 0.0], 20.0), ([0.0, 0.0, 0.0], 0.0)):
        end(scene(wind, rate), state, jax.random.key(int(rate)))
    assert len(traces) == first
    for limit in (1.0, 2.0, 3.0):
        end(scene([1.0, 0.0, 0.0], 10.0, SpeedLimit(limit)), state, KEY)
    assert len(traces) == 2 * first, "once for the scene with one effect more"
    assert end._cache_size() == 2


def test_effects_act_in_the_order_written():
    def double(t, dt, state, key):
        return state.replace(velocity=2 * state.velocity)

    def add(t, dt, state, key):
        return state.replace(velocity=state.velocity + 1)

    state = ParticleState(jnp.zeros((1, 1)), jnp.ones((1, 1)))
    ends = [
        float(simulate(Scene(effects=order), state, dt=0.1, num_steps=1, step=euler_step).y.velocity[-1, 0, 0])
        for order in ((double, add), (add, double))
    ]
    assert ends == [3.0, 4.0]
