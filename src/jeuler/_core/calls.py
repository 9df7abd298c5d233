"""How effects are called: with the state before the motion, or without it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from jeuler._core.component import unwrapped
from jeuler._core.signatures import signature_of


def previous_is_optional(method: Callable[..., Any]) -> Callable[..., Any]:
    """An effect's ``__call__(self, t, dt, previous, state, key)``, also to be called by hand as (t, dt, state, key).

    ``previous`` is None then.
    """

    @functools.wraps(method)
    def call(self: Any, t: Any, dt: Any, *rest: Any, **named: Any) -> Any:
        if len(rest) + len(named.keys() & {"previous", "state", "key"}) == 2:
            rest = (None, *rest)
        return method(self, t, dt, *rest, **named)

    return call


def with_previous(effect: Callable[..., Any], name: str) -> Callable[..., Any]:
    """An effect as it is called in a step, ``(t, dt, previous, state, key)``; one of four arguments gets no previous.

    ValueError where it takes neither.
    """
    if hasattr(effect, "over_step"):  # what effects of the user's own had for this before `previous`
        return effect.over_step
    signature = signature_of(unwrapped(effect))
    if signature is None or "previous" in signature.parameters or not _takes(signature, 4):
        if signature is not None and not _takes(signature, 5):
            raise ValueError(
                f"an effect must be a function (t, dt, previous, state, key) -> state, or the same without previous, "
                f"got {name}{signature}"
            )
        return effect
    return lambda t, dt, previous, state, key: effect(t, dt, state, key)


def _takes(signature: Any, count: int) -> bool:
    try:
        signature.bind(*range(count))
    except TypeError:
        return False
    return True
