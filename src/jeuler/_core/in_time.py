"""Parameters that may be functions of time."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.component import as_component, as_float


def at_time(x: Any, t: Any, dtype: Any = None) -> Array:
    """A place or strength that may be a function of time."""
    return jnp.asarray(x(t) if callable(x) else x, dtype)


def moving(name: str, x: Any) -> Any:
    """A parameter that may be a function of time, as a pytree of floating arrays."""
    expected = f"{name} must be a number, an array of them, or a function of time t"
    checks.refuse_class(expected, x)
    if callable(x):
        checks.function(name, x, "(t) -> value", "it gets the time, in s")
        return as_component(x)
    try:
        if x is None:
            raise TypeError
        return as_float(x)
    except (TypeError, ValueError):
        raise ValueError(f"{expected}, got {checks.shown(x)}") from None
