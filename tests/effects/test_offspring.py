"""Births where particles die, or touch a surface: how many, where, of which generation, and what is not done is counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Collisions, Emitter, Lifetime, ParticleState, Plane, Scene, SubEmitter, simulate

KEY = jax.random.key(0)
FLOOR = Plane([0.0, 0.0], [0.0, 1.0])
STILL = [0.0, 0.0]


def pool(*living, capacity=12, dtype=jnp.float64):
    """Those that live, ((position, velocity), ...), in the first slots."""
    x, v = np.zeros((2, capacity, 2))
    for k, (place, speed) in enumerate(living):
        x[k], v[k] = place, speed
    return ParticleState(jnp.asarray(x, dtype), jnp.asarray(v, dtype), alive=jnp.arange(capacity) < len(living))


def run(scene, state, num_steps, dt=0.1, **how):
    return simulate(scene, state, dt=dt, num_steps=num_steps, key=KEY, **how).y


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_newborns_of_a_death_are_where_it_was_with_a_share_of_its_velocity(dtype):
    burst = SubEmitter(3, [1.0, 0.0], [0.0, 0.5], inherit=0.5, inherits=("color",), size=0.25)
    state = pool(((1.0, 2.0), (4.0, 0.0)), ((5.0, 5.0), (0.0, -2.0)), dtype=dtype)
    state = state.replace(color=jnp.zeros((12, 3), dtype).at[0, 0].set(1.0))
    y = run(Scene((), (Lifetime(0.2), burst)), state, 3)
    assert y.alive.sum(axis=1).tolist() == [2, 2, 2, 6]
    assert not y.alive[3, :2].any(), "a slot that became free in the step is free from the next one on"
    # the deaths are at the start of the third step, after which newborns have moved for a step
    x = np.array([[1.0 + 2 * 0.1 * 4.0, 2.5]] * 3 + [[5.0, 5.5 - 2 * 0.1 * 2.0]] * 3)
    v = np.array([[1 + 0.5 * 4.0, 0.0]] * 3 + [[1.0, -1.0]] * 3)
    np.testing.assert_allclose(y.position[3, 2:8], x + 0.1 * v, rtol=1e-6)
    np.testing.assert_allclose(y.velocity[3, 2:8], v, rtol=1e-6)
    assert y.color[3, 2:8, 0].tolist() == [1, 1, 1, 0, 0, 0]
    assert y.generation[3, 2:8].tolist() == [1] * 6
    assert y.size[3, 2:8].tolist() == [0.25] * 6
    assert (int(y.births[3]), int(y.missed_births[3])) == (6, 0)


@pytest.mark.parametrize(("generations", "births"), [(1, 2), (2, 2 + 4), (3, 2 + 4 + 8)])
def test_generations_end_the_chain(generations, births):
    scene = Scene((), (Lifetime(0.1), SubEmitter(2, STILL, generations=generations)))
    y = run(scene, pool((STILL, STILL), capacity=40), 8)
    assert int(y.births[-1]) == births
    assert not y.alive[-1].any()


@pytest.mark.parametrize(
    ("capacity", "max_births", "born"),
    [(12, None, 10), (12, 4, 4), (6, None, 4), (3, None, 1), (2, None, 0), (2, 1, 0)],
)
def test_births_without_a_slot_or_beyond_the_most_are_counted(capacity, max_births, born):
    scene = Scene((), (Lifetime(0.1), SubEmitter(5, STILL, max_births=max_births)))
    y = run(scene, pool((STILL, STILL), (STILL, STILL), capacity=capacity), 2)
    assert (int(y.births[-1]), int(y.missed_births[-1])) == (born, 10 - born)


def test_a_death_of_what_is_not_finite_has_no_births_and_is_counted():
    scene = Scene((), (jeuler.DeathOutside(-9.0, 9.0), SubEmitter(5, STILL)))
    y = run(scene, pool(([np.nan, 0.0], STILL), ([20.0, 0.0], STILL)), 1)
    assert (int(y.births[-1]), int(y.missed_births[-1])) == (5, 5)
    assert np.isfinite(y.position[-1]).all()


def test_two_of_them_see_the_same_deaths_and_an_emitter_fills_what_is_left():
    twice = (SubEmitter(1, [1.0, 0.0]), SubEmitter(1, [2.0, 0.0]))
    scene = Scene((), (Lifetime(0.1), *twice, Emitter(0.0, STILL, [3.0, 0.0], bursts=((0.1, 1),))))
    y = run(scene, pool((STILL, STILL), capacity=6), 2)
    assert sorted(y.velocity[-1, :, 0][y.alive[-1]].tolist()) == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("effects", "where"),
    [
        ((SubEmitter(1, STILL), Lifetime(0.1)), "after the deaths"),
        ((Lifetime(0.1), Emitter(1.0, STILL, STILL), SubEmitter(1, STILL)), "before the births"),
        ((SubEmitter(1, STILL, contact=FLOOR), Collisions((FLOOR,))), "side of Collisions"),
    ],
)
def test_an_order_that_would_hide_deaths_or_contacts_is_refused(effects, where):
    with pytest.raises(ValueError, match=f"SubEmitter must stand in Scene.effects .*{where}"):
        run(Scene((), effects), pool((STILL, STILL)), 1)


def touches(y):
    """In which steps newborns came: their number after each."""
    return np.diff(np.asarray(y.births)).tolist()


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("height", [0.25, 0.3, 0.3001, 1e-3])
@pytest.mark.parametrize("floor", [0.0, 0.7, -30.1])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_ball_that_comes_to_the_floor_counts_once(restitution, height, floor, dtype):
    """At any moment of the step, on its end too; what rests afterwards counts no more."""
    ground = Plane([0.0, floor], [0.0, 1.0])
    dust = SubEmitter(1, STILL, contact=ground)
    state = pool(((0.0, floor + height), (0.0, -1.0)), ((0.0, 50.0), (0.0, 0.0)), capacity=9, dtype=dtype)
    y = run(Scene((), (Collisions((ground,), restitution=restitution), dust)), state, 9)
    expected = [0] * 9
    expected[int(np.ceil(round(height / 0.1, 9))) - 1] = 1
    late = expected[-1:] + expected[:-1]  # rounding may put a contact on a step's end into the next step
    assert touches(y) in ([expected, late] if height == 0.3 else [expected])
    born = y.position[-1][y.generation[-1] == 1]
    rounding = 4 * jnp.finfo(dtype).eps * abs(floor)
    assert (born[:, 1] - floor <= 0.1 + rounding).all(), "it is born where the ball is at the step's end"


def test_balls_that_roll_rest_or_turn_in_the_air_have_no_births():
    dust = SubEmitter(1, STILL, contact=FLOOR, margin=0.1)
    state = pool(((0.0, 0.1), STILL), ((1.0, 0.1), (2.0, 0.0)), ((3.0, 1.0), (0.0, -1.0)))
    up = jeuler.AppliedForce(lambda t: jnp.array([[0.0, 10.0 + 9.81]]), [2])
    y = run(Scene((jeuler.Gravity([0.0, -9.81]), up), (Collisions((FLOOR,), radius=0.1), dust)), state, 40, dt=0.01)
    assert touches(y) == [0] * 40
    assert float(y.velocity[-1, 2, 1]) > 0, "it turned back far from the floor"


@pytest.mark.parametrize("distance", [0.0, -0.05])
def test_what_touches_at_the_start_is_there_already(distance):
    dust = SubEmitter(1, STILL, contact=FLOOR)
    state = pool(((0.0, distance), (0.0, -1.0)), ((1.0, distance), STILL))
    assert touches(run(Scene((), (Collisions((FLOOR,), restitution=1.0), dust)), state, 3)) == [0] * 3


def test_a_floor_that_comes_to_a_ball_at_rest_counts():
    rising = jeuler.Plane(lambda t: jnp.stack([0.0 * t, t]), [0.0, 1.0])
    dust = SubEmitter(2, STILL, contact=rising)
    y = run(Scene((), (Collisions((rising,), restitution=1.0), dust)), pool(((0.0, 0.25), STILL)), 5)
    assert touches(y) == [0, 0, 2, 0, 0]


@pytest.mark.parametrize("windows", [(), (4, 8)])
def test_windows_and_batches_give_the_same_run(windows):
    effects = (
        Lifetime(0.3),
        SubEmitter(2, jeuler.Normal(STILL, 1.0), max_births=4),
        Emitter(20.0, STILL, [0.0, 1.0], max_births=2),
    )
    scene, empty = Scene((jeuler.Gravity([0.0, -9.81]),), effects), jeuler.empty_pool(30, 2)
    plain = run(scene, empty, 8)
    other = run(scene, empty, 8, windows=windows)
    np.testing.assert_allclose(other.position, plain.position, rtol=1e-12, atol=1e-12)
    many = jax.vmap(lambda key: simulate(scene, empty, dt=0.1, num_steps=8, key=key).y)(jax.random.split(KEY, 2))
    one = simulate(scene, empty, dt=0.1, num_steps=8, key=jax.random.split(KEY, 2)[1]).y
    np.testing.assert_allclose(many.position[1], one.position, rtol=1e-12, atol=1e-12)
    assert int(plain.births[-1]) > 16


STEPS = ["symplectic_euler", "rk4", "implicit_euler", "implicit_midpoint"]


@pytest.mark.parametrize("name", STEPS)
def test_every_step_has_the_same_births(name):
    """Two balls fall by 1.1 m, to the floor in the fifth step; one dies on the way."""
    step = getattr(jeuler, f"{name}_step")
    effects = (
        Lifetime(),
        SubEmitter(2, STILL),
        Collisions((FLOOR,), radius=0.1, restitution=0.0),
        SubEmitter(3, STILL, contact=FLOOR, margin=0.1 + 1e-9),
    )
    lifetime = jnp.where(jnp.arange(12) == 0, 0.15, 9.0)
    state = pool(((0.0, 1.2), STILL), ((0.2, 1.2), STILL)).replace(lifetime=lifetime)
    y = run(Scene((jeuler.Gravity([0.0, -9.81]),), effects), state, 8, step=step)
    assert y.births.tolist() == [0, 0, 0, 2, 2, 5, 5, 5, 5]
    assert int(y.missed_births[-1]) == 0
    assert y.generation[-1, y.alive[-1]].tolist() == [1, 0, 1, 1, 1, 1]


def test_an_ensemble_has_the_births_of_its_members():
    scene = Scene((), (Lifetime(0.3), SubEmitter(2, jeuler.Normal(STILL, 1.0)), jeuler.Trail(2)))
    ends = lambda key: simulate(scene, pool((STILL, [1.0, 0.0])), dt=0.1, num_steps=5, key=key, save_every=5)  # noqa: E731
    keys = jax.random.split(KEY, 5)
    found = jeuler.ensemble(lambda key: ends(key).y.trail[-1], keys, batch=2)
    np.testing.assert_allclose(found.results, jnp.stack([ends(key).y.trail[-1] for key in keys]), rtol=1e-12)


def test_births_cannot_be_divided_over_devices_and_say_so():
    with pytest.raises(ValueError, match="SubEmitter"):
        jeuler.divide(Scene((), (SubEmitter(2, STILL),)), pool((STILL, STILL)), devices=2)


def test_gradients_flow_from_newborns_to_those_that_they_come_from():
    def end(v, c):
        scene = Scene((), (Lifetime(0.2), SubEmitter(1, [1.0, 0.0], inherit=c)))
        return run(scene, pool((STILL, STILL)).replace(velocity=jnp.zeros((12, 2)).at[0, 1].set(v)), 4).position[
            -1, 1, 1
        ]

    # born at 0.2 v, moves with c v for two steps
    np.testing.assert_allclose(jax.grad(end, (0, 1))(3.0, 0.5), [0.2 + 0.2 * 0.5, 0.2 * 3.0], rtol=1e-12)


def test_a_further_field_of_a_newborn_is_zero_whenever_its_slot_became_free():
    effects = (Lifetime(0.1), Emitter(0.0, STILL, STILL, bursts=((0.1, 1),)))
    state = pool((STILL, STILL), capacity=1).replace(temperature=jnp.array([20.0]))
    assert float(run(Scene((), effects), state, 2).temperature[-1, 0]) == 0.0
