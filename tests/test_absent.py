"""The third promise: a scene pays only for what it calls for. Absent means absent, for every force and effect."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler import Gravity, ParticleState, PrescribedMotion, QuadraticDrag, Scene, Springs, euler_step, simulate, solve
from jeuler.effects import Death, DeathOnContact, DeathOutside, Emitter, Lifetime, OverLife, SpeedLimit
from jeuler.forces import (
    Bending,
    LinearDrag,
    PointAttractor,
    ShapeMatching,
    StrandBending,
    StrandCore,
    Viscosity,
    Vortex,
    Wind,
    turbulence,
)

KEY = jax.random.key(0)
POSITION = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 0.8], [0.5, 0.3, 0.9], [0.9, 0.2, 0.7]])
STRAND = [[0, 1, 2, 3]]

FORCES = {
    "springs": Springs([[0, 1]], ks=10.0, kd=0.1, rest_length=0.2),
    "linear drag": LinearDrag(0.1),
    "quadratic drag": QuadraticDrag(0.1),
    "wind": LinearDrag(0.1, air=Wind([1.0, 0.0, 0.0])),
    "vortex": LinearDrag(0.1, air=Vortex([0.0, 0.0, 0.0], 1.0, 0.1)),
    "turbulence": LinearDrag(0.1, air=turbulence(dim=3, speed=1.0, size=1.0, modes=3)),
    "attractor": PointAttractor([0.0, 0.0, 0.0], 1.0, 0.1),
    "viscosity": Viscosity([[0, 1]], 0.1),
    "bending": Bending([[0, 1, 2]], 0.1),
    "shape matching": ShapeMatching(range(4), POSITION, 10.0),
    "strand bending": StrandBending(STRAND, POSITION[None], 1.0, 0.1, 1.0),
    "strand core": StrandCore(STRAND, POSITION[None], 1.0, 0.1, 1.0),
}
COUNTS = {"births", "missed_births"}
# the effect, and the fields that it brings into the state
EFFECTS = {
    "prescribed": (PrescribedMotion([0], lambda t: jnp.zeros((1, 3))), set()),
    "speed limit": (SpeedLimit(1.0), set()),
    "emitter": (Emitter(10.0, POSITION[0], POSITION[1]), {"alive", *COUNTS}),
    "coloured emitter": (Emitter(10.0, POSITION[0], POSITION[1], color=POSITION[0]), {"alive", "color", *COUNTS}),
    "lifetime": (Lifetime(0.5), {"alive", "age"}),
    "death": (Death(lambda t, state: state.position[:, 0] > 0.8), {"alive"}),
    "death outside": (DeathOutside(-1.0, 1.0), {"alive"}),
    "death on contact": (DeathOnContact(lambda t, p: p[2]), {"alive"}),
}
LIFE = Lifetime(0.5)
OVER_LIFE = {name: OverLife(name, values, duration=0.5) for name, values in {
    "color": np.eye(3), "opacity": [1.0, 0.0], "size": [0.1, 0.2], "shape": [0.0, 1.0], "heat": [1.0, 0.0],
}.items()}  # fmt: skip


def run(scene, position=POSITION):
    state = ParticleState(jnp.asarray(position), jnp.zeros_like(jnp.asarray(position)))
    return simulate(scene, state, dt=0.01, num_steps=3, key=KEY)


BASE = Scene(forces=(Gravity([0.0, 0.0, -9.81]),))


def fields(scene):
    return set(jax.eval_shape(lambda position: run(scene, position), jnp.asarray(POSITION)).y.fields())


def jaxpr(scene):
    return str(jax.make_jaxpr(lambda position: run(scene, position))(jnp.asarray(POSITION)))


@pytest.fixture(scope="module")
def base():
    return jaxpr(BASE), run(BASE)


def never_had(monkeypatch, kind):
    """The library as if the class had never been written: whatever touches it fails."""

    def absent(*args, **kwargs):
        raise AssertionError(f"{kind.__name__} was touched by a scene without it")

    for name, value in list(vars(kind).items()):
        if callable(value) or isinstance(value, property):
            monkeypatch.setattr(kind, name, absent)


@pytest.mark.parametrize("name", FORCES)
def test_a_force_that_is_absent_leaves_no_trace(name, base, monkeypatch):
    before, result = base
    force = FORCES[name]
    assert jaxpr(Scene(forces=(*BASE.forces, force))) != before, "the test would see a force that is there"
    never_had(monkeypatch, type(force))
    assert jaxpr(BASE) == before
    assert run(BASE).y.fields() == result.y.fields() == ("position", "velocity", "mass")


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_is_absent_leaves_no_trace(name, base, monkeypatch):
    before, result = base
    effect, own_fields = EFFECTS[name]
    scene = Scene(forces=BASE.forces, effects=(effect,))
    assert jaxpr(scene) != before, "the test would see an effect that is there"
    assert fields(scene) == {"position", "velocity", "mass"} | own_fields, "only its own fields"
    never_had(monkeypatch, type(effect))
    assert jaxpr(BASE) == before
    again = run(BASE)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(result), strict=True))


@pytest.mark.parametrize("name", OVER_LIFE)
def test_one_attribute_does_not_bring_the_others(name):
    scene = Scene(forces=BASE.forces, effects=(LIFE, OVER_LIFE[name]))
    assert fields(scene) == {"position", "velocity", "mass", "alive", "age", name}


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

    full = Scene(forces=BASE.forces, effects=(*(e for e, _ in EFFECTS.values()), OVER_LIFE["color"]))
    removed = Scene(forces=full.forces, effects=tuple(e for e in full.effects if e is None))
    (cost, result), (cost_removed, result_removed) = program(BASE), program(removed)
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
