"""Objects known again by their code and values: equal for what is made anew, other for another number within."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jeuler._jax.fingerprint import fingerprint

RATE = 0.1


class Model:
    def __init__(self, ks):
        self.ks, self.names = ks, frozenset(["a", "b", "c"])

    def __call__(self, x):
        return self.ks * x


def counting(rate):
    seen = 0

    def schedule(n):
        nonlocal seen  # what cannot be compared between calls is still known by code and cells
        return rate / (1 + n)

    return schedule


MADE = {
    "adam": lambda rate: optax.adam(rate),
    "late in a schedule": lambda rate: optax.sgd(optax.piecewise_constant_schedule(0.1, {100_000: rate})),
    "warm-up": lambda rate: optax.adam(optax.warmup_cosine_decay_schedule(0.0, rate, 10, 100)),
    "a chain": lambda rate: optax.chain(optax.clip_by_global_norm(1.0), optax.adam(jnp.asarray(rate))),
    "a closure": lambda rate: lambda x: rate * x,
    "nonlocal": counting,
    "an array": lambda rate: lambda x: jnp.full(300_000, rate) * x,
    "a large array": lambda rate: np.full(300_000, rate),
    "a key": lambda rate: jax.random.key(int(100 * rate)),
    "an object": Model,
    "a method": lambda rate: Model(rate).__call__,
    "a partial": lambda rate: functools.partial(max, rate),
    "a global": lambda rate: lambda x: RATE * x,
}


@pytest.mark.parametrize("name", MADE)
def test_what_is_made_again_is_known_and_what_has_another_number_is_not(name, monkeypatch):
    first = fingerprint(MADE[name](0.1))
    assert fingerprint(MADE[name](0.1)) == first
    monkeypatch.setitem(globals(), "RATE", 0.2)
    assert fingerprint(MADE[name](0.2)) != first


def test_other_code_is_another():
    assert fingerprint(lambda x: x + 1) == fingerprint(lambda x: x + 1)
    assert len({fingerprint(f) for f in (lambda x: x + 1, lambda x: x + 2, lambda x: x - 1, jnp.sin, jnp.cos)}) == 5
    again = []
    again.append(again)
    assert fingerprint(again)  # what holds itself has one too
