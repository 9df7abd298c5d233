"""A run from a saved state goes on as the run would have: the same random draws, births and deaths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Emitter, Gravity, Lifetime, Normal, ParticleState, Scene, SubEmitter, Trail

KEY = jax.random.key(1)
JET = Emitter(100.0, [0.0, 0.0], Normal(0.0, jnp.ones(2)), max_births=4, bursts=((0.2, 2), (0.3, 1)))


def shaken(t, dt, previous, state, key):
    return state.replace(velocity=state.velocity + jax.random.normal(key, state.velocity.shape, state.velocity.dtype))


@jeuler.uses(acts="start and after motion")
def stirred(t, dt, state, key):
    return state.replace(position=state.position + jax.random.uniform(key, (), state.position.dtype))


SCENES = {
    "births and deaths": (Scene((), (JET, Lifetime(0.11))), jeuler.empty_pool(20, 2)),
    "births of births, with trails": (
        Scene((), (Lifetime(0.11), SubEmitter(2, Normal(0.0, jnp.ones(2)), max_births=4), JET, Trail(3, every=2))),
        jeuler.empty_pool(40, 2),
    ),
    "deaths in frames": (Scene((), (JET, Lifetime(frames=11))), jeuler.empty_pool(20, 2)),
    "forces that are drawn": (Scene((), (shaken, stirred)), ParticleState(np.zeros((3, 2)), np.zeros((3, 2)))),
}


def last(run):
    return jax.tree.map(lambda x: x[-1], run.y)


@pytest.mark.parametrize(
    ("name", "dtype"), list(zip(SCENES, ("float64", "float32", "float32", "float32"), strict=True))
)
def test_two_halves_are_one_run(name, dtype):
    scene, state = SCENES[name]
    state = state.replace(position=state.position.astype(dtype), velocity=state.velocity.astype(dtype))

    @jax.jit
    def run(state, t0, scene):
        return jeuler.simulate(scene, state, dt=0.01, num_steps=20, t0=t0, key=KEY, save_every=5)

    first = run(state, 0.0, scene)
    whole = jeuler.simulate(scene, state, dt=0.01, num_steps=40, key=KEY, save_every=5)
    second = run(last(first), 0.2, scene)
    for a, b in zip(jax.tree.leaves(second.y), jax.tree.leaves(whole.y), strict=True):
        np.testing.assert_allclose(a, b[4:], rtol=1e-5, atol=1e-5)
    assert second.y.steps.tolist() == [20, 25, 30, 35, 40]


def test_each_member_of_a_batch_goes_on_from_its_own_step():
    scene, state = SCENES["forces that are drawn"]
    go = lambda state: last(jeuler.simulate(scene, state, dt=0.01, num_steps=2, key=KEY, save_every=2))  # noqa: E731
    after = [go(state)]  # 2, 4, 6 and 8 steps
    for _ in range(3):
        after.append(go(after[-1]))
    batch = jax.tree.map(lambda *x: jnp.stack(x), after[0], after[2])
    ends = jax.vmap(go)(batch).velocity
    np.testing.assert_allclose(ends, jnp.stack([after[1].velocity, after[3].velocity]), rtol=1e-12)


def test_a_scene_that_draws_nothing_counts_no_steps():
    state = ParticleState(np.zeros((2, 2)), np.zeros((2, 2)))
    quiet = Scene((Gravity([0.0, -9.8]),), (Lifetime(1.0), jeuler.SpeedLimit(9.0)))
    assert jeuler.simulate(quiet, state, dt=0.1, num_steps=1, key=KEY).y.steps is None
    assert jeuler.simulate(Scene((), (lambda t, dt, s, key: s,)), state, dt=0.1, num_steps=1).y.steps is None


@pytest.mark.parametrize("frames", [1, 3, 2000])
def test_a_lifetime_in_frames_is_that_many_steps_whatever_dt_is(frames):
    scene = Scene(effects=(Lifetime(frames=frames),))
    state = ParticleState(jnp.ones((1, 1), jnp.float32), jnp.zeros((1, 1), jnp.float32))

    @jax.jit
    def alive(dt):
        return jeuler.simulate(scene, state, dt=dt, num_steps=frames + 1).y.alive[:, 0]

    for dt in (1e-3, 0.1, 1 / 3, 1e4):
        assert alive(dt).tolist() == [True] * (frames + 1) + [False]


def test_newborns_in_a_slot_that_was_used_live_their_frames_anew():
    """One birth a step into three slots, each for two steps: none is ever missed."""
    scene = Scene(effects=(Lifetime(frames=2), Emitter(100.0, [0.0], [0.0], max_births=1)))
    run = jeuler.simulate(scene, jeuler.empty_pool(3, 1), dt=0.01, num_steps=30, key=KEY)
    assert int(run.y.missed_births[-1]) == 0
    assert run.y.alive.sum(axis=1).tolist() == [0, 1, 2, *[3] * 28]
    assert int(run.y.frames.max()) <= 2


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"duration": 1.0, "frames": 3}, "got both; leave one out"),
        ({"frames": 0}, "Lifetime.frames must be at least 1, got 0"),
        ({"frames": 2.5}, "Lifetime.frames must be a Python integer, got 2.5"),
    ],
)
def test_lifetimes_that_are_none(how, message):
    with pytest.raises(ValueError, match=message):
        Lifetime(**how)


STEPS = [
    jeuler.euler_step,
    jeuler.symplectic_euler_step,
    jeuler.heun_step,
    jeuler.rk4_step,
    jeuler.implicit_euler_step,
    jeuler.linearly_implicit_euler_step,
    jeuler.extrapolated_euler(2),
]


@pytest.mark.parametrize("step", STEPS)
def test_no_step_is_the_start_alone(step):
    def run(y):
        return jeuler.solve(lambda t, y, a: (y[1], -y[0]), y, dt=0.1, num_steps=0, t0=2.0, step=step)

    y0 = jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])
    for got in (run(y0), jax.jit(run)(y0)):
        assert got.t.tolist() == [2.0]
        assert got.y[0].tolist() == [[1.0, 2.0]]
        assert int(got.first_nonfinite) == -1
    assert jax.vmap(run)(y0).y[1].tolist() == [[3.0], [4.0]]
    assert jax.grad(lambda y: run((y, y0[1])).y[0][-1, 0])(y0[0]).tolist() == [1.0, 0.0]


def test_an_adaptive_run_to_its_start_is_the_start():
    def run(t1):
        return jeuler.solve_adaptive(lambda t, y, a: -y, 2.0, t0=1.0, t1=t1)

    for got in (run(1.0), jax.jit(run)(1.0), jax.tree.map(lambda x: x[0], jax.vmap(run)(jnp.array([1.0, 2.0])))):
        assert (got.y.tolist(), int(got.num_steps), bool(got.finished)) == ([2.0, 2.0], 0, True)
    np.testing.assert_allclose(run([1.0, 2.0]).y, [2.0, 2.0, 2 / np.e], rtol=1e-6)
    with pytest.raises(ValueError, match="t1 must not be before t0=1.0.*solve with a negative dt"):
        run(0.5)
    early = jax.jit(run)(0.5)
    assert np.isnan(early.y[1])
    assert not early.finished
