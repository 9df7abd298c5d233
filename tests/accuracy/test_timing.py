"""The timing harness: a sleep of known length is measured, and what is done while compiling is kept out of it."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.accuracy.timing import counting, measure


def test_a_sleep_of_known_length_is_in_every_run():
    def nap(x):
        def sleep(x):
            time.sleep(0.05)
            return np.asarray(x)

        return jax.pure_callback(sleep, jax.ShapeDtypeStruct((), jnp.float64), x)

    cost = measure(nap, jnp.array(3.0), repeats=3)
    assert len(cost.run_seconds) == 3
    assert all(0.05 <= seconds < 0.25 for seconds in cost.run_seconds)
    assert cost.least == min(cost.run_seconds)
    assert cost.least <= cost.median <= max(cost.run_seconds)
    assert float(cost.result) == 3.0


def test_compiling_is_kept_out_of_the_runs():
    def slow_to_trace(x):
        time.sleep(0.2)  # runs once, while tracing
        return 2 * x

    cost = measure(slow_to_trace, jnp.ones(4), repeats=4)
    assert cost.compile_seconds >= 0.2
    assert max(cost.run_seconds) < 0.1


def test_long_runs_are_measured_less_often():
    def nap(x):
        return jax.pure_callback(lambda x: (time.sleep(0.04), x)[1], jax.ShapeDtypeStruct((), jnp.float64), x)

    assert len(measure(nap, jnp.array(0.0), repeats=50, budget=0.1).run_seconds) <= 2
    assert len(measure(nap, jnp.array(0.0), repeats=50, patience=0.01).run_seconds) == 1


def test_temporary_memory_grows_with_what_a_gradient_keeps():
    def steps(n):
        def final(a):
            return jax.lax.scan(lambda y, _: (jnp.sin(a * y), None), jnp.ones(100), None, length=n)[0].sum()

        return measure(jax.grad(final), jnp.array(0.5), repeats=1).temporary_bytes

    assert steps(1000) - steps(100) > 900 * 100 * 8 * 0.9


def test_evaluations_are_counted_as_they_run():
    f, read = counting(lambda t, y, args: -y)

    def until_small(y):
        return jax.lax.while_loop(lambda y: y > 0.1, lambda y: y + 0.5 * f(0.0, y, None), y)

    jax.block_until_ready(jax.jit(until_small)(jnp.array(1.0)))
    assert read() == 4
    jax.block_until_ready(jax.jit(jax.vmap(lambda y: f(0.0, y, None)))(jnp.ones(7)))
    assert read() == 7
