"""Births, deaths and the pool: what is counted, what is recycled, what a dead slot holds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler import (
    Choice,
    Cone,
    Death,
    DeathOnContact,
    DeathOutside,
    Emitter,
    FromLine,
    FromSphere,
    Gravity,
    Lifetime,
    LinearDrag,
    Normal,
    OverLife,
    ParticleState,
    PointAttractor,
    Scene,
    ShapeMatching,
    SpeedLimit,
    Springs,
    Uniform,
    Viscosity,
    simulate,
    symplectic_euler_step,
)
from jeuler.effects.pool import first_free
from jeuler.particles.fields import uses
from jeuler.particles.protocols import Context
from jeuler.particles.state import empty_pool

KEY = jax.random.key(7)
FALL = Gravity([0.0, -9.81])
POINT = {"position": [0.0, 1.0], "velocity": [1.0, 2.0]}


def births(emitter, *, dt, num_steps, capacity=400, t0=0.0, effects=()):
    scene = Scene(effects=(emitter, *effects))
    end = simulate(scene, empty_pool(capacity, 2), dt=dt, num_steps=num_steps, t0=t0, key=KEY)
    return end.y


@pytest.mark.parametrize(
    ("rate", "dt", "num_steps", "t0"),
    [(100.0, 0.01, 100, 0.0), (30.0, 1 / 60, 120, 0.0), (37.3, 0.01, 250, 0.0), (60.0, 0.05, 40, 0.37)],
)
def test_a_stream_has_its_rate_to_within_one_birth(rate, dt, num_steps, t0):
    state = births(Emitter(rate, **POINT, max_births=8), dt=dt, num_steps=num_steps, t0=t0)
    steps = np.arange(num_steps + 1)
    assert np.abs(np.asarray(state.births) - rate * dt * steps).max() <= 1 + 1e-9
    assert np.array_equal(state.births, state.alive.sum(axis=1)), "each birth took a slot"
    assert not np.any(state.missed_births)


def test_the_stream_neither_skips_nor_repeats_in_float32_on_a_long_clock():
    emitter = Emitter(jnp.float32(50.0), **POINT)
    t = jnp.float32(0.02) * jnp.arange(200_000, dtype=jnp.float32)
    each = jax.vmap(lambda t: emitter.number_of_births(t, jnp.float32(0.02)))(t)
    assert int(each.sum()) == 200_000
    assert int(each.max()) == int(each.min()) == 1


def test_bursts_happen_once_each_and_the_stream_starts_and_stops():
    emitter = Emitter(100.0, **POINT, bursts=((0.0, 5), (0.3, 7), (0.3004, 2)), start=0.1, stop=0.2)
    state = births(emitter, dt=0.01, num_steps=50)
    new = np.diff(np.asarray(state.births))
    expected = np.zeros(50)
    expected[0], expected[30] = 5, 9
    expected[10:20] = 1
    assert np.array_equal(new, expected)


def test_births_that_find_no_slot_are_counted():
    state = births(Emitter(100.0, **POINT), dt=0.01, num_steps=100, capacity=60)
    assert int(state.births[-1]) == 60
    assert int(state.missed_births[-1]) == 40
    state = births(Emitter(0.0, **POINT, bursts=((0.0, 10),), max_births=4), dt=0.01, num_steps=2)
    assert int(state.births[-1]) == 4
    assert int(state.missed_births[-1]) == 6


@pytest.mark.parametrize("capacity", [1, 31, 32, 33, 300])
def test_the_first_free_slots_are_found(capacity, random):
    for share in (0.0, 0.1, 0.9, 1.0):
        alive = random.random(capacity) < share
        expected = np.flatnonzero(~alive)
        slots, free = first_free(jnp.asarray(alive), 40)
        assert int(free) == len(expected)
        assert np.array_equal(slots[: len(expected)], expected[:40])


def test_slots_are_recycled_and_the_pool_holds_what_lives():
    """Queueing: rate x lifetime live at once (Little's law), however many have lived."""
    emitter = Emitter(200.0, **POINT, lifetime=0.25, max_births=4)
    state = births(emitter, dt=0.01, num_steps=400, capacity=60, effects=(Lifetime(),))
    alive = np.asarray(state.alive.sum(axis=1))
    assert int(state.births[-1]) == 800
    assert int(state.missed_births[-1]) == 0
    assert np.all(np.abs(alive[60:] - 50) <= 2)
    assert not np.any(np.asarray(state.alive)[:, 54:]), "the living crowd into the first slots"


def test_a_dead_slot_holds_zeros_and_nothing_is_not_a_number():
    drag = LinearDrag(0.2, air=[1.0, 0.0])
    sun = PointAttractor([0.0, 0.0], 5.0, softening=1e-3)
    emitter = Emitter(
        200.0, FromSphere([0.0, 0.5], 0.2), Cone([0.0, 1.0], Uniform(1.0, 3.0), 0.5), lifetime=Uniform(0.05, 0.2),
        color=Choice(np.eye(3)), opacity=Uniform(0.2, 1.0), mass=Uniform(0.5, 2.0), extra={"heat": Uniform(1.0, 2.0)},
    )  # fmt: skip
    effects = (emitter, Lifetime(), DeathOutside([-2.0, 0.0], [2.0, 2.0]), OverLife("size", [0.1, 0.0]))
    scene = Scene((FALL, drag, sun), effects)

    def last(scene):
        state = empty_pool(80, 2)
        return simulate(scene, state, dt=0.01, num_steps=60, key=KEY, step=symplectic_euler_step)

    solution = jax.jit(last)(scene)
    state, dead = solution.y, ~np.asarray(solution.y.alive)
    assert dead[-1].any()
    assert not dead[-1].all()
    assert int(solution.first_nonfinite) == -1
    for name in ("position", "velocity", "age", "lifetime", "color", "opacity", "size", "heat"):
        values = np.asarray(getattr(state, name))
        assert np.all(np.isfinite(values)), name
        assert not np.any(values[dead]), name
    gradient = jax.grad(lambda scene: jnp.sum(last(scene).y.position[-1] ** 2))(scene)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    assert np.any(gradient.forces[1].air[0].velocity != 0)


def test_a_particle_that_is_not_a_number_dies_outside_and_its_slot_is_clean():
    def lose(t, dt, state, key):
        return state.replace(position=state.position.at[0, 0].set(jnp.nan))

    state = ParticleState(jnp.ones((2, 2)), jnp.ones((2, 2)))
    end = simulate(Scene(effects=(lose, DeathOutside(-5.0, 5.0))), state, dt=0.1, num_steps=2).y
    assert end.alive[-1].tolist() == [False, True]
    # the effect writes its NaN again at each step: the pool does not keep it
    assert end.position[-1, 0].tolist() == [0.0, 0.0]


PAIRS = {
    "springs": Springs([[0, 1]], ks=50.0, kd=1.0, rest_length=0.1),
    "viscosity": Viscosity([[0, 1]], 3.0),
    "shape matching": ShapeMatching([0, 1, 2], [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], stiffness=30.0),
}


@pytest.mark.parametrize("name", PAIRS)
def test_the_dead_exert_no_force(name):
    position = jnp.array([[0.0, 0.0], [1.0, 0.5], [0.3, 0.9]])
    velocity = jnp.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    scene = Scene((PAIRS[name],), (Death(lambda t, state: jnp.zeros(len(state.position), bool)),))
    alone = ParticleState(position, velocity, alive=jnp.array([True, False, False]))
    end = simulate(scene, alone, dt=0.01, num_steps=5).y
    assert np.allclose(end.velocity[-1, 0], [1.0, 0.0], atol=1e-14)
    together = ParticleState(position, velocity, alive=jnp.array([True, True, True]))
    assert not np.allclose(simulate(scene, together, dt=0.01, num_steps=5).y.velocity[-1, 0], [1.0, 0.0])


@pytest.mark.parametrize("kind", ["shifts", "rows", "pairs"])
def test_springs_of_the_living_are_those_of_the_law_whatever_their_layout(kind, random):
    """Prepared once for the run or laid out at each step, against the force on the living alone in NumPy."""
    particles = 40
    edges = {
        "shifts": [(k, k + 1) for k in range(particles - 1)],
        "rows": [(i, j) for i in range(particles) for j in range(i) if random.random() < 0.2],
        "pairs": [(0, 17), (5, 30)],
    }[kind]
    springs = Springs(edges, random.uniform(1, 2, len(edges)), random.uniform(0, 1, len(edges)), 0.3)
    p, v = random.normal(size=(2, particles, 3))
    alive = random.random(particles) < 0.7
    alive[[0, 17, 5]], alive[30] = True, False
    expected = np.zeros((particles, 3))
    for (i, j), ks, kd in zip(edges, np.asarray(springs.ks), np.asarray(springs.kd), strict=True):
        if alive[i] and alive[j]:
            d = p[i] - p[j]
            r = np.linalg.norm(d)
            f = (ks * (0.3 - r) - kd * np.dot(v[i] - v[j], d) / r) * d / r
            expected[i] += f
            expected[j] -= f
    context = Context(particles, jnp.float64)
    living = dataclasses.replace(context, alive=jnp.asarray(alive))
    for force in (springs, springs.prepare(context)):
        found = force.prepare(living)(0.0, jnp.asarray(p), jnp.asarray(v), jnp.ones(()))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_pool_prepares_its_springs_once_outside_the_scan(random):
    springs = Springs([(k, k + 1) for k in range(49)], random.uniform(1, 2, 49), 0.1, random.uniform(0.1, 0.2, 49))
    state = ParticleState(random.normal(size=(50, 2)), np.zeros((50, 2)))
    scene = Scene((springs,), (Lifetime(1.0),))
    program = jax.make_jaxpr(lambda scene: simulate(scene, state, dt=0.01, num_steps=4).y.position[-1])(scene)
    (loop,) = [e for e in program.jaxpr.eqns if e.primitive.name == "scan"]
    body = str(loop.params["jaxpr"])
    assert "gather" in body, "of who is alive"
    assert not any("f64" in line and " = gather" in line for line in body.splitlines()), "parameters are in their slots"


def test_deaths_by_age_place_contact_and_condition():
    state = ParticleState(jnp.array([[0.0, 1.0], [0.0, -1.0], [3.0, 1.0]]), jnp.zeros((3, 2)))

    def alive(*effects):
        return simulate(Scene(effects=effects), state, dt=0.1, num_steps=3).y.alive.tolist()

    everyone = [True, True, True]
    assert alive(Lifetime(0.3)) == [everyone] * 4
    assert alive(Lifetime(0.2)) == [everyone, everyone, everyone, [False] * 3]
    assert alive(DeathOnContact(lambda t, p: p[1]))[1] == [True, False, True]
    assert alive(DeathOutside(low=-jnp.inf, high=[2.0, jnp.inf]))[1] == [True, True, False]
    assert alive(Death(lambda t, state: t > 0.15))[1:] == [everyone, everyone, [False] * 3]


def test_the_classical_order_births_attributes_deaths_motion_appearance():
    """A newborn lives through the whole step of its birth; its colour is that of its age at the end of the step."""
    emitter = Emitter(0.0, [0.0, 0.0], [1.0, 0.0], bursts=((0.0, 1),), lifetime=0.4)
    fade = OverLife("opacity", [1.0, 0.0])
    state = simulate(Scene(effects=(emitter, Lifetime(), fade)), empty_pool(1, 2), dt=0.1, num_steps=6, key=KEY).y
    age = np.asarray(state.age[:, 0])
    assert 0 < age[1] < 0.1, "born at a random moment of the first step"
    assert np.allclose(age[1:5], age[1] + 0.1 * np.arange(4))
    assert np.allclose(state.position[1:5, 0, 0], age[1:5]), "it went on at 1 m/s since that moment"
    assert np.allclose(state.opacity[1:5, 0], 1 - age[1:5] / 0.4)
    assert state.alive[:, 0].tolist() == [False, *[True] * 5, False], "it was 0.4 s old within the fifth step"
    assert float(state.births[-1]) == 1


def test_newborns_take_nothing_from_the_slot_before_them():
    red = Emitter(0.0, **POINT, bursts=((0.0, 3),), color=[1.0, 0.0, 0.0], lifetime=1e-3, size=5.0)
    plain = Emitter(0.0, **POINT, bursts=((0.2, 3),))
    state = simulate(Scene(effects=(red, plain, Lifetime())), empty_pool(3, 2), dt=0.1, num_steps=4, key=KEY).y
    assert state.color[1].tolist() == [[1.0, 0.0, 0.0]] * 3
    assert np.all(state.size[1] == 5.0)
    assert np.all(np.isinf(state.lifetime[-1]))
    assert np.all(state.color[-1] == 0.2)
    assert np.all(state.size[-1] == 1.0)


def test_one_attribute_more_does_not_change_the_draws_of_the_others():
    named = {"position": FromLine([0.0, 0.0], [1.0, 0.0]), "velocity": Normal([0.0, 1.0], 0.3)}
    plain = births(Emitter(50.0, **named), dt=0.1, num_steps=3, capacity=20)
    coloured = births(Emitter(50.0, **named, color=Uniform([0.0] * 3, 1.0)), dt=0.1, num_steps=3, capacity=20)
    assert np.array_equal(plain.position, coloured.position)


def test_fields_of_the_persons_own_reach_a_force():
    @uses(reads=("charge",))
    def field(t, position, velocity, mass, charge):
        return charge[:, None] * jnp.array([0.0, 2.0])

    @uses(writes=("heat",), reads=("charge",))
    def warm(t, dt, state, key):
        return state.replace(heat=state.heat + dt * jnp.abs(state.charge))

    state = ParticleState(jnp.zeros((2, 2)), jnp.zeros((2, 2)), extra={"charge": [1.0, -3.0]})
    end = simulate(Scene((field,), (warm,)), state, dt=0.5, num_steps=2).y
    assert np.allclose(end.velocity[-1], [[0.0, 2.0], [0.0, -6.0]])
    assert np.allclose(end.heat[-1], [1.0, 3.0])


def silent(t, dt, state, key):
    return state.replace(glow=jnp.zeros(len(state.position)))


ERRORS = {
    "needs a field": (Scene(effects=(OverLife("color", np.eye(3)),)), "reads 'age', which nothing provides.*Lifetime"),
    "needs a lifetime": (Scene(effects=(Lifetime(),)), "Lifetime reads 'lifetime', which nothing provides"),
    "conflict": (
        Scene(effects=(Lifetime(1.0), OverLife("size", [1.0], duration=1.0), OverLife("size", [2.0], duration=1.0))),
        "OverLife sets 'size' .* and OverLife writes it too",
    ),
    "conflict at birth": (
        Scene(effects=(Emitter(1.0, **POINT, size=1.0), Lifetime(1.0), OverLife("size", [1.0], duration=1.0))),
        "OverLife sets 'size' .* and Emitter writes it too",
    ),
    "ages twice": (Scene(effects=(Lifetime(1.0), Lifetime(2.0))), "Lifetime sets 'age'"),
    "shape of a sampler": (Scene(effects=(Emitter(1.0, [0.0] * 3, [0.0, 0.0]),)), r"Emitter.position must .*\(2,\)"),
    "shape of a colour": (Scene(effects=(Emitter(1.0, **POINT, color=[1.0, 0.0]),)), r"Emitter.color must .*\(3,\)"),
    "undeclared": (Scene(effects=(silent,)), "silent must return the fields.*glow.*declare"),
    "not a state": (Scene(effects=(lambda t, dt, state, key: 3.0,)), "must return the state"),
    "speed limit": (Scene(effects=(SpeedLimit([1.0, 2.0]),)), r"SpeedLimit.limit must have shape \(\) or \(3,\)"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_bad_scenes_get_one_clear_error_before_tracing(name):
    scene, message = ERRORS[name]
    with pytest.raises(ValueError, match=message):
        simulate(scene, empty_pool(3, 2), dt=0.1, num_steps=1, key=KEY)


def test_bad_arguments_get_one_clear_error():
    with pytest.raises(ValueError, match=r"needs a key, because Emitter draws random numbers.*key=jax.random.key"):
        simulate(Scene(effects=(Emitter(1.0, **POINT),)), empty_pool(3, 2), dt=0.1, num_steps=1)
    for capacity in (0, -1, 2.5):
        with pytest.raises(ValueError, match="capacity must be"):
            empty_pool(capacity, 2)
    for rate in (-1.0, jnp.nan, "many"):
        with pytest.raises(ValueError, match=r"Emitter.rate must be"):
            Emitter(rate, **POINT)
    with pytest.raises(ValueError, match=r"Emitter.bursts must be pairs"):
        Emitter(1.0, **POINT, bursts=((0.0, -3),))
    with pytest.raises(ValueError, match=r"Emitter.max_births must be at least 1"):
        Emitter(1.0, **POINT, max_births=0)
    with pytest.raises(ValueError, match=r"Emitter.velocity must be a sampler .* the class Cone; make one, Cone"):
        Emitter(1.0, position=[0.0, 0.0], velocity=Cone)
    with pytest.raises(ValueError, match=r"Emitter.size must be a function \(key, count\) -> .* got <lambda>\(key\)"):
        Emitter(1.0, **POINT, size=lambda key: 1.0)
    with pytest.raises(ValueError, match=r"Lifetime.duration must be greater than 0 s"):
        Lifetime(0.0)
    with pytest.raises(ValueError, match=r"OverLife.times must increase"):
        OverLife("size", [1.0, 2.0], times=[1.0, 0.0])
    with pytest.raises(ValueError, match=r"SpeedLimit.limit must be at least 0"):
        SpeedLimit(-1.0)
    with pytest.raises(ValueError, match=r"state.alive must be boolean"):
        simulate(Scene(), empty_pool(3, 2).replace(alive=jnp.zeros(3)), dt=0.1, num_steps=1)
    with pytest.raises(ValueError, match=r"state.color must have shape \(3, 3\)"):
        simulate(Scene(), empty_pool(3, 2).replace(color=jnp.zeros(3)), dt=0.1, num_steps=1)
    with pytest.raises(AttributeError, match="no field 'temprature'; it has position, velocity, mass, alive"):
        empty_pool(3, 2).temprature  # noqa: B018


def test_an_emitter_with_a_rate_of_time_on_a_moving_path():
    """As many births as the integral of the rate; each newborn where the path was, with its share of the speed."""

    def rate(t):
        return 100 * (1 + jnp.sin(3 * t))

    jet = Emitter(rate, [0.0, 1.0], [0.0, 0.5], path=lambda t: jnp.stack([2 * t, 0 * t]), inherit=0.5, max_births=8)
    run = simulate(Scene(effects=(jet,)), empty_pool(300, 2), dt=0.01, num_steps=200, save_every=50, key=KEY).y
    due = 100 * (run.steps * 0.01 + (1 - np.cos(3 * run.steps * 0.01)) / 3)
    np.testing.assert_allclose(run.births, due, atol=3)
    born = int(run.births[-1])
    assert run.missed_births[-1] == 0
    np.testing.assert_allclose(run.velocity[-1, :born], np.broadcast_to([1.0, 0.5], (born, 2)), atol=1e-12)
    age = (run.position[-1, :born, 1] - 1) / 0.5
    np.testing.assert_allclose(run.position[-1, :born, 0], 2 * (2 - age) + age, atol=1e-9)
    for wrong, match in (({"rate": lambda t: jnp.ones(2)}, "rate"), ({"path": lambda t: t}, "path")):
        made = dataclasses.replace(jet, **wrong)
        with pytest.raises(ValueError, match=f"Emitter.{match}"):
            simulate(Scene(effects=(made,)), empty_pool(3, 2), dt=0.01, num_steps=1, key=KEY)
