"""Parameters that may be functions of time."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core.component import as_component, as_float


def at_time(x: Any, t: Any, dtype: Any = None) -> Array:
    """A place or strength that may be a function of time."""
    return jnp.asarray(x(t) if callable(x) else x, dtype)


def moving(x: Any) -> Any:
    """A parameter that may be a function of time, as a pytree of floating arrays."""
    return as_component(x) if callable(x) else as_float(x)
