"""Programs compiled in haste: the same values, and plain ones where XLA does not know its options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler._jax import haste


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
