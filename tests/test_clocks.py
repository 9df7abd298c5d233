"""The clock of a run: births late in float32, lifetimes of many steps, counters above 2^31."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.effects.births import births_of_stream
from jeuler.solving.grid import Grid

KEY = jax.random.key(0)


def pool(capacity, dtype):
    return jeuler.empty_pool(capacity, 1, dtype=dtype)


@pytest.mark.parametrize("t0", [0.0, 7.3, 20_000.0])
@pytest.mark.parametrize(("rate", "births"), [(1.0, 2), (100.0, 200)])
def test_births_do_not_depend_on_when_the_run_begins(t0, rate, births):
    jet = jeuler.Emitter(rate, [0.0], [0.0], max_births=1)
    run = {"dt": 0.001, "num_steps": 2000, "save_every": 2000, "t0": t0, "key": KEY}
    end = jeuler.simulate(jeuler.Scene(effects=(jet,)), pool(400, jnp.float32), **run)
    assert int(end.y.births[-1]) == births


def test_a_burst_late_in_float32_comes_once():
    jet = jeuler.Emitter(0.0, [0.0], [0.0], bursts=((20_001.0, 5),))
    run = {"dt": 0.001, "num_steps": 2000, "save_every": 500, "t0": 20_000.0, "key": KEY}
    end = jeuler.simulate(jeuler.Scene(effects=(jet,)), pool(20, jnp.float32), **run)
    assert end.y.births.tolist() == [0, 0, 0, 5, 5]


@pytest.mark.parametrize("per_step", [0.1, 1 / 3, 2.5, 0.0, 1.0, 3e-7])
@pytest.mark.parametrize("first", [0, 10_000_000, 2_000_000_000])
def test_the_stream_of_births_is_exact_for_any_number_of_steps(per_step, first):
    n = jnp.arange(first, first + 3000, dtype=jnp.int32)
    births = np.asarray(births_of_stream(n, jnp.asarray(per_step)))
    assert abs(births.sum() - 3000 * per_step) <= 1
    assert set(births.tolist()) <= {int(np.floor(per_step)), int(np.floor(per_step)) + 1}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(("dt", "steps"), [(0.001, 1000), (0.1, 3), (1e-6, 1000), (1e4, 700)])
def test_a_lifetime_of_so_many_steps_lives_so_many(dt, steps, dtype):
    scene = jeuler.Scene(effects=(jeuler.Lifetime(steps * dt),))
    state = jeuler.ParticleState(jnp.ones((1, 1), dtype), jnp.zeros((1, 1), dtype))
    run = jeuler.simulate(scene, state, dt=dt, num_steps=steps + 1)
    assert run.y.alive[:, 0].tolist() == [True] * (steps + 1) + [False]


def test_more_steps_than_int32_counts():
    grid = Grid.checked(1e-3, 2**31 + 2**24, 0.0, 2**24, None, jnp.float64)
    np.testing.assert_allclose(grid.clock(jnp.int64(2**31 + 2**24)), 2164260.864, rtol=1e-15)
    run = jax.eval_shape(lambda: jeuler.solve(lambda t, y, a: -y, 1.0, dt=1e-3, num_steps=2**31, save_every=2**24))
    assert (run.t.shape, run.first_nonfinite.dtype) == ((129,), jnp.int64)
    with pytest.raises(ValueError, match="take save_every=1,048,576"):
        jeuler.solve(lambda t, y, a: -y, 1.0, dt=1e-3, num_steps=2**31, save_every=2**31)
    with (
        jax.enable_x64(False),
        pytest.raises(ValueError, match=r"num_steps must be at most 2,147,483,647 under jit.*call it outside of these"),
    ):
        jax.eval_shape(lambda: jeuler.solve(lambda t, y, a: -y, 1.0, dt=1e-3, num_steps=2**31, save_every=2**24))
