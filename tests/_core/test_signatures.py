"""What signatures are kept by is what decides them."""

import functools
import inspect

import jax
import pytest

from jeuler._core.signatures import signature_of


class Thing:
    def __call__(self, t, y=1, *, key=None):
        return t

    def method(self, t: float) -> float:
        return t

    def of_any(*args):
        return args

    @functools.wraps(method)
    def wrapped(self, *args):
        return args

    @staticmethod
    def fixed(a, b):
        return a

    @classmethod
    def made(cls, a):
        return cls()


class Inherits(Thing):
    pass


class Renamed(Thing):
    __signature__ = inspect.Signature([])


def closure(c, default):
    return lambda t, y=default: c + t + y


CASES = {
    "lambda": lambda t, y: t,
    "defaults": closure(1, 2),
    "other defaults": closure(1, 3),
    "object": Thing(),
    "inherited": Inherits(),
    "its own word": Renamed(),
    "method": Thing().method,
    "any arguments": Thing().of_any,
    "wrapped": Thing().wrapped,
    "static": Thing.fixed,
    "of a class": Thing.made,
    "class": Thing,
    "partial": functools.partial(Thing.fixed, 1),
    "jitted": jax.jit(lambda t, y: t),
    "built-in": len,
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("call", [1, 2])
def test_the_signature_is_that_of_inspect(name, call):
    assert signature_of(CASES[name]) == inspect.signature(CASES[name])


def test_what_has_no_signature_has_none():
    assert signature_of(3) is None
    assert signature_of(type("Bare", (), {"__call__": lambda: 1})()) is None


def test_a_function_made_again_with_other_arguments_has_its_own():
    first = lambda t, y, args: t  # noqa: E731
    assert len(signature_of(first).parameters) == 3
    first = lambda t, y: t  # noqa: E731
    assert len(signature_of(first).parameters) == 2
