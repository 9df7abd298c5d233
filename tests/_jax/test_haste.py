"""Programs compiled in haste: the same values, and plain ones where XLA does not know its options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler._jax import haste, programs


@pytest.mark.parametrize("how", ["none", "some", "great"])
def test_values_are_those_of_the_plain_program(how):
    x = jnp.linspace(0.0, 1.0, 7)
    function = jax.vmap(lambda x: jnp.sin(x) * jnp.exp(-x))
    np.testing.assert_allclose(haste.jit_in_haste(function, how)(x), jax.jit(function)(x), rtol=1e-12)


def test_without_these_options_the_program_is_a_plain_one(monkeypatch):
    monkeypatch.setitem(haste.OPTIONS, "some", {"xla_cpu_of_another_version": True})
    hasty = haste.jit_in_haste(lambda x: 2 * x, "some")
    assert [float(hasty(jnp.float32(k))) for k in (1, 2)] == [2.0, 4.0]


def test_other_errors_are_not_swallowed():
    with pytest.raises(ZeroDivisionError):
        haste.jit_in_haste(lambda x: x + 1 // 0, "great")(1.0)


def area(x):
    return jnp.sum(x * jnp.sin(x))


@pytest.mark.parametrize(
    "around", [lambda f: f, jax.grad, jax.jit, jax.vmap, lambda f: jax.jit(jax.linearize(f, 0.5)[1])]
)
def test_a_run_in_haste_can_be_differentiated_batched_and_compiled_again(around):
    def run(x):
        return programs.call(area, (x,), (), "some")

    x = jnp.linspace(0.0, 1.0, 3) if around is jax.vmap else jnp.asarray(0.7)
    np.testing.assert_allclose(around(run)(x), around(area)(x), rtol=1e-12)


@pytest.mark.parametrize(
    ("colliders", "pairs", "long"),
    [(1, 0, False), (2, 0, True), (0, 1, True), (1, 32, True), (1, 33, False), (0, 0, False)],
)
def test_runs_of_few_contacts_that_may_be_several_at_once_are_compiled_in_haste(colliders, pairs, long):
    floor = jeuler.contact.Plane([0.0], [1.0])
    contact = jeuler.Collisions((floor,) * colliders, pairs=[(k, k + 1) for k in range(pairs)], radius=0.1)
    assert contact.is_long_code(1000) is long


@pytest.mark.parametrize(("balls", "long"), [(32, True), (33, False)])
def test_so_are_runs_of_few_balls_that_find_each_other(balls, long):
    assert jeuler.Collisions(pairs="near", radius=0.1).is_long_code(balls) is long
